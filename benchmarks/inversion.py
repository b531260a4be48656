"""Accuracy and cost of diagnosis by inversion, without training.

The emulated robot is calibrated on 6 healthy trajectories, as many as set A has, and tested on 6
other trajectories per class and seed. Stuck actuators freeze at a known sample, as in the published
protocol, or at any sample of the first four fifths. Targets: macro-F1 and healthy recall of 0.9,
ECE of at most 0.1, 90 % intervals with a coverage of 85 to 95 %, at most 1 second per trajectory on
two cores.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from record import record
from sklearn.metrics import roc_auc_score

import retwin as rt
from retwin.cases.armpi_fpv.twin import UNIT
from retwin.diagnosis import Diagnosis, Estimate, InversionDiagnoser, fit_inversion
from retwin.scores.classification import score
from retwin.twins.faults.actuator_faults import ActuatorBias, Stuck
from retwin.twins.faults.applied_faults import draw_faults

HEALTHY = 6
PER_CLASS = 6
SEEDS = (41, 51)


def main() -> None:
    case = rt.cases.armpi()
    ibg = rt.fit_surrogate(rt.generate(case.twin, case, per_class=40, seed=0), seed=0)
    columns: dict[str, dict[str, float]] = {}
    for seed in SEEDS:
        commands = case.sampler.sample(HEALTHY, rng=np.random.default_rng(seed))
        healthy = case.emulator.simulate(commands, seed=seed)
        healthy = healthy.replace(labels=np.repeat("Healthy", HEALTHY))
        rg = rt.fit_residual(ibg, healthy, case.correction, seed=0)
        for name, each in (("known onset", case), ("unknown onset", case.with_random_onset())):
            columns[f"{name}, seed {seed}"] = measured(ibg, rg, healthy, each, seed + 1)
    figures = next(iter(columns.values()))
    rows = {what: {name: each[what] for name, each in columns.items()} for what in figures}
    record("inversion", f"inversion of {9 * PER_CLASS} emulated trajectories per column", rows)


@dataclass(frozen=True)
class BothStuck:
    """Two actuators whose responses are held from the same moment on."""

    one: Stuck
    other: int
    label: str = "two stuck"

    def drawn(self, rng: np.random.Generator, **about: Any) -> BothStuck:
        """See `Fault.drawn`."""
        return replace(self, one=self.one.drawn(rng, **about))

    def command(self, commands: NDArray, segments: rt.Segments, rate: float) -> NDArray:
        """See `Fault.command`."""
        return commands

    def response(self, response: NDArray, rate: float) -> NDArray:
        """See `Fault.response`."""
        held = self.one.response(response, rate)
        return replace(self.one, actuator=self.other).response(held, rate)


def several(
    diagnoser: InversionDiagnoser, singles: rt.Trajectories, case: rt.Case, seed: int
) -> dict[str, float]:
    """How two stuck motors are told from single faults, and what that does to the latter."""
    stuck = [fault for fault in case.faults.values() if isinstance(fault, Stuck)]
    pairs = [BothStuck(a, b.actuator) for a, b in combinations(stuck, 2)]
    drawn = [pair for pair in pairs for _ in range(PER_CLASS)]
    commands = case.sampler.sample(len(drawn), rng=np.random.default_rng(seed + 7))
    both = case.emulator.simulate(commands, faults=drawn, seed=seed + 7)
    started = time.perf_counter()
    one = diagnoser.diagnose(singles, max_faults=2)
    taken = time.perf_counter() - started
    two = diagnoser.diagnose(both, max_faults=2)
    jammed = np.char.find(singles.labels.astype(str), "Stuck") >= 0
    found = {}
    for name, rows in (("one stuck", jammed), ("one fault or none", np.ones_like(jammed))):
        scores = np.concatenate([one.several[rows], two.several])
        truth = np.arange(len(scores)) >= rows.sum()
        found[f"AUROC of two stuck against {name}"] = float(roc_auc_score(truth, scores))
    found["two stuck called unknown"] = float(np.mean(two.labels == "unknown"))
    found["single or none called several"] = float(np.mean(one.several > 0.5))
    found["right single classes with pairs"] = float(np.mean(one.labels == singles.labels))
    return found | {"pairs, ms per trajectory": 1000 * taken / len(singles)}


def measured(
    ibg: rt.Surrogate, rg: rt.ResidualModel, healthy: rt.Trajectories, case: rt.Case, seed: int
) -> dict[str, float]:
    """Scores, and errors of the inferred severities, on one set of trajectories."""
    started = time.perf_counter()
    diagnoser = fit_inversion(ibg, rg, healthy, case.faults)
    fitted = time.perf_counter() - started
    drawn = [fault for fault in case.faults.values() for _ in range(PER_CLASS)]
    commands = case.sampler.sample(len(drawn), rng=np.random.default_rng(seed))
    hidden: dict[str, np.ndarray] = {}
    made = case.emulator.simulate(commands, faults=drawn, seed=seed, hidden=hidden)
    faults = draw_faults(drawn, rt.Segments.from_commands(commands), seed, rate=case.rate)
    started = time.perf_counter()
    found = diagnoser.diagnose(made)
    seconds = time.perf_counter() - started
    truth = np.repeat(np.arange(len(case.classes)), PER_CLASS)
    scores = asdict(score(truth, found.probabilities, case.classes))
    shown = ("macro_f1", "healthy_recall", "ece", "ece_classwise")
    return {
        **{name: scores[name] for name in shown},
        **severities(found, truth, faults, hidden["angles"][:, -1]),
        **left_out(found, truth),
        **several(diagnoser, made.replace(labels=np.array(case.classes)[truth]), case, seed),
        "fit (s)": fitted,
        "diagnose, per trajectory (s)": seconds / len(made),
        "threads": float(torch.get_num_threads()),
    }


def severities(
    found: Diagnosis, truth: np.ndarray, faults: list[rt.Fault | None], ends: np.ndarray
) -> dict[str, float]:
    """Errors and coverage of the severities of the true class; `ends` (n, d_u): last angles."""
    biased = [i for i, fault in enumerate(faults) if isinstance(fault, ActuatorBias)]
    stuck = [i for i, fault in enumerate(faults) if isinstance(fault, Stuck)]
    bias = np.array([faults[i].bias for i in biased])
    level = np.array([ends[i, faults[i].actuator] for i in stuck])
    onset = np.array([faults[i].onset for i in stuck])
    return {
        "bias MAE (deg)": UNIT * error(found.bias, biased, truth, bias).mean(),
        "bias, 90 % intervals, coverage": covered(found.bias, biased, truth, bias).mean(),
        "level MAE (deg)": UNIT * error(found.level, stuck, truth, level).mean(),
        "level, median error (deg)": UNIT * np.median(error(found.level, stuck, truth, level)),
        "level, 90 % intervals, coverage": covered(found.level, stuck, truth, level).mean(),
        "onset, median error (s)": np.median(error(found.onset, stuck, truth, onset)),
        "onset, 90 % intervals, coverage": covered(found.onset, stuck, truth, onset).mean(),
    }


def left_out(found: Diagnosis, truth: np.ndarray) -> dict[str, float]:
    """How well a fault that is left out of the hypotheses is distinguished from all classes."""
    areas = [
        roc_auc_score(truth == fault, -np.delete(found.explained, fault, axis=1).max(axis=1))
        for fault in range(1, len(found.classes))
    ]
    known = np.mean(found.unknown > 0.5)
    return {
        "called unknown": float(known),
        "AUROC of a fault left out, mean": float(np.mean(areas)),
        "AUROC of a fault left out, lowest": float(np.min(areas)),
    }


def error(estimate: Estimate, rows: list[int], truth: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Absolute errors of the values."""
    return np.abs(estimate.value[rows, truth[rows]] - true)


def covered(estimate: Estimate, rows: list[int], truth: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Whether the interval contains the truth."""
    own = (rows, truth[rows])
    return (estimate.low[own] <= true) & (true <= estimate.high[own])


if __name__ == "__main__":
    main()
