"""From the results of all jobs to `results.json` and `arrays.npz` (schema 1)."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.fidelity import Fidelity
from retwin.statistics import (
    METRICS,
    bootstrap,
    bootstrap_weights,
    compare_runs,
    confusion,
    holm,
    score,
)
from retwin.storage import write_atomically
from retwin.study.jobs import Job, Work
from retwin.study.plan import SOURCES
from retwin.trajectories import Trajectories
from retwin.twins.protocol import HEALTHY

__all__ = ["SCHEMA", "write_results"]

SCHEMA = 1
DRAWS = 10_000
HOLM_FAMILY = ("macro_f1", "balanced_accuracy", "auroc")
SHOWN = 3
"""Trajectories whose poses the report draws."""
COMPARED = (*HOLM_FAMILY, "accuracy", "healthy_recall")


def write_results(
    work: Work, out: Path, *, about: Mapping[str, Any], provenance: Mapping[str, Any]
) -> dict[str, Any]:
    """Collect every job's result, score it, write both files; returns what `results.json` holds.

    `about` holds the description of the data, `provenance` how the study was called.
    """
    real = work.real_data()
    tested = sorted(work.roles.tested)
    test = real[tested]
    classes = work.case.classes
    truth = np.array([classes.index(label) for label in test.labels])
    probabilities = {name: _collect(work, name, tested) for name in work.plan.sources}
    weights = bootstrap_weights(truth, draws=DRAWS, seed=work.plan.seed_of("bootstrap", 0))
    draws = {
        name: {m: bootstrap(m, truth, runs, weights, classes) for m in COMPARED}
        for name, runs in probabilities.items()
    }
    sources = {
        name: _source(work, name, truth, probabilities[name], draws[name])
        for name in work.plan.sources
    }
    fidelity = _fidelity(work)
    results = {
        "schema": SCHEMA,
        "case": work.case.name,
        "title": work.case.title,
        "preset": work.plan.preset,
        "classifier": work.plan.classifier_name,
        "runs": work.plan.number_of_runs,
        "classes": list(classes),
        "emulated": real.emulated,
        "data": _data(work, real, test, about),
        "sources": sources,
        "published": {} if real.emulated else dict(work.case.published),
        "comparisons": _comparisons(sources, draws),
        "surrogate": _surrogate(work),
        "fidelity": {name: found.as_dict() for name, found in fidelity.items()},
        "learning_curve": None,
        "timing": _timing(work),
        "provenance": {**_machine(), **provenance},
    }
    arrays = {f"probabilities/{name}": runs for name, runs in probabilities.items()}
    for name, found in fidelity.items():
        arrays |= _fidelity_arrays(name, found)
    arrays |= _poses(work, test)
    with write_atomically(out / "arrays.npz") as part:
        np.savez_compressed(part, allow_pickle=False, **arrays)
    with write_atomically(out / "results.json") as part:
        part.write_text(json.dumps(_plain(results), indent=1, allow_nan=False), encoding="utf-8")
    return results


def _collect(work: Work, source: str, tested: list[int]) -> NDArray:
    """Probabilities (runs, n_test, classes) of one source, in the order of `tested`."""
    place = {index: i for i, index in enumerate(tested)}
    runs = work.plan.number_of_runs
    out = np.full((runs, len(tested), len(work.case.classes)), np.nan)
    folds = range(len(work.roles.folds)) if SOURCES[source].per_fold else (0,)
    for run in range(runs):
        for fold in folds:
            with np.load(work.path(Job("diagnosis", run, fold, source))) as made:
                out[run, [place[i] for i in made["tested"].tolist()]] = made["probabilities"]
    return out


def _source(
    work: Work, name: str, truth: NDArray, probabilities: NDArray, draws: Mapping[str, NDArray]
) -> dict[str, Any]:
    scores = [score(truth, run, work.case.classes) for run in probabilities]
    predicted = probabilities.argmax(axis=2)
    kind = SOURCES[name]
    return {
        **{metric: [getattr(each, metric) for each in scores] for metric in METRICS},
        "intervals": {m: np.nanquantile(d, [0.025, 0.975]).tolist() for m, d in draws.items()},
        "confusion": np.sum(
            [confusion(truth, run, len(work.case.classes)) for run in predicted], axis=0
        ).tolist(),
        "predictions": predicted.tolist(),
        "title": kind.title,
        "real_data": kind.real_data,
        "fault_protocol_known": True,
        "twin_runs": len(work.twin_data()),
        **_costs(work, name),
    }


def _costs(work: Work, name: str) -> dict[str, float | None]:
    """Seconds to update the twin, and to generate a training set; None where nothing is done."""
    kind = SOURCES[name]
    update = 0.0
    if kind.surrogate:
        update += _mean(work, "surrogate", "seconds") or 0.0
    if kind.residual:
        update += _mean(work, "residual", "seconds", name) or 0.0
    generate = None if name == "dt" else _mean(work, "diagnosis", "generate", name)
    return {"update_s": update, "generate_s": generate}


def _mean(work: Work, kind: str, what: str, source: str = "") -> float | None:
    """Mean over jobs of one of their timings; None where no job told it."""
    told = [
        work.timing(job).get(what)
        for stage in work.jobs()
        for job in stage
        if job.kind == kind and job.source == source
    ]
    known = [seconds for seconds in told if seconds is not None]
    return float(np.mean(known)) if known else None


def _timing(work: Work) -> dict[str, Any]:
    jobs = [job for stage in work.jobs() for job in stage]
    chosen = work.plan.sources
    return {
        "generate_s": {name: _costs(work, name)["generate_s"] for name in chosen},
        "surrogate_fit_s": _mean(work, "surrogate", "seconds"),
        "residual_fit_s": {name: _mean(work, "residual", "seconds", name) for name in chosen},
        "diagnosis_s": {name: _mean(work, "diagnosis", "seconds", name) for name in chosen},
        "fidelity_s": {name: _mean(work, "fidelity", "seconds", name) for name in chosen},
        "total_s": float(sum(work.timing(job).get("seconds", 0.0) for job in jobs)),
    }


def _comparisons(
    sources: Mapping[str, Mapping[str, Any]], draws: Mapping[str, Mapping[str, NDArray]]
) -> list[dict[str, Any]]:
    """Every pair of sources, the later one against the earlier one."""
    out = []
    for b, a in combinations(sources, 2):
        rows = []
        for metric in COMPARED:
            gap = draws[a][metric] - draws[b][metric]
            rows.append(
                {
                    "a": a,
                    "b": b,
                    "metric": metric,
                    **compare_runs(sources[a][metric], sources[b][metric]),
                    "p_holm": None,
                    "bootstrap_ci95": np.nanquantile(gap, [0.025, 0.975]).tolist(),
                }
            )
        family = [row for row in rows if row["metric"] in HOLM_FAMILY and row["p"] is not None]
        for row, adjusted in zip(family, holm([row["p"] for row in family]), strict=True):
            row["p_holm"] = adjusted
        out += rows
    return out


def _data(
    work: Work, real: Trajectories, test: Trajectories, about: Mapping[str, Any]
) -> dict[str, Any]:
    pool = sorted({i for calibration, _ in work.roles.folds for i in calibration})
    seen = real.ids[pool]
    if work.plan.calibrate_on == "healthy":
        seen = seen[real.labels[pool] == HEALTHY]
    return {
        "twin": {**about["twin"], "n": len(work.twin_data())},
        "calibration": {**about["calibration"], "n": len(pool), "used": seen.tolist()},
        "test": {
            **about["test"],
            "n": len(test),
            "ids": test.ids.tolist(),
            "labels": test.labels.tolist(),
        },
        "protocol": about["protocol"],
    }


def _surrogate(work: Work) -> dict[str, Any]:
    figures = work.surrogate_figures()
    outputs = work.case.outputs
    if not figures:
        return {}
    return {
        "rmse": {n: float(np.mean([f[f"rmse_{n}"] for f in figures])) for n in outputs.names},
        "nrmse": {n: float(np.mean([f[f"nrmse_{n}"] for f in figures])) for n in outputs.names},
        "unit": outputs.units[0],
    }


def _fidelity(work: Work) -> dict[str, Fidelity]:
    """How real the draws of each source's twin are, where it has a residual model."""
    found = {name: work.fidelity(name) for name in work.plan.sources if SOURCES[name].residual}
    return {name: each for name, each in found.items() if each is not None}


