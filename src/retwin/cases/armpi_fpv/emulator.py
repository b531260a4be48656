"""`EmulatedArmPi`: stands in for the real arm where there are no real data; it is emulated.

The MuJoCo arm with what it is too ideal to have. On the way in: movements that come late, joints
that stop a little off or miss a movement, a dead zone in the servo. On the way out: backlash of the
gear, readings polled at a low rate, rounded, joined linearly, and glitches. The discrepancy is
known, so inference from outputs alone can be held against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.twin import KINEMATIC, POLL, ArmPiTwin
from retwin.data.segments import Segments
from retwin.data.trajectories import Channels, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.limits import Limits
from retwin.twins.twin import Chunk, simulate_in_chunks

__all__ = ["EmulatedArmPi"]


@dataclass(frozen=True)
class EmulatedArmPi:
    """The arm as the real one behaves; its defaults are fitted to set A (docs/results.md).

    A command unit is 0.24 degrees, a sample 10 ms.

    Parameters
    ----------
    delay: mean transport delay of a movement, in samples, beyond the servo's own.
    jitter: standard deviation of that delay from movement to movement, in samples (a gamma law).
    offset: scale of the error in the position that a joint stops at, in command units, one per
        movement (Student's t with 8 degrees of freedom: heavier tails than a Gaussian).
    bias: standard deviation of a joint's error that stays for a whole trajectory, in command units.
    missed: probability that a joint misses a movement; it catches up at the next one.
    dead_zone: greatest error that the servo leaves uncorrected, in command units.
    backlash: play between gear and joint, in command units.
    poll: samples per reading of the joints; readings are joined linearly.
    noise: scale of a reading's error before it is rounded, in command units (Student's t with 3
        degrees of freedom).
    resolution: step of a reading, in command units.
    glitch: probability that a trajectory has a glitch, one or two readings of one joint.
    glitch_size: greatest error of such a reading, in command units (300 are 0.3 m at most).
    arm: the ideal arm.

    Raises
    ------
    InputError: a size below 0, a probability outside 0 to 1, readings less than a sample apart.

    """

    delay: float = 2.2
    jitter: float = 1.1
    offset: float = 3.4
    bias: float = 0.8
    missed: float = 0.015
    dead_zone: float = 1.0
    backlash: float = 0.5
    poll: int = POLL
    noise: float = 0.25
    resolution: float = 1.0
    glitch: float = 0.06
    glitch_size: float = 300.0
    arm: ArmPiTwin = field(default_factory=ArmPiTwin)

    def __post_init__(self) -> None:
        for name in (each.name for each in fields(self) if each.name != "arm"):
            least, greatest = (1, np.inf) if name == "poll" else (0, np.inf)
            if name in ("missed", "glitch"):
                greatest = 1
            value = getattr(self, name)
            whole = name != "poll" or isinstance(value, int | np.integer)
            if not (whole and np.isfinite(value) and least <= value <= greatest):
                raise InputError(
                    name,
                    expected=f"a {'whole' if name == 'poll' else 'finite'} number from {least} to "
                    f"{greatest}",
                    got=repr(value),
                    remedy="leave it out to have it as in the real arm",
                )

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        return self.arm.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        return self.arm.outputs

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.arm.rate

    @property
    def limits(self) -> Limits:
        """What the servos accept."""
        return self.arm.limits

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        hidden: dict[str, NDArray] | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`: fault on the command, discrepancy, servo, freeze, map, measurement.

        `hidden`, for tests, is filled with the discrepancy that acted: "delay" (n, M) in samples,
        "offset" (n, M, d_u) in command units with the trajectory's bias in it, "missed" (n, M, d_u)
        bool; and with "angles" (n, T, d_u), where the joints were, in command units.
        """
        acted: list[dict[str, NDArray]] = []

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            rng = np.random.default_rng([seed, 1, chunk.index.start])
            z = self._draw(chunk.segments, rng)
            effective = _play(_effective(chunk.faulty_commands, chunk.segments, z), self.dead_zone)
            frozen = chunk.frozen
            driven = self.arm.respond(effective, frozen, chunk.failed)
            angles = _play(driven, self.backlash / 2)
            acted.append(z | {"angles": angles})
            observed = KINEMATIC.position(self._read(angles, frozen, rng))
            return KINEMATIC.position(chunk.commands), observed

        made = simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, emulated=True
        )
        if hidden is not None:
            hidden |= {name: np.concatenate([each[name] for each in acted]) for name in acted[0]}
        return made

    def _draw(self, segments: Segments, rng: np.random.Generator) -> dict[str, NDArray]:
        """How each movement goes wrong."""
        shape = segments.start.shape
        joints = (*shape, len(self.inputs))
        spread = max(self.jitter, 1e-9)
        late = rng.gamma((self.delay / spread) ** 2, spread**2 / max(self.delay, 1e-9), size=shape)
        lasting = self.bias * rng.normal(size=(len(segments), 1, len(self.inputs)))
        return {
            "delay": late,
            "offset": lasting + self.offset * rng.standard_t(8, size=joints),
            "missed": rng.random(joints) < self.missed,
        }

    def _read(self, angles: NDArray, frozen: NDArray, rng: np.random.Generator) -> NDArray:
        """The joints (n, T, d_u) as they are read: polled, rounded, with glitches, joined."""
        n, steps, width = angles.shape
        polls = np.arange(0, steps, self.poll)
        noise = self.noise * rng.standard_t(3, size=(n, len(polls), width))
        # A frozen joint is held in software: its readings stand still.
        noise[polls[None, :, None] >= frozen[:, None, :]] = 0.0
        readings = angles[:, polls] + noise
        if self.resolution:
            readings = self.resolution * np.round(readings / self.resolution)
        hit = np.flatnonzero(rng.random(n) < self.glitch)
        for i in hit if len(polls) > 3 else ():
            at, joint = rng.integers(1, len(polls) - 2), rng.integers(width)
            size = rng.uniform(0.1, 1.0) * self.glitch_size * rng.choice([-1.0, 1.0])
            readings[i, at : at + rng.integers(1, 3), joint] += size
        time = np.arange(steps)
        right = np.searchsorted(polls, time, side="right").clip(1, max(len(polls) - 1, 1))
        right = np.minimum(right, len(polls) - 1)
        left = np.maximum(right - 1, 0)
        span = np.maximum(polls[right] - polls[left], 1)
        share = ((time - polls[left]) / span).clip(0, 1)[:, None]
        return readings[:, left] * (1 - share) + readings[:, right] * share


