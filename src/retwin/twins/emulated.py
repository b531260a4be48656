"""`EmulatedArm`: stands in for the real arm where no real data are at hand. Its data are emulated.

A `KinematicTwin` with what the twin is too ideal to have: movements that come late, joints that
stop a little off, movements that a joint misses, readings polled at a low rate, and glitches. The
discrepancy is known, so inference from outputs alone can be held against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.faults import Fault, frozen_response
from retwin.segments import Segments
from retwin.trajectories import Channels, Trajectories
from retwin.twins.kinematic import KinematicTwin
from retwin.twins.protocol import Chunk, Progress, simulate_in_chunks

__all__ = ["EmulatedArm", "JointDiscrepancy"]


@dataclass(frozen=True, eq=False)
class JointDiscrepancy:
    """What goes otherwise than commanded: delay (n, M) in samples, offset (n, M, d_u) in command
    units, missed (n, M, d_u) bool.
    """

    delay: NDArray
    offset: NDArray
    missed: NDArray


@dataclass(frozen=True)
class EmulatedArm:
    """A `KinematicTwin` that errs as a real arm does.

    Parameters
    ----------
    twin: the ideal arm.
    delay: mean and standard deviation of a movement's delay, in samples (a gamma law).
    offset: scale of the position a joint stops off by, in command units (Student's t, 4 degrees of
        freedom: heavier tails than a Gaussian).
    missed: probability that a joint misses a movement and catches up at the next.
    poll: samples per reading; readings are joined linearly.
    glitch: probability that a trajectory has a glitch of one or two readings.
    glitch_size: size of the largest glitch, in output units.

    """

    twin: KinematicTwin
    delay: tuple[float, float] = (3.0, 1.2)
    offset: float = 2.5
    missed: float = 0.015
    poll: int = 10
    glitch: float = 0.15
    glitch_size: float = 0.3

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        return self.twin.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        return self.twin.outputs

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.twin.rate

    def discrepancy(self, segments: Segments, seed: int) -> JointDiscrepancy:
        """The discrepancy that `simulate` draws with this seed; hidden states, for tests only."""
        rng = np.random.default_rng([seed, 1])
        shape = segments.start.shape
        mean, deviation = self.delay
        joints = (*shape, len(self.inputs))
        return JointDiscrepancy(
            delay=rng.gamma((mean / deviation) ** 2, deviation**2 / mean, size=shape),
            offset=self.offset * rng.standard_t(4, size=joints),
            missed=rng.random(joints) < self.missed,
        )

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`: fault on the command, discrepancy, lag, freeze, map, measurement."""
        # Everything at once: the discrepancy is drawn for all trajectories together.
        everything = max(len(commands), 1)

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            effective = _effective(
                chunk.told, chunk.segments, self.discrepancy(chunk.segments, seed)
            )
            response = frozen_response(self.twin.respond(effective), chunk.faults)
            path = self.twin.position(response)
            observed = self._measure(path, np.random.default_rng([seed, 2]))
            return self.twin.position(chunk.commands), observed

        return simulate_in_chunks(
            self,
            run,
            commands,
            faults,
            seed=seed,
            progress=progress,
            size=everything,
            emulated=True,
        )

    def _measure(self, path: NDArray, rng: np.random.Generator) -> NDArray:
        """The path (n, T, 3) polled, with glitches, joined linearly."""
        n, steps, width = path.shape
        time = np.arange(steps, dtype=float)
        polls = np.arange(0, steps, self.poll)
        readings = path[:, polls].copy()
        for i in np.flatnonzero(rng.random(n) < self.glitch):
            at = rng.integers(1, len(polls) - 2)
            direction = rng.normal(size=width)
            size = rng.uniform(0.1, 1.0) * self.glitch_size / np.linalg.norm(direction)
            readings[i, at : at + rng.integers(1, 3)] += size * direction
        right = np.searchsorted(polls, time, side="right").clip(1, len(polls) - 1)
        span = polls[right] - polls[right - 1]
        share = ((time - polls[right - 1]) / span).clip(0, 1)[:, None]
        return readings[:, right - 1] * (1 - share) + readings[:, right] * share


def _effective(told: NDArray, segments: Segments, z: JointDiscrepancy) -> NDArray:
    """What the joints are effectively told (n, T, d_u): late, off, and sometimes not at all."""
    out = told.copy()
    time = np.arange(told.shape[1], dtype=float)
    for i in range(len(told)):
        before = told[i, 0].astype(float)
        for m in np.flatnonzero(segments.valid[i]):
            begin, end = segments.start[i, m], segments.settle[i, m]
            first, last = (_at(told[i], when) for when in (begin, end))
            goal = np.where(z.missed[i, m], before, last + z.offset[i, m])
            late = np.clip(time - z.delay[i, m], begin, end)
            moved = _at(told[i], late) - first
            extent = last - first
            # A joint that is told nothing new drifts to its offset while the others move.
            ramp = ((late - begin) / max(end - begin, 1e-9))[:, None]
            share = np.where(extent != 0, moved / np.where(extent != 0, extent, 1), ramp)
            inside = time >= begin + z.delay[i, m]
            out[i, inside] = (before + share * (goal - before))[inside]
            before = goal
    return out


def _at(values: NDArray, when: NDArray | float) -> NDArray:
    """Values (T, d) at fractional samples, linear between."""
    when = np.asarray(when, dtype=float)
    below = np.clip(np.floor(when).astype(int), 0, len(values) - 2)
    share = (when - below)[..., None]
    return values[below] * (1 - share) + values[below + 1] * share
