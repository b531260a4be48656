"""Trajectories that are chosen by their expected information, compared with random ones.

On the emulated arm half of the mean square of the offsets repeats with the pose and the direction
of travel. The error is that of the predicted mean position at rest, compared with the same arm with
the repeating part alone, at other commands of the sampler. The surrogate is exact, so that all of
the error is that of the discrepancy; with a learned surrogate its own error, which no trajectory
reduces, hides most of the learning curve. The ratio is the number of chosen trajectories per random
one at the mean error of twelve chosen ones, those before the first choice included: below 1,
choosing pays. The number of random trajectories is interpolated on their learning curve, both on
logarithmic scales. Intervals (95 %) are those of a bootstrap over arms.

Ways to choose: `chosen` from draws of the sampler by the expected information about predictions
(that of `next_experiments`); `stretched` from these and the same with larger movements;
`coefficients` by the expected information about the coefficients of the regression; `outputs` by
the expected reduction of the mean variance of positions at rest, in mm, over the sampler's
commands; `composed` by the same, from draws and what is composed of them: one up to a common rest,
then the movements of another, within the limits of the draws, improved over some generations.
Arguments are ways; `--seeds N` is the number of arms, `--first` the first one, `--repeats` the
number of sequences of random and of chosen trajectories of each arm, `--batch` how many are chosen
at once. Target: an interval that excludes 1.
"""

from __future__ import annotations

import argparse
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

import numpy as np
import torch
from command_space import ExactArm
from record import record

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC
from retwin.evaluation.experiments.actuators import ActuatorKnowledge
from retwin.inference.design import Knowledge, chosen
from retwin.update.residual import ResidualModel

FIRST, BATCH, CHOSEN = 4, 2, 12
RANDOM = (6, 8, 12, 16, 20)
"""Numbers of random trajectories."""
CANDIDATES, REFERENCES = 200, 60
DRAWS = 5000
WAYS = ("chosen", "stretched", "coefficients", "outputs", "composed")
GENERATIONS, PARENTS, CHILDREN = 3, 40, 120
"""Of `composed`, for each trajectory that is chosen."""


class Arm(ExactArm):
    """The exact surrogate with its channels."""

    inputs, outputs, rate = KINEMATIC.inputs, KINEMATIC.outputs, KINEMATIC.rate


def stretched(commands: np.ndarray) -> np.ndarray:
    """Commands with the movements of each channel as large as values and speeds of all allow."""
    low, high = commands.min(axis=(0, 1)), commands.max(axis=(0, 1))
    change = np.abs(np.diff(commands, axis=1)).max(axis=1)
    first = commands[:, :1]
    moved = commands - first
    room = np.stack(
        [
            (high - first[:, 0]) / moved.max(axis=1).clip(1e-9),
            (first[:, 0] - low) / (-moved.min(axis=1)).clip(1e-9),
            change.max(axis=0) / change.clip(1e-9),
        ]
    )
    return (first + room.min(axis=0).clip(1)[:, None] * moved).astype(commands.dtype)


def positions(known: ActuatorKnowledge, commands: np.ndarray) -> Knowledge:
    """The knowledge about positions at rest, in mm, at the segments of commands."""
    context = known.twin.residual.context(known.twin.surrogate, commands)
    problem = known._problem_of(context)
    design = known.belief.features.design(problem)
    _, segments, joints = problem.missed.shape
    offsets = slice(1, 1 + joints)
    features, scatter = (
        each.unflatten(1, (segments, -1))[:, :, offsets].double()
        for each in (design.features, known.belief.hierarchy.scatter(design))
    )
    stop = np.ceil(rt.Segments.from_commands(commands).stop) - 5
    last = torch.as_tensor(np.clip(stop, 0, commands.shape[1] - 1).astype(int))
    z = known.mean(commands).float()
    at = known.operator.at(context, z, last)
    columns = []
    for joint in range(joints):
        step = float(scatter[:, :, joint].sqrt().mean()) / 2
        moved = z.clone()
        moved[..., 1 + joint] += step
        columns.append(1e3 * (known.operator.at(context, moved, last) - at).double() / step)
    jacobian = torch.stack(columns, dim=-1)
    rows = torch.einsum("nmaj,nmjf->nmaf", jacobian, features)[problem.valid]
    spread = torch.einsum("nmaj,nmj->nma", jacobian**2, scatter)[problem.valid]
    covariance = known.belief.hierarchy.covariance.double()
    return Knowledge(covariance, rows.reshape(-1, rows.shape[-1]), spread.reshape(-1))


