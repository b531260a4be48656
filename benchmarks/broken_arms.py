"""Actuator errors from outputs alone, of arms whose errors are not those of the model.

The prior of `CommandSpace` has independent normal errors about a constant. Here joints stop short
by direction and pose, sag under gravity (so that their errors are correlated), have heavy tails, or
drift from run to run; joints have delays of their own and approach their targets exponentially,
which no ramp does. Programs are one of eight movements in five runs, inferred pooled and each run
alone, and twelve of five movements without a replicate. Arguments are the number of seeds, and what
is broken (all by default).
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import torch
from command_space import ExactArm
from numpy.typing import NDArray
from record import record
from rich.progress import track
from scipy.stats import chi2, norm

import retwin as rt
from retwin.arrays import interpolated
from retwin.cases.armpi_fpv.case import ArmSampler
from retwin.cases.armpi_fpv.emulator import _effective
from retwin.cases.armpi_fpv.twin import KINEMATIC, UNIT

LEVEL = 0.9
RUNS, DEGREE = 5, 1 / UNIT
Errors = Callable[[np.random.Generator, NDArray, NDArray, NDArray], NDArray]
"""From targets, distances and conditions (n, M) to the offsets (n, M, d_u) in degrees."""


def independent(rng: np.random.Generator, goal: NDArray, way: NDArray, same: NDArray) -> NDArray:
    """What is fitted: a constant, effects of conditions, and errors from run to run."""
    effect = 0.7 * rng.normal(size=(same.max() + 1, 4))
    return 0.6 * rng.normal(size=4) + effect[same] + 0.25 * rng.normal(size=goal.shape)


def stops_short(rng: np.random.Generator, goal: NDArray, way: NDArray, same: NDArray) -> NDArray:
    """Joints stop before their targets, more so in some poses, and stay there when not moved."""
    size, centre = rng.uniform(0.3, 1.5, 4), rng.normal(size=4)
    lever = 0.4 + np.cos((goal - KINEMATIC.centre) * KINEMATIC.scale + centre) ** 2
    short = -size * np.sign(way) * np.tanh(np.abs(way) / 60) * lever
    return short + 0.4 * rng.normal(size=4) + 0.2 * rng.normal(size=goal.shape)


def sags(rng: np.random.Generator, goal: NDArray, way: NDArray, same: NDArray) -> NDArray:
    """Joints yield to gravity: their errors are correlated, and largest where the arm is out."""
    pitch = ((goal - KINEMATIC.centre) * KINEMATIC.scale)[..., 1:].cumsum(axis=-1)
    reach = (np.sin(pitch) * KINEMATIC.arm.links)[..., ::-1].cumsum(axis=-1)[..., ::-1]
    yields = np.concatenate([np.zeros_like(reach[..., :1]), reach / reach.std()], axis=-1)
    play = -0.3 * np.sign(way)
    return yields * rng.uniform(0.3, 1.2, 4) + play + 0.25 * rng.normal(size=goal.shape)


def heavy_tails(rng: np.random.Generator, goal: NDArray, way: NDArray, same: NDArray) -> NDArray:
    """Effects of conditions and errors are Student's with three degrees of freedom."""
    effect = 0.45 * rng.standard_t(3, size=(same.max() + 1, 4))
    return 0.5 * rng.normal(size=4) + effect[same] + 0.15 * rng.standard_t(3, size=goal.shape)


def drifts(rng: np.random.Generator, goal: NDArray, way: NDArray, same: NDArray) -> NDArray:
    """All joints drift from run to run, by a random walk."""
    walk = 0.35 * rng.normal(size=(len(goal), 1, 4)).cumsum(axis=0)
    effect = 0.6 * rng.normal(size=(same.max() + 1, 4))
    return walk + effect[same] + 0.15 * rng.normal(size=goal.shape)


BROKEN: dict[str, Errors] = {
    "nothing": independent,
    "stops short": stops_short,
    "gravity": sags,
    "heavy tails": heavy_tails,
    "drift": drifts,
}


