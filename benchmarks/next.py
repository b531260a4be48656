"""Trajectories that are chosen by what they tell, against random ones, on the emulated arm.

Half of the mean square of the emulated offsets repeats with the pose and the direction of travel.
The error is that of the predicted mean position at rest, against the same arm with the repeating
part alone, at commands of the sampler. The ratio is the number of random trajectories with which
the mean error is that of eight chosen ones, divided into eight: below 1, choosing pays. Intervals
are those of a bootstrap over seeds.

Ways to choose: `chosen` from draws of the sampler by what they tell about predictions (that of
`next_experiments`); `stretched` from these and the same with larger movements; `coefficients` by
what they tell about the coefficients of the regression. Arguments are ways, `--seeds N` their
number. Target: an interval that excludes 1.
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
from record import record

import retwin as rt
from retwin.evaluation.experiments.actuators import ActuatorKnowledge
from retwin.inference.design import Knowledge, chosen
from retwin.nets.training import Training

FIRST, BATCH, CHOSEN, RANDOM = 4, 2, 8, 12
CANDIDATES, REFERENCES = 200, 60
WAYS = ("chosen", "stretched", "coefficients")


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


def best(
    known: ActuatorKnowledge, way: str, candidates: np.ndarray, references: np.ndarray
) -> np.ndarray:
    """The next trajectories."""
    if way == "random":
        return candidates[:BATCH]
    if way == "stretched":
        candidates = np.concatenate([candidates, stretched(candidates)])
    now, roots = known.knowledge(references), known.roots(candidates)
    if way == "coefficients":
        # Information on all coefficients alike: predictions are their principal axes.
        values, vectors = torch.linalg.eigh(now.covariance)
        kept = values > 1e-12 * values.max()
        axes = vectors[:, kept].mT / values[kept].sqrt()[:, None]
        now = Knowledge(now.covariance, axes, 1e-3 * torch.ones(len(axes), dtype=axes.dtype))
    return candidates[chosen(now, roots, BATCH)[0]]


def error(known: ActuatorKnowledge, test: rt.Trajectories) -> float:
    """Root mean square error of the mean position at rest, in mm."""
    twin = known.twin
    context = twin.residual.context(twin.surrogate, test.commands)
    last = np.clip(np.ceil(context.segments.stop) - 5, 0, test.steps - 1).astype(int)
    z = known.mean(test.commands).float()
    made = known.operator.at(context, z, torch.as_tensor(last)).detach().numpy()
    truth = test.observed[np.arange(len(test))[:, None], last]
    return float(1e3 * np.sqrt(np.mean((made - truth) ** 2)))


def measured(seed: int, ways: tuple[str, ...]) -> dict[str, dict[int, float]]:
    """Errors by way and number of trajectories, of one emulated machine."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    case = rt.cases.armpi()
    simulated = rt.generate(case.twin, case, per_class=12, seed=7)
    how = Training(max_epochs=6, batch_size=256, learning_rate=1e-2)
    surrogate = rt.fit_surrogate(simulated, rt.MLP((64, 64)), seed=0, training=how)
    machine = replace(case.emulator, repeatable=0.5)
    share = machine.offset * np.sqrt(machine.repeatable)
    silent = {"bias": 0.0, "missed": 0.0, "noise": 0.0, "glitch": 0.0, "jitter": 0.0}
    repeating = replace(machine, repeatable=1.0, offset=share, **silent)
    rng = np.random.default_rng([seed, 1])
    test = repeating.simulate(case.sampler.sample(REFERENCES, rng=rng), seed=seed)
    references = case.sampler.sample(REFERENCES, rng=rng)
    first = machine.simulate(case.sampler.sample(FIRST, rng=rng), seed=100 * seed)
    # Of the residual model the operator with its sensor and its range of delays is needed alone.
    residual = rt.fit_residual(surrogate, first, case.correction, seed=0)
    twin = rt.CorrectedTwin(surrogate, residual)
    start = ActuatorKnowledge.of(twin, first)
    found = {}
    for way in ("random", *ways):
        have, known = first, start
        errors = {FIRST: error(start, test)}
        while len(have) < (RANDOM if way == "random" else CHOSEN):
            part = np.random.default_rng([seed, len(have)])
            candidates = case.sampler.sample(CANDIDATES, rng=part)
            commands = best(known, way, candidates, references)
            more = machine.simulate(commands, seed=100 * seed + len(have))
            have = rt.Trajectories.concatenate([have, more])
            known = ActuatorKnowledge.of(twin, have)
            errors[len(have)] = error(known, test)
        found[way] = errors
        print(seed, way, {n: round(e, 3) for n, e in errors.items()}, flush=True)
    return found


def ratio(rows: list[dict[str, dict[int, float]]], way: str) -> float:
    """Chosen trajectories per random one at the mean error of all chosen ones."""
    goal = np.mean([row[way][CHOSEN] for row in rows])
    counts = np.array(sorted(rows[0]["random"]))
    curve = np.array([np.mean([row["random"][n] for row in rows]) for n in counts])
    falling = np.minimum.accumulate(curve)
    # Beyond the last point the ratio is at most that of the last point, before the first one 2.
    needed = np.interp(-goal, -falling, counts)
    return float(CHOSEN / needed)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("ways", nargs="*", choices=WAYS, default=["chosen"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    ways = tuple(given.ways)
    with ProcessPoolExecutor(given.processes, get_context("spawn")) as pool:
        rows = list(pool.map(partial(measured, ways=ways), range(1, 1 + given.seeds)))
    rng = np.random.default_rng(0)
    table = {}
    for way in ways:
        draws = [
            ratio([rows[i] for i in rng.integers(len(rows), size=len(rows))], way)
            for _ in range(2000)
        ]
        low, high = np.quantile(draws, [0.025, 0.975])
        table[way] = {"ratio": ratio(rows, way), "low": float(low), "high": float(high)}
        for count in (FIRST + BATCH, CHOSEN):
            table[way][f"error at {count} (mm)"] = float(np.mean([r[way][count] for r in rows]))
    record("next", f"trajectories chosen per random one, {given.seeds} emulated arms", table)
    for count in sorted(rows[0]["random"]):
        print(f"random, {count}: {np.mean([r['random'][count] for r in rows]):.3f} mm")


if __name__ == "__main__":
    main()
