"""Actuator errors from outputs alone over a grid of emulated arms: errors, and joint coverage.

Cells differ in the seed, the size of the errors, whether offsets repeat with the pose and the
direction of travel, the polling phases of the sensor, the program of commands and the sample rate.
Each has at least 400 segments. The offsets are inferred twice: with the learned mean of the prior,
and with a prior of mean zero; the interval of the difference is that of a paired bootstrap over
trajectories. Regions are the 90 % interval of each offset, and the 90 % ellipsoid of all offsets of
a segment together. Arguments are seeds; the default ones
were not used in development, as 11, 21 and 31 were.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np
import torch
from command_space import ExactArm, joint_delays
from record import record
from rich.progress import track
from scipy.stats import chi2, norm

import retwin as rt
from retwin.cases.armpi_fpv.case import ArmSampler
from retwin.cases.armpi_fpv.emulator import EmulatedArmPi
from retwin.cases.armpi_fpv.twin import UNIT, ArmPiTwin
from retwin.update.corrections import fit_correction
from retwin.update.corrections.commands.offset_features import OffsetFeatures
from retwin.update.corrections.commands.problem import CommandProblem

SEGMENTS = 400
LEVEL = 0.9
SIZES = {"as set A": {}, "half": {"delay": 0.011, "jitter": 0.005, "offset": 1.7, "bias": 0.4}}
REPEATING = {"random": 0.0, "repeating": 0.5}
PHASES = {"one phase": (0.0,), "two phases": (0.0, 0.05)}
PROGRAMS = {
    "5 segments": ArmSampler(),
    "8 segments": ArmSampler(8, duration=16.0, amplitude=(105.0, 105.0, 105.0, 105.0)),
}
RATES = {"100 Hz": 100.0, "500 Hz": 500.0}


@dataclass(frozen=True)
class Cell:
    """What was inferred of one cell; errors in degrees and in s, one row per trajectory."""

    offset: np.ndarray
    single: np.ndarray
    joint: np.ndarray
    delay: np.ndarray
    delay_inside: np.ndarray
    missed: np.ndarray
    detected: np.ndarray


def zero_mean(self: OffsetFeatures, problem: CommandProblem) -> torch.Tensor:
    """Features of no size: the mean of the prior stays zero."""
    return torch.zeros(*problem.missed.shape, 1, dtype=torch.float64)


def inferred(robot: EmulatedArmPi, sampler: ArmSampler, seed: int) -> tuple[Cell, Cell]:
    """The cell with the learned mean of the prior, and with mean zero."""
    count = -(-SEGMENTS // sampler.movements)
    commands = sampler.sample(count, rng=np.random.default_rng(seed))
    hidden: dict[str, np.ndarray] = {}
    made = robot.simulate(commands, seed=seed + 1, hidden=hidden)
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(ExactArm(), commands, segments, rate=made.rate)
    observed, mask = torch.as_tensor(made.observed.copy()), torch.as_tensor(made.mask.copy())
    each = np.arange(count)[:, None]
    reached = hidden["angles"][each, np.ceil(segments.stop).astype(int) - 1]
    targets = commands[each, np.ceil(segments.settle).astype(int).clip(max=made.steps - 1)]
    delays = joint_delays(hidden["angles"], commands, segments)
    cells = []
    for learned in (True, False):
        features = OffsetFeatures._features if learned else zero_mean
        with patch.object(OffsetFeatures, "_features", features):
            _, found = fit_correction(rt.cases.armpi().correction, context, observed, mask)
        z, covariance = found.z.numpy(), found.covariance.numpy()
        detected = z[..., 5:] > 0.5
        error = z[..., 1:5] - (reached - targets)
        own = covariance[..., 1:5, 1:5]
        deviation = np.sqrt(np.einsum("nmii->nmi", own))
        distance = (error * np.linalg.solve(own, error[..., None])[..., 0]).sum(axis=-1)
        good = ~hidden["missed"] & ~detected
        whole = good.all(axis=-1)
        half = norm.ppf(0.5 + LEVEL / 2)
        late = z[..., 0] - delays
        cells.append(
            Cell(
                offset=np.where(good, UNIT * np.abs(error), np.nan),
                single=np.where(good, np.abs(error) < half * deviation, np.nan),
                joint=np.where(whole, distance < chi2.ppf(LEVEL, 4), np.nan),
                delay=np.abs(late) / made.rate,
                delay_inside=np.where(
                    np.isfinite(late), np.abs(late) < half * np.sqrt(covariance[..., 0, 0]), np.nan
                ),
                missed=hidden["missed"],
                detected=detected,
            )
        )
    return cells[0], cells[1]


def figures(cell: Cell, zero: Cell) -> dict[str, float]:
    """The figures of one cell."""
    both = cell.missed.sum() + cell.detected.sum()
    rng = np.random.default_rng(0)
    rows = rng.integers(len(cell.offset), size=(2000, len(cell.offset)))
    own, other = (np.nanmean(each.offset, axis=(1, 2)) for each in (cell, zero))
    ratio = own[rows].mean(axis=1) / other[rows].mean(axis=1)
    low, high = np.quantile(ratio, [0.025, 0.975])
    return {
        "offset MAE (deg)": np.nanmean(cell.offset),
        "relative to a prior of mean 0": np.nanmean(cell.offset) / np.nanmean(zero.offset),
        "lower end (95 %)": low,
        "upper end (95 %)": high,
        "single offsets, coverage": np.nanmean(cell.single),
        "offsets of a segment, coverage": np.nanmean(cell.joint),
        "delay MAE (ms)": 1e3 * np.nanmean(cell.delay),
        "delays, coverage": np.nanmean(cell.delay_inside),
        "missed segments, F1": 2 * (cell.missed & cell.detected).sum() / max(1, both),
    }


def main() -> None:
    seeds = tuple(map(int, sys.argv[1:])) or (101, 102, 103)
    axes = (SIZES, REPEATING, PHASES, PROGRAMS, RATES)
    rows: dict[str, dict[str, float]] = {}
    grid = list(itertools.product(seeds, *(each.items() for each in axes)))
    for seed, size, repeating, phase, program, rate in track(grid, "cells"):
        robot = EmulatedArmPi(
            **size[1], repeatable=repeating[1], phases=phase[1], arm=ArmPiTwin(rate=rate[1])
        )
        name = ", ".join(
            [*(each[0] for each in (size, repeating, phase, program, rate)), str(seed)]
        )
        rows[name] = figures(*inferred(robot, replace(program[1], rate=rate[1]), seed))
        print(
            name, {what: round(float(value), 3) for what, value in rows[name].items()}, flush=True
        )
    every = {what: np.array([row[what] for row in rows.values()]) for what in rows[name]}
    summary = {
        "mean": {what: float(values.mean()) for what, values in every.items()},
        "lowest": {what: float(values.min()) for what, values in every.items()},
        "highest": {what: float(values.max()) for what, values in every.items()},
    }
    table = {what: {name: each[what] for name, each in summary.items()} for what in every}
    record("offset_grid", f"{len(rows)} cells of at least {SEGMENTS} segments", table)


if __name__ == "__main__":
    main()