def outputs(
    commands: NDArray, segments: rt.Segments, errors: Errors, rng: np.random.Generator
) -> tuple[NDArray, NDArray, NDArray]:
    """Outputs (n, T, 3), and the offsets and missed segments (n, M, 4) that they are to show."""
    ends = (segments.start, segments.settle)
    first, last = (
        np.stack([interpolated(*pair) for pair in zip(commands, at, strict=True)]) for at in ends
    )
    joined = np.concatenate([first, last], axis=-1).reshape(-1, 8)
    same = np.unique(joined, axis=0, return_inverse=True)[1].reshape(segments.start.shape)
    offset = DEGREE * errors(rng, last, last - first, same)
    missed = rng.random(offset.shape) < 0.01
    effect = rng.gamma(4.0, 1.0, size=same.max() + 1)
    delay = effect[same] + 0.5 * rng.normal(size=same.shape)
    path = _effective(commands, segments, {"offset": offset, "missed": missed, "delay": delay})
    share = rng.uniform(0.2, 0.5, 4)  # of what is left, in a sample: bandwidths of 4 to 8 Hz
    for t in range(1, path.shape[1]):
        path[:, t] = path[:, t - 1] + share * (path[:, t] - path[:, t - 1])
    polls = np.round(path[:, ::10] + 0.2 * rng.standard_t(3, size=path[:, ::10].shape))
    steps = np.arange(path.shape[1])[None].repeat(len(path), 0)
    reached = path[np.arange(len(path))[:, None], np.ceil(segments.stop).astype(int) - 1]
    return KINEMATIC.position(interpolated(polls, steps, 10)), reached - last, missed


def scored(data: rt.Trajectories, offset: NDArray, missed: NDArray) -> list[NDArray]:
    """Absolute errors in degrees, single and joint coverage; NaN where a segment was missed."""
    _, found = rt.infer_discrepancy(ExactArm(), data, rt.cases.armpi().correction)
    z, own = found.z.numpy(), found.covariance.numpy()[..., 1:5, 1:5]
    error = z[..., 1:5] - offset
    good = ~missed & (z[..., 5:] < 0.5)
    distance = (error * np.linalg.solve(own, error[..., None])[..., 0]).sum(axis=-1)
    deviation = np.sqrt(np.einsum("nmii->nmi", own))
    inside = np.abs(error) < norm.ppf(0.5 + LEVEL / 2) * deviation
    return [
        np.where(good, UNIT * np.abs(error), np.nan),
        np.where(good, inside, np.nan),
        np.where(good.all(axis=-1), distance < chi2.ppf(LEVEL, 4), np.nan),
    ]


def cell(errors: Errors, seed: int, repeated: bool) -> dict[str, list[NDArray]]:
    """Scores of one arm: of runs of one program pooled and alone, or of many programs."""
    rng = np.random.default_rng(seed)
    if repeated:
        sampler = ArmSampler(8, duration=16.0)
        commands = sampler.sample(1, rng=rng).repeat(RUNS, axis=0)
    else:
        commands = ArmSampler().sample(12, rng=rng)
    segments = rt.Segments.from_commands(commands)
    observed, offset, missed = outputs(commands, segments, errors, rng)
    data = rt.Trajectories(
        commands=commands,
        nominal=KINEMATIC.position(commands).astype(np.float32),
        observed=observed.astype(np.float32),
        rate=100.0,
        inputs=KINEMATIC.inputs,
        outputs=KINEMATIC.outputs,
    )
    if not repeated:
        return {"many programs": scored(data, offset, missed)}
    alone = [scored(data[[i]], offset[[i]], missed[[i]]) for i in range(RUNS)]
    return {
        "pooled": scored(data, offset, missed),
        "alone": [np.concatenate(each) for each in zip(*alone, strict=True)],
    }


def main() -> None:
    torch.set_num_threads(1)
    seeds = range(int(sys.argv[1]) if len(sys.argv) > 1 else 6)
    names = sys.argv[2:] or list(BROKEN)
    rows: dict[str, dict[str, float]] = {}
    for name in names:
        found: dict[str, list[list[NDArray]]] = {}
        for seed in track(seeds, name):
            for repeated in (True, False):
                for how, scores in cell(BROKEN[name], seed, repeated).items():
                    found.setdefault(how, []).append(scores)
        for how, cells in found.items():
            means = [
                np.nanmean(np.concatenate([each.ravel() for each in part]))
                for part in zip(*cells, strict=True)
            ]
            columns = ("MAE (deg)", "singly", "jointly")
            rows[f"{name}, {how}"] = dict(zip(columns, map(float, means), strict=True))
            print(name, how, np.round(means, 3), flush=True)
    record("broken_arms", f"arms that break the model, {len(seeds)} seeds", rows)


if __name__ == "__main__":
    main()
