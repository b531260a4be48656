"""Accuracy and cost of the inference of actuator errors from outputs alone.

The discrepancy of the emulated robot is known: 100 trajectories for each of three seeds. Targets:
delays within 1 sample and offsets within 0.3 degrees (mean absolute error), missed segments with an
F1 of 0.95, 90 % intervals with a coverage of 85 to 95 %. A second robot has half the delays and
half their spread. True delays, like offsets, are those of the joints: dead zone and play add to the
drawn delay. The noise model was developed on these seeds; `offset_grid.py` has others. Times are
those of the inference on 54 trajectories, and of the generation of 3600.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from record import median_seconds, record

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, UNIT

COUNT = 100
QUANTILE90 = 1.645
"""Absolute value that a standard normal variable exceeds with probability 0.1."""


class ExactArm:
    """The arm's kinematics as a surrogate without any error."""

    memoryless = True

    def __call__(self, commands: torch.Tensor) -> torch.Tensor:
        """Outputs (n, T, 3) for commands (n, T, 4)."""
        angles = (commands - KINEMATIC.centre) * KINEMATIC.scale
        links = torch.tensor(KINEMATIC.arm.links, dtype=commands.dtype)
        pitch = angles[..., 1:].cumsum(dim=-1)
        radius, height = pitch.sin() @ links, pitch.cos() @ links
        yaw = angles[..., 0]
        return torch.stack(
            [yaw.sin() * radius, -yaw.cos() * radius, KINEMATIC.arm.base + height], dim=-1
        )

    def predict(self, commands: np.ndarray) -> np.ndarray:
        """The same without gradient."""
        return KINEMATIC.position(np.asarray(commands, dtype=np.float64)).astype(np.float32)


def recovered(case: rt.Case, robot: object, seed: int) -> dict[str, float]:
    """Errors of z*, and coverage of its intervals, on one set of trajectories."""
    commands = case.sampler.sample(COUNT, rng=np.random.default_rng(seed))
    hidden: dict[str, np.ndarray] = {}
    made = robot.simulate(commands, seed=seed + 1, hidden=hidden)
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(ExactArm(), commands, segments, rate=made.rate)
    found = case.correction.infer(
        context, torch.as_tensor(made.observed.copy()), torch.as_tensor(made.mask.copy())
    )
    each = np.arange(COUNT)[:, None]
    reached = hidden["angles"][each, np.ceil(segments.stop).astype(int) - 1]
    targets = commands[each, np.ceil(segments.settle).astype(int).clip(max=made.steps - 1)]
    z = found.z.numpy()
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt().numpy()
    missed, detected = hidden["missed"], z[..., 5:] > 0.5
    good = ~missed & ~detected
    offset = z[..., 1:5] - (reached - targets)
    true_delay = joint_delays(hidden["angles"], commands, segments)
    moved = np.isfinite(true_delay)
    delay = z[..., 0] - true_delay
    return {
        "offset MAE (deg)": UNIT * np.abs(offset[good]).mean(),
        "offset MAE of the estimate 0 (deg)": UNIT * np.abs((reached - targets)[good]).mean(),
        "delay MAE (samples)": np.abs(delay[moved]).mean(),
        "missed segments, F1": 2 * (missed & detected).sum() / (missed.sum() + detected.sum()),
        "90 % intervals of offsets, coverage": inside(offset, deviation[..., 1:5])[good].mean(),
        "90 % intervals of delays, coverage": inside(delay, deviation[..., 0])[moved].mean(),
    }


def joint_delays(angles: np.ndarray, commands: np.ndarray, segments: rt.Segments) -> np.ndarray:
    """Delays of the joints, (n, M) in samples; NaN where no joint moved.

    The delay of a joint is the area between its commanded and its actual path, each divided by its
    length. Joints are weighted by the square of the length, as in least squares.
    """
    delays = np.full(segments.start.shape, np.nan)
    for i, m in np.argwhere(segments.valid):
        begin, stop = int(segments.start[i, m]), int(np.ceil(segments.stop[i, m]))
        path, reference = angles[i, begin:stop], commands[i, begin:stop].astype(float)
        length, commanded = path[-1] - path[0], reference[-1] - reference[0]
        moved = np.minimum(np.abs(length), np.abs(commanded)) > 20
        if moved.any():
            area = ((reference - reference[0])[:, moved] / commanded[moved]).sum(axis=0)
            area -= ((path - path[0])[:, moved] / length[moved]).sum(axis=0)
            delays[i, m] = np.average(area, weights=length[moved] ** 2)
    return delays


def inside(error: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Whether the 90 % interval contains the truth."""
    return np.abs(error) < QUANTILE90 * deviation


def main() -> None:
    case = rt.cases.armpi()
    robots = {
        "errors as in set A": case.emulator,
        "half the errors": replace(case.emulator, delay=0.011, jitter=0.005, offset=1.7, bias=0.4),
    }
    columns: dict[str, dict[str, float]] = {}
    for name, robot in robots.items():
        for seed in (11, 21, 31):
            columns[f"{name}, seed {seed}"] = recovered(case, robot, seed)
    figures = next(iter(columns.values()))
    rows = {what: {name: each[what] for name, each in columns.items()} for what in figures}
    record("command_space", f"z* of {COUNT} emulated trajectories, from outputs alone", rows)

    twin = rt.generate(case.twin, case, per_class=100, seed=0)
    ibg = rt.fit_surrogate(twin, seed=0)
    real = rt.generate(case.emulator, case, per_class=6, seed=1)
    rows = {}
    for name, operator in (
        ("delay and offset", case.output_correction),
        ("command space", case.correction),
    ):
        rg = rt.fit_residual(ibg, real, operator, seed=0)
        twin = rt.CorrectedTwin(ibg, rg)
        ways: dict[str, Callable[[], object]] = {
            "infer z* of 54": partial(rt.infer_discrepancy, ibg, real, operator),
            "fit the RG on the 6 healthy ones": partial(
                rt.fit_residual, ibg, real, operator, seed=0
            ),
            "generate 3600": partial(rt.generate, twin, case, per_class=400, seed=2),
        }
        for what, make in ways.items():
            rows[f"{name}: {what} (s)"] = median_seconds(make)
    record("command_space_times", "time of correction, median of three", rows)


if __name__ == "__main__":
    main()
