"""How well are actuators' errors told from outputs alone, and what does it cost?

On the emulated robot, whose discrepancy is known: 100 trajectories for each of three seeds.
Targets: delays within 1 sample and offsets within 0.3 degrees (mean absolute error), missed
movements with an F1 of 0.95, 90 % intervals that cover 85 to 95 %. Beside them the same robot, half
as late and half as uneven. How late a movement was is seen on the joints, as their offsets are:
dead zone and play add to the delay that was drawn. How many looks readings are worth was chosen
with seed 11. Then the seconds for inference on 54 trajectories, and for generating 3600.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from record import record

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, UNIT
from retwin.cli.benchmark import median_seconds

COUNT = 100
SURE = 1.645


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
    """What is found of one set of trajectories, beside what was true."""
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
    missed, called = hidden["missed"], z[..., 5:] > 0.5
    good = ~missed & ~called
    offset = z[..., 1:5] - (reached - targets)
    late = lateness(hidden["angles"], commands, segments)
    moved = np.isfinite(late)
    delay = z[..., 0] - late
    return {
        "offset MAE (deg)": UNIT * np.abs(offset[good]).mean(),
        "knowing nothing (deg)": UNIT * np.abs((reached - targets)[good]).mean(),
        "delay MAE (samples)": np.abs(delay[moved]).mean(),
        "missed movements, F1": 2 * (missed & called).sum() / (missed.sum() + called.sum()),
        "90 % intervals of offsets cover": inside(offset, deviation[..., 1:5])[good].mean(),
        "90 % intervals of delays cover": inside(delay, deviation[..., 0])[moved].mean(),
    }


def lateness(angles: np.ndarray, commands: np.ndarray, segments: rt.Segments) -> np.ndarray:
    """How late the joints were, (n, M) in samples; NaN where none moved.

    A joint's delay is the area between the shares of its way that it was told to have gone and that
    it has gone; joints count by the square of their way, as in least squares.
    """
    late = np.full(segments.start.shape, np.nan)
    for i, m in np.argwhere(segments.valid):
        begin, stop = int(segments.start[i, m]), int(np.ceil(segments.stop[i, m]))
        path, told = angles[i, begin:stop], commands[i, begin:stop].astype(float)
        way, meant = path[-1] - path[0], told[-1] - told[0]
        moved = np.minimum(np.abs(way), np.abs(meant)) > 20
        if moved.any():
            behind = ((told - told[0])[:, moved] / meant[moved]).sum(axis=0)
            behind -= ((path - path[0])[:, moved] / way[moved]).sum(axis=0)
            late[i, m] = np.average(behind, weights=way[moved] ** 2)
    return late


def inside(error: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Whether the truth lies in the 90 % interval."""
    return np.abs(error) < SURE * deviation


def main() -> None:
    case = rt.cases.armpi()
    robots = {
        "as set A": case.emulator,
        "half as bad": replace(case.emulator, delay=1.1, jitter=0.5, offset=1.7, bias=0.4),
    }
    columns: dict[str, dict[str, float]] = {}
    for name, robot in robots.items():
        for seed in (11, 21, 31):
            columns[f"{name}, seed {seed}"] = recovered(case, robot, seed)
    figures = next(iter(columns.values()))
    rows = {what: {name: each[what] for name, each in columns.items()} for what in figures}
    record("command_space", f"z* of {COUNT} emulated trajectories, outputs only", rows)

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
    record("command_space_times", "cost of correction, median of three", rows)


if __name__ == "__main__":
    main()
