"""The robot arm of the paper: a Hiwonder ArmPi FPV, four motors in, end-effector position out."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.body import ArmBody
from retwin.cases.armpi_fpv.classes import BIASED, STUCK
from retwin.cases.armpi_fpv.emulator import EmulatedArmPi
from retwin.cases.armpi_fpv.parameters import armpi_parametric
from retwin.cases.armpi_fpv.recovery import RAMPS, ramp_commands, recover_commands
from retwin.cases.armpi_fpv.twin import ARM, KINEMATIC, POLL, STRAIGHT, UNIT, ArmPiTwin
from retwin.cases.case import Case
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.progress import Progress
from retwin.twins.faults import ActuatorBias, Fault, Stuck, frozen_response
from retwin.twins.samplers import draw_onsets
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
    movements: per trajectory.
    steps: samples per trajectory.
    period: samples from one onset to the next.
    amplitude: greatest angle of a target from straight, in degrees, per motor.
    speed: greatest speed of a motor, in degrees per sample.

    """

    movements: int = 5
    steps: int = 1000
    period: int = 200
    amplitude: tuple[float, ...] = (80.0, 50.0, 50.0, 50.0)
    speed: float = 2.72

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Commands (count, steps, 4) in units; see `CommandSampler`."""
        shape = (count, self.movements, len(self.amplitude))
        ramps = rng.choice(RAMPS, size=shape)
        goals = rng.uniform(-1, 1, size=shape) * self.amplitude
        targets = np.empty(shape)
        now = np.zeros((count, len(self.amplitude)))
        for movement in range(self.movements):
            reach = self.speed * ramps[:, movement]
            now = now + np.clip(goals[:, movement] - now, -reach, reach)
            now = UNIT * np.round(now / UNIT)
            targets[:, movement] = STRAIGHT - now / UNIT
        onsets = draw_onsets(count, self.movements, self.period, rng=rng, timing=timing)
        start = np.full((count, len(self.amplitude)), STRAIGHT)
        return ramp_commands(start, targets, ramps, onsets, self.steps, dtype=np.float32)


def recover(trajectories: Trajectories, progress: Progress | None = None) -> Trajectories:
    """Commands from the desired path (`nominal`); says how many movements stay ambiguous."""
    found = recover_commands(trajectories.nominal, arm=ARM, progress=progress)
    unsure = np.any(found.ambiguous, axis=1)
    if unsure.any():
        warnings.warn(
            f"commands of {unsure.sum()} of {len(unsure)} trajectories are not certain: "
            f"{', '.join(trajectories.ids[unsure][:5])}{' …' if unsure.sum() > 5 else ''}",
            stacklevel=2,
        )
    return trajectories.replace(
        commands=found.commands.astype(np.float32),
        inputs=KINEMATIC.inputs,
        outputs=KINEMATIC.outputs,
    )


ONSET = 49
FAULTS: dict[str, Fault | None] = {
    HEALTHY: None,
    **{label: Stuck(i, ONSET) for i, label in enumerate(STUCK)},
    **{label: ActuatorBias(i) for i, label in enumerate(BIASED)},
}
"""The nine classes in their fixed order; the published protocol freezes at sample 49 (0-based)."""


def encoder_noise(trajectories: Trajectories, units: float, seed: int) -> Trajectories:
    """Readings of a stuck motor that flicker by -1, 0 or 1 times `units`, seen at the output.

    The outputs move by the arm's Jacobian where the arm is told to be, the motor being held.
    """
    rng = np.random.default_rng(seed)
    observed = trajectories.observed.copy()
    polls = np.arange(0, trajectories.steps + POLL, POLL)
    time = np.arange(trajectories.steps)
    for i, label in enumerate(trajectories.labels):
        fault = FAULTS.get(str(label))
        flicker = np.interp(time, polls, units * rng.integers(-1, 2, size=len(polls)))
        if isinstance(fault, Stuck):
            held = frozen_response(trajectories.commands[i : i + 1], [fault])[0]
            effect = ARM.jacobian(KINEMATIC.angles(held))[:, :, fault.actuator] * KINEMATIC.scale
            observed[i] += np.where(time > ONSET, flicker, 0.0)[:, None] * effect
    return trajectories.replace(observed=observed)


def armpi() -> Case:
    """The case of the paper."""
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
