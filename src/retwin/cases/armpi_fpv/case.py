"""The robot arm of the paper: a Hiwonder ArmPi FPV, four motors in, end-effector position out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.body import ArmBody
from retwin.cases.armpi_fpv.emulator import EmulatedArmPi
from retwin.cases.armpi_fpv.recovery import BIASED, STUCK, recover
from retwin.cases.armpi_fpv.twin import (
    ARM,
    KINEMATIC,
    RAMPS,
    RATE,
    SENSOR_RATE,
    STRAIGHT,
    UNIT,
    ArmPiTwin,
    armpi_parametric,
)
from retwin.cases.case import Case
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.times import stride_of
from retwin.twins.commands.ramps import draw_onsets, ramps_and_holds
from retwin.twins.faults.actuator_faults import ActuatorBias, Fault, Stuck
from retwin.twins.time_step import Timed
from retwin.update.corrections import Chain, CommandSpace, DelayOffset, SampledSensor

# Table 1 and section 5 of the paper: 90 real trajectories, LSTM, 10 runs.
PUBLISHED = {
    "dt": {
        "macro_f1": "0.644 ± 0.036",
        "balanced_accuracy": "0.673 ± 0.036",
        "auroc": "0.931 ± 0.008",
        "healthy_recall": "0.06",
        "generate": "8.5 h",
    },
    "ibg_rg": {
        "macro_f1": "0.753 ± 0.026",
        "balanced_accuracy": "0.754 ± 0.025",
        "auroc": "0.945 ± 0.006",
        "healthy_recall": "0.62",
        "generate": "4–5 min",
    },
}


@dataclass(frozen=True)
class ArmSampler(Timed):
    """Commands as in the published data: every motor ramps to a new target, then all hold.

    Parameters
    ----------
    movements : int, default 5
        Movements per trajectory.
    duration : float, default 10.0
        Duration of a trajectory in s.
    period : float, default 2.0
        Time in s from one onset to the next.
    amplitude : tuple of float
        Largest angle of a target from straight in degrees, one per motor.
    speed : float, default 272.0
        Largest speed of a motor in degrees per s.
    rate : float, default 100.0
        Sample rate in Hz.

    """

    movements: int = 5
    duration: float = 10.0
    period: float = 2.0
    amplitude: tuple[float, ...] = (80.0, 50.0, 50.0, 50.0)
    speed: float = 272.0
    rate: float = RATE

    def sample(
        self, count: int, *, rng: np.random.Generator, onsets: NDArray | None = None
    ) -> NDArray:
        """Draw commands (count, steps, 4) in units of 0.24 degrees; see `CommandSampler.sample`."""
        shape = (count, self.movements, len(self.amplitude))
        ramps = rng.choice(RAMPS, size=shape) * (self.rate / RATE)
        goals = rng.uniform(-1, 1, size=shape) * self.amplitude
        targets = np.empty(shape)
        now = np.zeros((count, len(self.amplitude)))
        for movement in range(self.movements):
            largest = self.speed / self.rate * ramps[:, movement]
            now = now + np.clip(goals[:, movement] - now, -largest, largest)
            now = UNIT * np.round(now / UNIT)
            targets[:, movement] = STRAIGHT - now / UNIT
        given = None if onsets is None else onsets * self.rate
        begins = draw_onsets(count, self.movements, self.period * self.rate, rng=rng, given=given)
        start = np.full((count, len(self.amplitude)), STRAIGHT)
        return ramps_and_holds(start, targets, ramps, begins, self.steps, dtype=np.float32)


ONSET = 0.49
"""Time in s from which a stuck motor is held in the published protocol."""
SIZE = (10.0, 50.0)
"""Lowest and highest magnitude of a motor's bias in the published protocol, in command units."""
FAULTS: dict[str, Fault | None] = {
    HEALTHY: None,
    **{label: Stuck(i, ONSET) for i, label in enumerate(STUCK)},
    **{label: ActuatorBias(i, SIZE) for i, label in enumerate(BIASED)},
}
"""Faults of the nine classes in their fixed order."""
CAUSES: dict[str, Fault] = {
    **{f"{label}_later": Stuck(i, (ONSET, 8.0)) for i, label in enumerate(STUCK)},
    **{f"{label}_small": ActuatorBias(i, (2.0, SIZE[0])) for i, label in enumerate(BIASED)},
}
"""What else may cause the alarms of a monitor: motors that stick during a trajectory, and biases
below the published ones."""


def encoder_noise(trajectories: Trajectories, units: float, seed: int) -> Trajectories:
    """Add the noise of all encoders to the outputs of all trajectories alike.

    Each motor's encoder varies by -1, 0 or 1 times `units` from sample to sample of the sensor, and
    the outputs change by the arm's Jacobian at the commanded pose. Labels are not used: noise on
    stuck motors alone would reveal them.

    Parameters
    ----------
    trajectories : Trajectories
        Trajectories of the arm.
    units : float
        Amplitude of the noise in command units.
    seed : int
        Seed of the noise.

    Returns
    -------
    Trajectories
        The same with other outputs.

    """
    rng = np.random.default_rng(seed)
    observed = trajectories.observed.copy()
    time = np.arange(trajectories.steps)
    every = stride_of(RATE, SENSOR_RATE)
    polls = np.arange(0, trajectories.steps + every, every)
    for i, commands in enumerate(trajectories.commands):
        steps = units * rng.integers(-1, 2, size=(commands.shape[1], len(polls)))
        noise = np.stack([np.interp(time, polls, each) for each in steps], axis=1)
        slopes = ARM.jacobian(KINEMATIC.angles(commands)) * KINEMATIC.scale
        observed[i] += np.einsum("tda,ta->td", slopes, noise)
    return trajectories.replace(observed=observed)


def armpi() -> Case:
    """The case of the paper.

    Returns
    -------
    Case
        The case `armpi`.

    """
    return Case(
        name="armpi",
        title="ArmPi FPV robot arm",
        faults=FAULTS,
        causes=CAUSES,
        twin=ArmPiTwin(),
        emulator=EmulatedArmPi(),
        sampler=ArmSampler(),
        correction=Chain(CommandSpace(), SampledSensor()),
        output_correction=DelayOffset(),
        sensor_rate=SENSOR_RATE,
        recover=recover,
        encoder_noise=encoder_noise,
        published=PUBLISHED,
        parametric=armpi_parametric(),
        body=ArmBody(KINEMATIC),
    )