def _play(path: NDArray, half: float) -> NDArray:
    """`path` (n, T, d) followed with a play of ±`half`: it moves only when pushed by an edge."""
    if half <= 0:
        return path
    out = np.array(path, dtype=float)
    for t in range(1, path.shape[1]):
        out[:, t] = np.clip(out[:, t - 1], path[:, t] - half, path[:, t] + half)
    return out


def _effective(told: NDArray, segments: Segments, z: dict[str, NDArray]) -> NDArray:
    """What the joints are effectively told (n, T, d_u): late, off, and sometimes not at all."""
    out = np.repeat(told[:, :1].astype(float), told.shape[1], axis=1)
    time = np.arange(told.shape[1], dtype=float)
    for i in range(len(told)):
        before = out[i, 0].copy()
        for m in np.flatnonzero(segments.valid[i]):
            begin, end = segments.start[i, m], segments.settle[i, m]
            first, last = (_at(told[i], when) for when in (begin, end))
            goal = np.where(z["missed"][i, m], before, last + z["offset"][i, m])
            late = np.clip(time - z["delay"][i, m], begin, end)
            moved = _at(told[i], late) - first
            extent = last - first
            # A joint that is told nothing new drifts to its offset while the others move.
            ramp = ((late - begin) / max(end - begin, 1e-9))[:, None]
            share = np.where(extent != 0, moved / np.where(extent != 0, extent, 1), ramp)
            inside = time >= begin + z["delay"][i, m]
            out[i, inside] = (before + share * (goal - before))[inside]
            before = goal
    return out


def _at(values: NDArray, when: NDArray | float) -> NDArray:
    """Values (T, d) at fractional samples, linear between."""
    when = np.asarray(when, dtype=float)
    below = np.clip(np.floor(when).astype(int), 0, max(len(values) - 2, 0))
    above = np.minimum(below + 1, len(values) - 1)
    share = (when - below)[..., None]
    return values[below] * (1 - share) + values[above] * share
