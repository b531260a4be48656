"""`EmulatedArmPi`: an emulation of the real arm, for use where there are no real data.

It adds to the MuJoCo arm what the ideal model lacks. On the input side: delayed movements, joints
that stop at an offset or miss a movement, a dead zone of the servo. On the output side: backlash of
the gear, sensor samples at a low rate, rounded and linearly interpolated, and glitches. The
discrepancy is known, so that inference from outputs alone can be compared with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import interpolated
from retwin.cases.armpi_fpv.twin import KINEMATIC, SENSOR_RATE, ArmPiTwin
from retwin.checks import finite
from retwin.data.segments import Segments
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.times import stride_of, to_samples
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Chunk, Twin, simulate_in_chunks
from retwin.twins.wrappers.wrapper import TwinWrapper

PROBABILITIES = ("missed", "glitch", "repeatable")
"""Settings whose range is 0 to 1."""
TRAVEL = np.array([270.0, 170.0, 170.0, 170.0])
"""Root mean square of the joints' travel in a movement, in command units."""
REPEATING = np.array(
    [
        [0.7, 0.6, 0.5, 0.6],  # stops short
        [0.5, 0.4, 0.5, -0.4],  # friction
        [0.0, 0.6, 0.5, 0.4],  # gravity
        [0.5, -0.4, 0.5, 0.5],  # assembly
    ]
)
"""Weights of the parts of an error that repeats, for each joint."""


