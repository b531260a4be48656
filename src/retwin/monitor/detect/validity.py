"""Whether the promise of a monitor still applies: a test of its assumption in quiet times."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import finite, instance, positive, whole
from retwin.monitor.detect.detector import LARGEST, Detector


@dataclass(frozen=True)
class ValidityState:
    """What the test remembers, one number per stream unless stated otherwise.

    Attributes
    ----------
    products : array (streams, J)
        Products of the bets on each alternative since the block began.
    previous : array (streams,)
        The last score if it was measured, else 0.
    samples, alarmed : array (streams,)
        Measured samples of the block, and 1 if there was an alarm in it.
    blocks, quiet : array (streams,)
        Blocks so far, and the evidence from them.
    length, runs : array (streams,)
        Measured samples since the last alarm, and the evidence from the run lengths.
    highest : array (streams,)
        Highest evidence so far.

    """

    products: NDArray
    previous: NDArray
    samples: NDArray
    alarmed: NDArray
    blocks: NDArray
    quiet: NDArray
    length: NDArray
    runs: NDArray
    highest: NDArray


@dataclass(frozen=True)
class Validity:
    """An e-process against the hypothesis that the scores are in the class of a detector.

    Quiet times: the mean of the products of a detector's bets over a block of measured samples is
    an e-value X. With F = (1 + min(X, 3)) / 2, or (1 + min(X, 1)) / 2 for a block with an alarm,
    and the weights π_b = 1 / ((b + 1) (b + 2)) of the block b at which the class ceases to apply,

        R_b = (R_(b-1) + π_b) F_b .

    Alarms: a run length of T measured samples since the last alarm, at which the detector started
    anew, has P(T ≤ t) ≤ t / ARL within the class, so that min(½ √(ARL / T), 4) is an e-value; Q is
    their product. (R + Q) / 2 is an e-process. By Ville's inequality it ever reaches 1/α with a
    probability of at most α in the class, and there the promise is void.

    A block multiplies evidence by at most 2 and an alarm by at most 4. A fault that is alarmed and
    acknowledged voids nothing; a machine that alarms again after every reset does, and so does a
    large deviation of hundreds of samples in which no alarm is counted.

    Parameters
    ----------
    detector : Detector
        Whose class is tested, by its bets.
    arl : float
        Its average run length in samples.
    alpha : float
        Probability of ever declaring a valid promise void, from 1e-12 to 0.5.
    block : int
        Samples of a block.

    References
    ----------
    Ville, Étude critique de la notion de collectif, 1939; Vovk and Wang, E-values: calibration,
    combination and applications, Annals of Statistics 49 (2021), equation 1, for p-values.

    """

    detector: Detector
    arl: float
    alpha: float = 0.01
    block: int = 100

    def __post_init__(self) -> None:
        instance("detector", self.detector, Detector, remedy="use the detector that alarms")
        positive("arl", self.arl, unit="samples")
        finite("alpha", self.alpha, at_least=1e-12, at_most=0.5)
        whole("block", self.block, at_least=1)

    def start(self, streams: int) -> ValidityState:
        """The state before the first sample, and after a new calibration."""
        first = self.detector.start(streams)
        zeros = np.zeros(streams)
        ones = np.ones_like(first.evidence)
        return ValidityState(
            ones, zeros, zeros, zeros, zeros, zeros, zeros, np.ones(streams), zeros
        )

    def void(self, state: ValidityState) -> NDArray:
        """Whether the promise of each stream is void (streams,); it stays so."""
        return state.highest >= 1 / self.alpha

    def step(
        self,
        state: ValidityState,
        alarm: ArrayLike,
        score: ArrayLike,
        high: ArrayLike | None = None,
    ) -> tuple[ValidityState, NDArray]:
        """One sample of all streams: arrays (streams,); see `run`."""
        low = np.asarray(score, dtype=float)[:, None]
        top = None if high is None else np.asarray(high, dtype=float)[:, None]
        state, evidence = self.run(state, np.asarray(alarm)[:, None], low, top)
        return state, evidence[:, 0]

    def run(
        self,
        state: ValidityState,
        alarm: ArrayLike,
        score: ArrayLike,
        high: ArrayLike | None = None,
    ) -> tuple[ValidityState, NDArray]:
        """Many samples of all streams.

        Parameters
        ----------
        state : ValidityState
            Of `start` or of the samples before.
        alarm : array (streams, T) of bool
            Whether the detector raised an alarm at a sample, after which it is reset.
        score, high : array (streams, T)
            As for `Detector.run`; NaN while alarms are blanked.

        Returns
        -------
        ValidityState, array (streams, T)
            The next state, and the evidence against the class.

        """
        low, top = self.detector.intervals(state.previous, score, high)
        alarms = np.broadcast_to(np.asarray(alarm, dtype=bool), low.shape).T
        made = np.empty(alarms.shape)
        factors = self.detector.factors(state.previous, low, top)
        for t, (factor, seen, previous) in enumerate(factors):
            products = np.minimum(state.products * factor.T, LARGEST)
            state = replace(
                state,
                products=products,
                previous=previous,
                samples=state.samples + seen,
                length=state.length + seen,
                alarmed=np.maximum(state.alarmed, alarms[t]),
            )
            if alarms[t].any():
                state = self._with_alarms(state, alarms[t])
            if (full := state.samples >= self.block).any():
                state = self._with_blocks(state, full)
            evidence = (state.quiet + state.runs) / 2
            state = replace(state, highest=np.maximum(state.highest, evidence))
            made[t] = evidence
        return state, made.T

    def _with_alarms(self, state: ValidityState, alarm: NDArray) -> ValidityState:
        """After alarms in some streams: their run lengths are evidence."""
        value = np.sqrt(self.arl / np.maximum(state.length, 1)) / 2
        # So much evidence of one run at most: four very short ones void the promise at α = 0.01.
        runs = np.minimum(state.runs * np.minimum(value, 4.0), LARGEST)
        return replace(
            state, runs=np.where(alarm, runs, state.runs), length=np.where(alarm, 0.0, state.length)
        )

    def _with_blocks(self, state: ValidityState, full: NDArray) -> ValidityState:
        """After the last sample of a block in some streams."""
        weighted = (state.products * self.detector.bets.weights).T
        value = np.add.accumulate(weighted, axis=0)[-1]
        # Evidence of a block of samples counts up to this, so that no short fault voids the
        # promise.
        most = np.where(state.alarmed > 0, 1.0, 3.0)
        factor = (1 + np.minimum(value, most)) / 2
        weight = 1 / ((state.blocks + 1) * (state.blocks + 2))
        quiet = np.minimum((state.quiet + weight) * factor, LARGEST)
        return replace(
            state,
            products=np.where(full[:, None], 1.0, state.products),
            samples=np.where(full, 0.0, state.samples),
            alarmed=np.where(full, 0.0, state.alarmed),
            blocks=state.blocks + full,
            quiet=np.where(full, quiet, state.quiet),
        )
