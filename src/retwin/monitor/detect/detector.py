"""E-detectors: alarms for changes, with a guaranteed average run length to a false alarm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import at_least, instance, one_of, require, whole
from retwin.monitor.detect.bets import ALTERNATIVES, Alternative, Bets
from retwin.monitor.detect.slack import Slack

LARGEST = 1e280
"""Evidence counts up to this; one further factor does not overflow."""


@dataclass(frozen=True)
class DetectorState:
    """What a detector remembers; all of it.

    Attributes
    ----------
    evidence : array (streams, J)
        The e-detector of each alternative, at least 0.
    previous : array (streams,)
        The last score if it was measured, else 0.

    """

    evidence: NDArray
    previous: NDArray


@dataclass(frozen=True)
class Detector:
    """A mixture of e-detectors over location, scale, tails, dependence and repetition of scores.

    With the bets L_j of alternative j, whose expectation given the past is at most 1 for all
    distributions of the class `slack`,

        M_j(t) = (M_j(t-1) + 1) L_j(t),   M(t) = sum of w_j M_j(t)

    (Shiryaev–Roberts), or with max(M, 1) in place of M + 1 (CUSUM). Then M(t) - t is a
    supermartingale, so that on average at least A samples pass until M(t) reaches A, for each
    member of the class and without any limit (Shin, Ramdas and Rinaldo, E-detectors: a
    nonparametric framework for sequential change detection, 2022).
    The probability of a false alarm within the first t samples is at most t/A.

    A missing sample (NaN) leaves M as it is: it multiplies by 1, and nothing is added. With N_t
    measured samples among t, M(t) - N_t then is a supermartingale, as long as the class holds given
    the past and given that the sample is measured. The average number of *measured* samples until
    a false alarm is therefore at least A, and the time is longer still.

    A score may be an interval: of ties, or of a rank. Its bet is the mean of the bet over the
    interval, which is the expectation under a score drawn at random inside it; nothing is drawn.

    Evidence is stored as it is rather than as its logarithm, bounded by 1e280; a bet is never 0 and
    below 1e24. A step only looks up, adds, multiplies and divides, since the last digit of an
    exponential or a logarithm may depend on its place in an array: bytes do not depend on how
    samples and streams are grouped into calls.

    Parameters
    ----------
    slack : Slack or sequence of Slack
        One for all streams, or one per stream.
    kind : "shiryaev_roberts" or "cusum"
        The former is faster for the same guarantee.
    alternatives : tuple of tuple of Alternative
        Families of alternatives.

    Attributes
    ----------
    bets : Bets
        The bets on all alternatives against each different class of `slack`.
    which : NDArray
        (streams,) or (1,), the number of each stream's class among these.

    """

    slack: Slack | Sequence[Slack] = field(default_factory=Slack)
    kind: Literal["shiryaev_roberts", "cusum"] = "shiryaev_roberts"
    alternatives: tuple[tuple[Alternative, ...], ...] = ALTERNATIVES
    bets: Bets = field(init=False, repr=False, compare=False)
    which: NDArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        one_of("kind", self.kind, ("shiryaev_roberts", "cusum"))
        given = [self.slack] if isinstance(self.slack, Slack) else list(self.slack)
        at_least("slack", given, 1, "classes", remedy="give one for all streams, or one for each")
        for each in given:
            instance("slack", each, Slack, remedy="use Slack(kappa, shift)")
        at_least("alternatives", self.alternatives, 1, "families", remedy="leave the default")
        for family in self.alternatives:
            at_least("alternatives", family, 1, "members of a family", remedy="leave it out")
        different = tuple(dict.fromkeys(given))
        which = np.array([different.index(each) for each in given], dtype=np.intp)
        families = tuple(tuple(family) for family in self.alternatives)
        object.__setattr__(self, "bets", Bets.of(different, families))
        object.__setattr__(self, "which", which)

    def start(self, streams: int) -> DetectorState:
        """The state before the first sample, and after a reset."""
        count = whole("streams", streams, at_least=1)
        expected = f"{len(self.which)}, as many as there are slacks"
        remedy = "give one slack for all streams, or one for each"
        require(
            len(self.which) in (1, count), "streams", expected=expected, got=count, remedy=remedy
        )
        return DetectorState(np.zeros((count, len(self.bets.weights))), np.zeros(count))

    def reset(self, state: DetectorState, where: NDArray) -> DetectorState:
        """Begin anew in the streams (streams,) where `where` is True: after an alarm."""
        evidence = np.where(where[:, None], 0.0, state.evidence)
        return DetectorState(evidence, np.where(where, 0.0, state.previous))

    def change(self, number: int) -> str:
        """What an alternative, by its number of J, is a change of."""
        return [each for family in self.alternatives for each in family][number].change

    def step(
        self, state: DetectorState, score: ArrayLike, high: ArrayLike | None = None
    ) -> tuple[DetectorState, NDArray]:
        """One sample of all streams.

        Parameters
        ----------
        state : DetectorState
            Of `start` or of the sample before. It is not changed.
        score : array (streams,)
            Standard Gaussian scores, or the lower ends of intervals. NaN is missing; infinite and
            other large ones count as 4.
        high : array (streams,), optional
            Upper ends of the intervals.

        Returns
        -------
        DetectorState, array (streams,)
            The next state, and the evidence M, 0 before the first measured sample. An alarm is due
            where it is at least the ARL.

        """
        low = np.asarray(score, dtype=float)[:, None]
        top = None if high is None else np.asarray(high, dtype=float)[:, None]
        state, evidence = self.run(state, low, top)
        return state, evidence[:, 0]

    def run(
        self, state: DetectorState, score: ArrayLike, high: ArrayLike | None = None
    ) -> tuple[DetectorState, NDArray]:
        """Many samples of all streams: arrays (streams, T) in place of (streams,) of `step`.

        The bytes are those of T calls of `step`. Memory grows with T: give long records in parts.
        """
        low, top = self.intervals(state.previous, score, high)
        evidence, made = state.evidence.T, np.empty(low.shape[::-1])
        previous = state.previous
        weights = self.bets.weights[:, None]
        add = np.maximum if self.kind == "cusum" else np.add
        for t, (factor, seen, last) in enumerate(self.factors(previous, low, top)):
            evidence, previous = add(evidence, seen), last
            evidence *= factor
            np.minimum(evidence, LARGEST, out=evidence)
            # A running sum: unlike that of np.sum, its order does not depend on the shape.
            made[t] = np.add.accumulate(evidence * weights, axis=0)[-1]
        return DetectorState(evidence.T, previous), made.T

    def evidence_of_end(
        self,
        evidence: NDArray,
        change: NDArray,
        previous: NDArray,
        score: ArrayLike,
        high: ArrayLike | None = None,
    ) -> NDArray:
        """Evidence (n, T) that one change in each of n machines is over, by CUSUM.

        It is M of the alternative's bets upside down: while the change lasts it reaches A after
        about A samples, on average, or later.

        Parameters
        ----------
        evidence : array (n,)
            After the samples before; 1 at first.
        change : array (n, 2)
            Of each machine, a stream and the number of an alternative.
        previous : array (streams,)
            The scores before, see `DetectorState`.
        score, high : array (streams, T)
            See `run`.

        """
        low, top = self.intervals(previous, score, high)
        stream, number = change.T
        made = np.empty((low.shape[1], len(evidence)))
        for t, (factor, _, _) in enumerate(self.factors(previous, low, top)):
            evidence = np.minimum(np.maximum(evidence, 1.0) / factor[number, stream], LARGEST)
            made[t] = evidence
        return made.T

    def intervals(
        self, previous: NDArray, score: ArrayLike, high: ArrayLike | None
    ) -> tuple[NDArray, NDArray]:
        """Lower and upper ends (streams, T) of scores, which are checked."""
        low = np.asarray(score, dtype=float)
        top = low if high is None else np.asarray(high, dtype=float)
        fits = low.ndim == 2 and low.shape == top.shape and len(low) == len(previous)
        expected = f"scores of {len(previous)} streams, upper ends of the same shape"
        got = f"shapes {low.shape} and {top.shape}"
        remedy = "start a state for as many streams as there are"
        require(fits, "score", expected=expected, got=got, remedy=remedy)
        expected = "lower ends of intervals that are not above the upper ones"
        got = "at least one that is"
        remedy = "give what `ConformalScores.score` returns, in its order"
        require(not np.any(low > top), "score", expected=expected, got=got, remedy=remedy)
        return low, top

    def factors(
        self, previous: NDArray, low: NDArray, high: NDArray
    ) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
        """Per sample: factors (J, streams), 1 where one is measured and else 0, and scores.

        The latter two are (streams,). `previous` are the scores before the first sample.
        """
        bets = self.bets
        first, last = (each.T.copy() for each in bets.position(low, high))
        centre = (np.clip(low, -9, 9) + np.clip(high, -9, 9)) / 2
        seen = ~np.isnan(centre)
        centre = np.where(seen, centre, 0.0).T.copy()
        for a, b, there, score in zip(first, last, seen.T.astype(float), centre, strict=True):
            offset = bets.offset(self.which, previous)
            a, b = a + offset, b + offset
            factor = np.take(bets.integrals, b, axis=1)
            factor -= np.take(bets.integrals, a, axis=1)
            factor /= bets.mass[b] - bets.mass[a]
            if not there.all():
                factor[:, there == 0] = 1.0
            previous = score
            yield factor, there, previous