def _fidelity_arrays(source: str, found: Fidelity) -> dict[str, NDArray]:
    """What the report draws of it.

    `z/SOURCE/observed` and `/predicted` (k, d), per movement, NaN where outputs do not tell it;
    `pit/SOURCE` (3, 20), see `Fidelity.pit_shares`; `bands/SOURCE/…`: `nominal` and `observed`
    (2, P, d), `seen` (2, P), `quantiles` (2, 5, P, d), `ids` (2,), of the trajectory with the
    median energy score and of the one with the worst; `rate` in Hz.
    """
    told = np.isfinite(found.movements).any(axis=-1)
    order = np.argsort(found.energy, kind="stable").tolist()
    index = list(dict.fromkeys([order[(len(order) - 1) // 2], order[-1]]))
    return {
        f"z/{source}/observed": found.movements[:, 0][told[:, 0]].astype(np.float32),
        f"z/{source}/predicted": found.movements[:, 1:][told[:, 1:]].astype(np.float32),
        f"pit/{source}": found.pit_shares(),
        f"bands/{source}/nominal": found.nominal[index].astype(np.float32),
        f"bands/{source}/observed": found.observed[index].astype(np.float32),
        f"bands/{source}/seen": found.seen[index],
        f"bands/{source}/quantiles": found.bands[index].astype(np.float32),
        f"bands/{source}/ids": found.ids[index],
        f"bands/{source}/rate": np.array(found.rate),
    }


def _poses(work: Work, test: Trajectories) -> dict[str, NDArray]:
    """Skeletons of the first test trajectory of some classes, healthy first, at the sensor's rate.

    `pose/nominal` and `pose/observed` (k, T, points, 3) in m, `pose/ids` (k,), `pose/rate` in Hz.
    """
    body, labels = work.case.body, test.labels.tolist()
    known = [name for name in work.case.classes if name in labels]
    if body is None or not known:
        return {}
    spread = known[:: -(-len(known) // SHOWN)]
    shown = test[[labels.index(name) for name in spread]]
    every = max(1, round(test.rate / work.case.sensor_rate))
    nominal, observed = (body.skeleton(joints[:, ::every]) for joints in body.poses(shown))
    return {
        "pose/nominal": nominal.astype(np.float32),
        "pose/observed": observed.astype(np.float32),
        "pose/ids": shown.ids,
        "pose/rate": np.array(test.rate / every),
    }


def _machine() -> dict[str, str]:
    return {
        "retwin": version("retwin"),
        "python": platform.python_version(),
        "torch": version("torch"),
        "numpy": version("numpy"),
        "machine": platform.platform(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _plain(value: Any) -> Any:
    """JSON has no NaN: undefined figures become null."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
