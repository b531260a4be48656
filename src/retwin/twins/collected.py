"""`Collected`: what the chunks of a simulation give, put together; what failed is an error."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from retwin.data.measured import MAX_VALUE
from retwin.data.trajectories import Channels, Provenance, Trajectories


class SimulationError(RuntimeError):
    """Some trajectories could not be simulated; the others are attached.

    Attributes
    ----------
    failed : dict of int to str
        The reason of each failure, by the index of the trajectory.
    finished : Trajectories
        The trajectories that were simulated; their ids are their indices.

    """

    def __init__(self, failed: Mapping[int, str], finished: Trajectories) -> None:
        self.failed = dict(failed)
        self.finished = finished
        named = "; ".join(f"trajectory {i}: {why}" for i, why in list(self.failed.items())[:5])
        more = "; …" if len(self.failed) > 5 else ""
        count = len(self.failed) + len(finished)
        super().__init__(f"{len(self.failed)} of {count} simulations failed: {named}{more}")

    def __reduce__(self) -> tuple:
        """Keep both attributes when the error is sent to another process."""
        return SimulationError, (self.failed, self.finished)


class Collected:
    """The outputs of all trajectories, and which of them failed or ended early.

    Chunks may be put from several threads at a time.

    Parameters
    ----------
    commands : ndarray, shape (n, T, d_u)
        The clean commands.
    inputs, outputs : Channels
        Their channels, and those of the outputs.
    rate : float
        Sample rate in Hz.

    Attributes
    ----------
    nominal, observed : ndarray, shape (n, T, d_y)
        The outputs of the chunks so far, in the precision of the commands.
    known : ndarray of int, shape (n)
        Samples that were simulated.
    reasons : dict of int to str
        Why trajectories failed, by their index, in any order.

    """

    def __init__(self, commands: NDArray, inputs: Channels, outputs: Channels, rate: float) -> None:
        self.commands, self.inputs, self.outputs, self.rate = commands, inputs, outputs, rate
        self.nominal = np.empty((*commands.shape[:2], len(outputs)), dtype=commands.dtype)
        self.observed = np.empty_like(self.nominal)
        self.known = np.full(len(commands), commands.shape[1])
        self.reasons: dict[int, str] = {}

    def put(
        self,
        index: slice,
        nominal: NDArray,
        observed: NDArray,
        failed: Mapping[int, str],
        known: Mapping[int, int],
    ) -> None:
        """Enter a chunk; `failed` and `known` count its trajectories from 0, see `Chunk`."""
        self.nominal[index], self.observed[index] = nominal, observed
        for i, reason in {**self._not_finite(index), **failed}.items():
            self.reasons[index.start + i] = reason
        for i, samples in known.items():
            self.known[index.start + i] = samples

    def trajectories(self, labels: NDArray, *, source: str, emulated: bool) -> Trajectories:
        """All of them; `source` describes where they come from.

        Raises
        ------
        SimulationError
            Some failed; the others are attached.

        """
        every = np.arange(len(self.commands))
        good = np.setdiff1d(every, list(self.reasons)) if self.reasons else slice(None)
        commands, observed = self.commands[good], self.observed[good]
        # A copy if the caller may change its own array afterwards.
        owner = commands if commands.base is None else commands.base
        unchanged = not commands.flags.writeable and getattr(commands.base, "base", None) is None
        owned = unchanged and not owner.flags.writeable
        mask = np.arange(observed.shape[1])[:, None] < self.known[good, None, None]
        made = Trajectories(
            commands=commands if owned else commands.copy(),
            nominal=self.nominal[good],
            observed=observed,
            mask=np.broadcast_to(mask, observed.shape),
            ids=np.array([f"{i:05d}" for i in every], dtype=np.str_)[good],
            labels=labels[good],
            rate=self.rate,
            inputs=self.inputs,
            outputs=self.outputs,
            provenance=(Provenance(source),),
            emulated=emulated,
        )
        if self.reasons:
            raise SimulationError(dict(sorted(self.reasons.items())), made)
        return made

    def _not_finite(self, index: slice) -> dict[int, str]:
        """Trajectories of a chunk with outputs that no system has, and from when on."""
        reasons = {}
        for outputs in (self.observed[index], self.nominal[index]):
            # NaN makes these false, and what is larger has squares that are infinite in float32.
            if outputs.min(initial=0.0) > -MAX_VALUE and outputs.max(initial=0.0) < MAX_VALUE:
                continue
            bad = ~(np.abs(outputs) < MAX_VALUE)
            for i in np.flatnonzero(bad.any(axis=(1, 2))):
                sample, channel = np.argwhere(bad[i])[0]
                reasons[int(i)] = (
                    f"{self.outputs.names[channel]} is {outputs[i, sample, channel]:.3g} from "
                    f"{sample / self.rate:g} s on"
                )
        return reasons