@dataclass(frozen=True)
class EmulatedArmPi(TwinWrapper):
    """The arm as the real one behaves.

    The defaults are fitted to set A (benchmarks/results/arm.md). A command unit is 0.24 degrees.

    Parameters
    ----------
    delay : float
        Mean transport delay of a movement in s, beyond the servo's own.
    jitter : float
        Standard deviation of that delay between movements in s (gamma distribution).
    offset : float
        Scale of the error of a joint's final position in command units, one per movement
        (Student's t distribution with 8 degrees of freedom, heavier tails than a Gaussian).
    repeatable : float
        Share, from 0 to 1, of the mean square of `offset` that repeats with the pose and the
        direction of travel: joints stop short of their targets, sag under gravity, stop on the
        side of friction from which they come, and have an assembly error. 0 draws all of it anew.
    bias : float
        Standard deviation in command units of a joint's error that is constant in a trajectory.
    missed : float
        Probability that a joint misses a movement; it makes up for it in the next movement.
    dead_zone : float
        Largest error that the servo leaves uncorrected, in command units.
    backlash : float
        Backlash between gear and joint in command units.
    sensor_rate : float
        Rate of the sensor in Hz, the rate of the data divided by a whole number; sensor samples are
        interpolated linearly.
    phases : tuple of float
        Times of the first sensor sample in s, each shorter than the sensor's period. Trajectories
        take them in turn; the output is held until then.
    noise : float
        Scale of the error of a sensor sample before rounding, in command units (Student's t
        distribution with 3 degrees of freedom).
    resolution : float
        Resolution of the sensor in command units; 0 does not round.
    glitch : float
        Probability that a trajectory has a glitch in one or two sensor samples of one joint.
    glitch_size : float
        Largest error of a glitch in command units (300 are 0.3 m at most).
    arm : ArmPiTwin
        The ideal arm.

    Raises
    ------
    InputError
        A negative or infinite setting, a probability above 1, or a sensor's rate that does not
        divide that of the data.

    """

    delay: float = 0.022
    jitter: float = 0.011
    offset: float = 3.4
    repeatable: float = 0.0
    bias: float = 0.8
    missed: float = 0.015
    dead_zone: float = 1.0
    backlash: float = 0.5
    sensor_rate: float = SENSOR_RATE
    phases: tuple[float, ...] = (0.0,)
    noise: float = 0.25
    resolution: float = 1.0
    glitch: float = 0.06
    glitch_size: float = 300.0
    arm: ArmPiTwin = field(default_factory=ArmPiTwin)

    def __post_init__(self) -> None:
        remedy = "leave it out to have it as in the real arm"
        for each in fields(self):
            if each.name not in ("arm", "phases"):
                most = 1.0 if each.name in PROBABILITIES else math.inf
                finite(
                    each.name, getattr(self, each.name), at_least=0.0, at_most=most, remedy=remedy
                )
        stride_of(self.rate, self.sensor_rate, argument="sensor_rate")
        for phase in self.phases or (math.nan,):
            finite("phases", phase, at_least=0.0, at_most=1 / self.sensor_rate, remedy=remedy)

    @property
    def twin(self) -> Twin:
        """The ideal arm."""
        return self.arm

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        hidden: dict[str, NDArray] | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`: fault on the command, discrepancy, servo, freeze, sensor.

        Parameters
        ----------
        commands, faults, seed, progress
            See `Twin.simulate`.
        hidden : dict, optional
            For tests, filled with the discrepancy: "delay" (n, M) in s, "offset"
            (n, M, d_u) in command units, which includes the trajectory's bias, and "missed"
            (n, M, d_u) bool; and with "angles" (n, T, d_u), the joint angles in command units.

        """
        drawn: list[dict[str, NDArray]] = []

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            rng = np.random.default_rng([seed, 1, chunk.index.start])
            z = self._draw(chunk, rng)
            executed = _effective(chunk.faulty_commands, chunk.segments, z)
            effective = _with_play(executed, self.dead_zone)
            frozen = chunk.frozen
            driven = self.arm.respond(effective, frozen, chunk.failed)
            angles = _with_play(driven, self.backlash / 2)
            drawn.append(z | {"delay": z["delay"] / self.rate, "angles": angles})
            observed = KINEMATIC.position(self._read(angles, chunk, rng))
            return KINEMATIC.position(chunk.commands), observed

        made = simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, emulated=True
        )
        if hidden is not None:
            hidden |= {name: np.concatenate([each[name] for each in drawn]) for name in drawn[0]}
        return made

    def _draw(self, chunk: Chunk, rng: np.random.Generator) -> dict[str, NDArray]:
        """Draw the discrepancy of each movement; delays in samples."""
        segments = chunk.segments
        shape = segments.start.shape
        joints = (*shape, len(self.inputs))
        mean, spread = self.delay * self.rate, max(self.jitter * self.rate, 1e-9)
        delay = rng.gamma((mean / spread) ** 2, spread**2 / max(mean, 1e-9), size=shape)
        constant = self.bias * rng.normal(size=(len(segments), 1, len(self.inputs)))
        offset = self.offset * rng.standard_t(8, size=joints)
        if self.repeatable:
            same = _repeat_errors(chunk.commands, segments) * self.offset * math.sqrt(8 / 6)
            share = self.repeatable
            offset = math.sqrt(1 - share) * offset + math.sqrt(share) * same
        return {
            "delay": delay,
            "offset": constant + offset,
            "missed": rng.random(joints) < self.missed,
        }

    def _read(self, angles: NDArray, chunk: Chunk, rng: np.random.Generator) -> NDArray:
        """Sensor data (n, T, d_u): sampled, rounded, with glitches, and interpolated."""
        n, steps, width = angles.shape
        every = stride_of(self.rate, self.sensor_rate)
        turn = (chunk.index.start + np.arange(n)) % len(self.phases)
        first = np.array([to_samples(phase, self.rate) for phase in self.phases])[turn, None]
        polls = np.minimum(first + np.arange(0, steps, every), steps - 1)
        noise = self.noise * rng.standard_t(3, size=(*polls.shape, width))
        # A frozen joint is held in software: its sensor samples are constant.
        noise[polls[..., None] >= chunk.frozen[:, None]] = 0.0
        samples = np.take_along_axis(angles, polls[..., None], axis=1) + noise
        if self.resolution:
            samples = self.resolution * np.round(samples / self.resolution)
        affected = np.flatnonzero(rng.random(n) < self.glitch)
        count = polls.shape[1]
        for i in affected if count > 3 else ():
            at, joint = rng.integers(1, count - 2), rng.integers(width)
            size = rng.uniform(0.1, 1.0) * self.glitch_size * rng.choice([-1.0, 1.0])
            samples[i, at : at + rng.integers(1, 3), joint] += size
        return interpolated(samples, np.maximum(np.arange(steps) - first, 0), every)


def _repeat_errors(commands: NDArray, segments: Segments) -> NDArray:
    """Errors (n, M, d_u) that the pose and the direction of travel determine, of unit size."""
    first, last = (
        np.stack([interpolated(*pair) for pair in zip(commands, at, strict=True)])
        for at in (segments.start, segments.settle)
    )
    distance = (last - first).astype(float)
    angles = (last - KINEMATIC.centre) * KINEMATIC.scale
    pitch = angles[..., 1:].cumsum(axis=-1)
    reach = (np.sin(pitch) * KINEMATIC.arm.links)[..., ::-1].cumsum(axis=-1)[..., ::-1]
    sag = np.concatenate([np.zeros_like(reach[..., :1]), reach], axis=-1) / sum(KINEMATIC.arm.links)
    parts = (-distance / TRAVEL, -np.sign(distance), 2 * sag, np.ones_like(distance))
    return np.einsum("k...u,ku->...u", np.stack(parts), REPEATING)


def _with_play(path: NDArray, half: float) -> NDArray:
    """`path` (n, T, d) followed with a play of ±`half`: it moves only when an edge pushes it."""
    if half <= 0:
        return path
    out = np.array(path, dtype=float)
    for t in range(1, path.shape[1]):
        out[:, t] = np.clip(out[:, t - 1], path[:, t] - half, path[:, t] + half)
    return out


def _effective(commands: NDArray, segments: Segments, z: dict[str, NDArray]) -> NDArray:
    """Commands (n, T, d_u) that the joints execute: delayed, offset, or missed."""
    out = np.repeat(commands[:, :1].astype(float), commands.shape[1], axis=1)
    time = np.arange(commands.shape[1], dtype=float)
    for i in range(len(commands)):
        before = out[i, 0].copy()
        for m in np.flatnonzero(segments.valid[i]):
            begin, end = segments.start[i, m], segments.settle[i, m]
            first, last = interpolated(commands[i], [begin, end])
            goal = np.where(z["missed"][i, m], before, last + z["offset"][i, m])
            delayed = np.clip(time - z["delay"][i, m], begin, end)
            moved = interpolated(commands[i], delayed) - first
            extent = last - first
            # A joint without a new command drifts to its offset while the others move.
            ramp = ((delayed - begin) / max(end - begin, 1e-9))[:, None]
            fraction = np.where(extent != 0, moved / np.where(extent != 0, extent, 1), ramp)
            inside = time >= begin + z["delay"][i, m]
            out[i, inside] = (before + fraction * (goal - before))[inside]
            before = goal
    return out
