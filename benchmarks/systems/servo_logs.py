"""Logs of the motors of two arms: outputs are the gripper's position, the joints are hidden truth.

Five runs of one program of eight movements; a run of each arm tests. The motors are polled at
10 Hz, and forward kinematics of their readings, with straight lines between these, are the outputs.
Readings that are no angle of a motor are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, RATE, UNIT
from retwin.twins.wrappers.command_side import CommandSide, command_side_parameters
from systems.arm import Kinematics
from systems.system import System

STEPS = 1640
MOTORS = (6, 5, 4, 3)
"""Columns of motors 1 to 4 after that of the time."""
TESTED = ("20240506_144354", "20240508_005457")
MOVES = 20.0
"""Command units from which on a motor moves, and may miss its segment."""
QUANTILE90 = 1.6449


class Run:
    """One run: commands (T, 4), the readings of the motors between polls, and what they reached."""

    def __init__(self, folder: Path) -> None:
        def table(name: str) -> NDArray:
            file = folder / f"trajectory_monitoring_{name}.csv"
            return np.loadtxt(file, delimiter=",", skiprows=1)

        told, ramps, polled = table("cmd"), table("cmd_duration"), table("position")
        begin = polled[polled[:, 0] <= told[0, 0], 0][-1]
        onsets, polls = RATE * (told[:, 0] - begin), RATE * (polled[:, 0] - begin)
        targets, readings = told[:, MOTORS], polled[:, MOTORS]
        rest = np.median(readings[polled[:, 0] < told[0, 0]], axis=0)
        # The command before the first one: the program's last, unless the arm is elsewhere.
        far = np.abs(targets - rest).max(axis=1)
        start = targets[-1] if far[-1] < 15 else targets[far.argmin()]
        before, time = np.vstack([start, targets[:-1]]), np.arange(STEPS)
        share = (time[:, None, None] - onsets[:, None]) / (RATE / 1000 * ramps[:, MOTORS])
        self.id = folder.name
        self.commands = start + (np.clip(share, 0, 1) * (targets - before)).sum(axis=1)
        good = (readings >= 0) & (readings <= 1000)
        kept = [(polls[each], y[each]) for each, y in zip(good.T, readings.T, strict=True)]
        self.joints = np.stack([np.interp(time, *each) for each in kept], axis=1)
        bad = np.stack([np.interp(time, polls, ~each) for each in good.T])
        self.seen = (bad == 0).all(axis=0)
        ends = np.append(onsets[1:], STEPS)
        steady = [(polls > end - 50) & (polls <= end) for end in ends]
        reached = np.stack([np.median(readings[each], axis=0) for each in steady])
        was = np.vstack([rest, reached[:-1]])
        missed = np.abs(targets - before) >= MOVES
        missed &= np.abs(reached - was) < 0.25 * np.abs(targets - was)
        self.offsets = np.where(missed, np.nan, reached - targets)


def records(runs: list[Run]) -> rt.Trajectories:
    outputs = KINEMATIC.position(np.stack([run.joints for run in runs]))
    seen = np.stack([run.seen for run in runs])[..., None]
    commands = np.stack([run.commands for run in runs])
    return rt.Trajectories(
        commands.astype(np.float32),
        KINEMATIC.position(commands),
        np.where(seen, outputs, np.nan),
        RATE,
        labels=np.full(len(runs), "Healthy"),
        ids=np.array([run.id for run in runs]),
        inputs=KINEMATIC.inputs,
        outputs=KINEMATIC.outputs,
    )


def hidden_truth(model: rt.CorrectedTwin, tests: rt.Trajectories, runs: list[Run]) -> str:
    """Errors of the offsets of joints that are inferred from outputs, in degrees."""
    correction = model.residual.correction
    _, found = rt.infer_discrepancy(model.surrogate, tests, correction)
    offsets = np.stack([run.offsets for run in runs])
    error = np.abs(found.z[..., 1:5].numpy() - offsets)
    variance = found.covariance.diagonal(dim1=-2, dim2=-1)[..., 1:5].numpy()
    known = np.isfinite(error) & (found.z[..., 5:].numpy() < 0.5)
    held = (error < QUANTILE90 * np.sqrt(variance))[known].mean()
    return (
        f"offsets of joints {UNIT * error[known].mean():.2f}°, knowing nothing "
        f"{UNIT * np.abs(offsets)[known].mean():.2f}°; 90 % intervals hold {held:.2f}"
    )


def servo_logs(folder: Path) -> System:
    case, logs = rt.cases.armpi(), folder / "servo_logs"
    found = [Run(each.parent) for each in sorted(logs.rglob("trajectory_monitoring_cmd.csv"))]
    tested = [run for run in found if run.id in TESTED]
    arm = CommandSide(KINEMATIC, nominal=KINEMATIC.position)
    free = command_side_parameters(KINEMATIC.inputs, delay=(0.0, 0.2), offset=25.0)
    return System(
        rt.ParametricTwin(arm, free),
        records([run for run in found if run.id not in TESTED]),
        {"arms, motor logs": records(tested)},
        "mm",
        1000.0,
        corrections={"delay/offset": case.output_correction, "command space": case.correction},
        surrogate=Kinematics(),
        hidden_truth=lambda model, tests: hidden_truth(model, tests, tested),
    )


SYSTEMS = {"servo_logs": servo_logs}