def reduced(known: Knowledge, roots: torch.Tensor) -> torch.Tensor:
    """(N,) mean reduction of the variances of predictions by N experiments (N, r, F)."""
    moved = roots @ known.covariance
    inner = torch.eye(roots.shape[1], dtype=roots.dtype) + moved @ roots.mT
    lower = torch.linalg.cholesky(inner)
    seen = torch.linalg.solve_triangular(lower, moved @ known.predictions.mT, upper=False)
    return seen.square().sum(dim=1).mean(dim=1)


def composed(pool: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Commands of the parts of others before and after common rests, within their limits."""
    low, high = pool.min(axis=(0, 1)), pool.max(axis=(0, 1))
    still = (np.abs(np.diff(pool, axis=1)) < 1e-9).all(axis=2)
    made = []
    for _ in range(CHILDREN):
        first, second = rng.choice(len(pool), 2, replace=False)
        common = np.flatnonzero(still[first] & still[second])
        if len(common):
            at = int(rng.choice(common)) + 1
            a, b = pool[first], pool[second]
            made.append(
                np.clip(np.concatenate([a[:at], a[at - 1] + b[at:] - b[at - 1]]), low, high)
            )
    return np.array(made, dtype=pool.dtype).reshape(-1, *pool.shape[1:])


def by_outputs(
    known: ActuatorKnowledge,
    candidates: np.ndarray,
    references: np.ndarray,
    count: int,
    evolve: bool,
) -> np.ndarray:
    """The trajectories that reduce the mean variance of positions most, one after the other."""
    now, roots = positions(known, references), known.roots(candidates).double()
    rng = np.random.default_rng(0)
    taken = []
    for _ in range(count):
        pool, own = candidates, roots
        for _ in range(GENERATIONS if evolve else 0):
            kept = torch.argsort(-reduced(now, own))[:PARENTS].numpy()
            new = composed(pool[kept], rng)
            pool = np.concatenate([pool[kept], new])
            own = torch.cat([own[kept], known.roots(new).double()])
        gains = reduced(now, own)
        first = int(gains.argmax())
        taken.append(pool[first])
        now = now.after(own[first])
    return np.array(taken)


def best(
    known: ActuatorKnowledge, way: str, candidates: np.ndarray, references: np.ndarray, count: int
) -> np.ndarray:
    """The next trajectories."""
    if way in ("outputs", "composed"):
        return by_outputs(known, candidates, references, count, way == "composed")
    if way == "stretched":
        candidates = np.concatenate([candidates, stretched(candidates)])
    now, roots = known.knowledge(references), known.roots(candidates)
    if way == "coefficients":
        # Information on all coefficients alike: predictions are their principal axes.
        values, vectors = torch.linalg.eigh(now.covariance)
        kept = values > 1e-12 * values.max()
        axes = vectors[:, kept].mT / values[kept].sqrt()[:, None]
        now = Knowledge(now.covariance, axes, 1e-3 * torch.ones(len(axes), dtype=axes.dtype))
    return candidates[chosen(now, roots, count)[0]]


class Test:
    """Positions at rest of an arm with the repeating part of its offsets alone."""

    def __init__(self, commands: np.ndarray, machine: object, seed: int) -> None:
        share = machine.offset * np.sqrt(machine.repeatable)
        silent = {"bias": 0.0, "missed": 0.0, "noise": 0.0, "glitch": 0.0, "jitter": 0.0}
        repeating = replace(machine, repeatable=1.0, offset=share, **silent)
        hidden: dict[str, np.ndarray] = {}
        made = repeating.simulate(commands, seed=seed, hidden=hidden)
        stop = np.ceil(rt.Segments.from_commands(commands).stop)
        self.commands = commands
        self.last = np.clip(stop - 5, 0, made.steps - 1).astype(int)
        reached = hidden["angles"][np.arange(len(commands))[:, None], self.last]
        self.truth = KINEMATIC.position(reached)

    def error(self, known: ActuatorKnowledge) -> float:
        """Root mean square error of the mean position at rest, in mm."""
        twin = known.twin
        context = twin.residual.context(twin.surrogate, self.commands)
        z = known.mean(self.commands).float()
        made = known.operator.at(context, z, torch.as_tensor(self.last)).detach().numpy()
        return float(1e3 * np.sqrt(np.mean((made - self.truth) ** 2)))


def measured(
    seed: int, ways: tuple[str, ...], repeats: int, batch: int
) -> dict[str, dict[int, float]]:
    """Errors by way and number of trajectories, of one emulated machine."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    case = rt.cases.armpi()
    machine = replace(case.emulator, repeatable=0.5)
    rng = np.random.default_rng([seed, 1])
    test = Test(case.sampler.sample(REFERENCES, rng=rng), machine, seed)
    references = case.sampler.sample(REFERENCES, rng=rng)
    first = machine.simulate(case.sampler.sample(FIRST, rng=rng), seed=100 * seed)
    # Of the residual model only the operator with its sensor is needed.
    channels = {"inputs": KINEMATIC.inputs, "outputs": KINEMATIC.outputs}
    residual = ResidualModel(case.correction, rt.Mixture(), **channels).eval()
    twin = rt.CorrectedTwin(Arm(), residual)
    start = ActuatorKnowledge.of(twin, first)
    found = {}
    for way in ("random", *ways):
        counts = RANDOM if way == "random" else range(FIRST + batch, CHOSEN + 1, batch)
        errors = {count: [] for count in counts}
        for repeat in range(repeats):
            have, known = first, start
            for count in counts:
                part = np.random.default_rng([seed, repeat, len(have)])
                candidates = case.sampler.sample(CANDIDATES, rng=part)
                more = candidates[: count - len(have)]
                if way != "random":
                    more = best(known, way, candidates, references, count - len(have))
                own = 10_000 * seed + 100 * repeat + len(have)
                have = rt.Trajectories.concatenate([have, machine.simulate(more, seed=own)])
                known = ActuatorKnowledge.of(twin, have)
                errors[count].append(test.error(known))
        found[way] = {FIRST: test.error(start)} | {n: np.mean(e) for n, e in errors.items()}
        print(seed, way, {n: round(float(e), 3) for n, e in found[way].items()}, flush=True)
    return found


def ratio(rows: list[dict[str, dict[int, float]]], way: str) -> float:
    """Chosen trajectories per random one at the mean error of all chosen ones."""
    goal = np.mean([row[way][CHOSEN] for row in rows])
    counts = np.array(sorted(rows[0]["random"]))
    curve = np.array([np.mean([row["random"][n] for row in rows]) for n in counts])
    falling = np.minimum.accumulate(curve)
    # Beyond the last point the ratio is at most that of the last point.
    needed = np.exp(np.interp(-np.log(goal), -np.log(falling), np.log(counts)))
    return float(CHOSEN / needed)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("ways", nargs="*", choices=WAYS, default=["chosen"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--batch", type=int, default=BATCH, help="chosen at once")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    ways = tuple(given.ways)
    seeds = range(given.first, given.first + given.seeds)
    with ProcessPoolExecutor(given.processes, get_context("spawn")) as pool:
        rows = list(
            pool.map(partial(measured, ways=ways, repeats=given.repeats, batch=given.batch), seeds)
        )
    rng = np.random.default_rng(0)
    table = {}
    for way in ways:
        draws = [
            ratio([rows[i] for i in rng.integers(len(rows), size=len(rows))], way)
            for _ in range(DRAWS)
        ]
        low, high = np.quantile(draws, [0.025, 0.975])
        table[way] = {"ratio": ratio(rows, way), "low": float(low), "high": float(high)}
        for count in (FIRST + 4, CHOSEN):
            errors = np.array([row[way][count] for row in rows])
            table[way][f"error at {count} (mm)"] = float(errors.mean())
        better = np.array([row[way][CHOSEN] - row["random"][CHOSEN] for row in rows])
        table[way][f"less than random at {CHOSEN} (arms)"] = float((better < 0).sum())
    record("next", f"trajectories chosen per random one, {given.seeds} emulated arms", table)
    for count in sorted(rows[0]["random"]):
        print(f"random, {count}: {np.mean([r['random'][count] for r in rows]):.3f} mm")


if __name__ == "__main__":
    main()
