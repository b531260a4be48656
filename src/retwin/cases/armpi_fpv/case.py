"""The robot arm of the paper: a Hiwonder ArmPi FPV, four motors in, end-effector position out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.body import ArmBody
from retwin.cases.armpi_fpv.classes import BIASED, STUCK
from retwin.cases.armpi_fpv.emulator import EmulatedArmPi
from retwin.cases.armpi_fpv.parameters import armpi_parametric
from retwin.cases.armpi_fpv.ramps import RAMPS, ramp_commands
from retwin.cases.armpi_fpv.recorded import recover
from retwin.cases.armpi_fpv.twin import ARM, KINEMATIC, POLL, STRAIGHT, UNIT, ArmPiTwin
from retwin.cases.case import Case
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.twins.faults import ActuatorBias, Fault, Stuck, frozen_response
from retwin.twins.ramps import draw_onsets
from retwin.update.corrections import Chain, CommandSpace, DelayOffset, SampledSensor

__all__ = ["ArmSampler", "armpi"]

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
class ArmSampler:
    """Commands as in the published data: every motor ramps to a new target, then all hold.

    Parameters
    ----------
    movements : int, default 5
        Movements per trajectory.
    steps : int, default 1000
        Samples per trajectory.
    period : int, default 200
        Samples from one onset to the next.
    amplitude : tuple of float
        Largest angle of a target from straight in degrees, one per motor.
    speed : float, default 2.72
        Largest speed of a motor in degrees per sample.

    """

    movements: int = 5
    steps: int = 1000
    period: int = 200
    amplitude: tuple[float, ...] = (80.0, 50.0, 50.0, 50.0)
    speed: float = 2.72

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Draw commands (count, steps, 4) in units of 0.24 degrees; see `CommandSampler.sample`."""
        shape = (count, self.movements, len(self.amplitude))
        ramps = rng.choice(RAMPS, size=shape)
        goals = rng.uniform(-1, 1, size=shape) * self.amplitude
        targets = np.empty(shape)
        now = np.zeros((count, len(self.amplitude)))
        for movement in range(self.movements):
            largest = self.speed * ramps[:, movement]
            now = now + np.clip(goals[:, movement] - now, -largest, largest)
            now = UNIT * np.round(now / UNIT)
            targets[:, movement] = STRAIGHT - now / UNIT
        onsets = draw_onsets(count, self.movements, self.period, rng=rng, timing=timing)
        start = np.full((count, len(self.amplitude)), STRAIGHT)
        return ramp_commands(start, targets, ramps, onsets, self.steps, dtype=np.float32)


ONSET = 49
"""Sample, counted from 0, from which a stuck motor is held in the published protocol."""
FAULTS: dict[str, Fault | None] = {
    HEALTHY: None,
    **{label: Stuck(i, ONSET) for i, label in enumerate(STUCK)},
    **{label: ActuatorBias(i) for i, label in enumerate(BIASED)},
}
"""Faults of the nine classes in their fixed order."""


def encoder_noise(trajectories: Trajectories, units: float, seed: int) -> Trajectories:
    """Add encoder noise of stuck motors to the outputs.

    The encoder of a held motor varies by -1, 0 or 1 times `units` from sample to sample of the
    sensor. The outputs change by the arm's Jacobian at the commanded pose with the motor held.

    Parameters
    ----------
    trajectories : Trajectories
        Trajectories of the arm; those of other classes stay unchanged.
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
    polls = np.arange(0, trajectories.steps + POLL, POLL)
    time = np.arange(trajectories.steps)
    for i, label in enumerate(trajectories.labels):
        fault = FAULTS.get(str(label))
        noise = np.interp(time, polls, units * rng.integers(-1, 2, size=len(polls)))
        if isinstance(fault, Stuck):
            held = frozen_response(trajectories.commands[i : i + 1], [fault])[0]
            effect = ARM.jacobian(KINEMATIC.angles(held))[:, :, fault.actuator] * KINEMATIC.scale
            observed[i] += np.where(time > ONSET, noise, 0.0)[:, None] * effect
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
        twin=ArmPiTwin(),
        emulator=EmulatedArmPi(),
        sampler=ArmSampler(),
        correction=Chain(CommandSpace(), SampledSensor()),
        output_correction=DelayOffset(),
        sensor_rate=KINEMATIC.rate / POLL,
        recover=recover,
        encoder_noise=encoder_noise,
        published=PUBLISHED,
        parametric=armpi_parametric(),
        body=ArmBody(KINEMATIC),
    )
