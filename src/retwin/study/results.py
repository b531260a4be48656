"""Collect the results of all jobs in `results.json` (`retwin.results`) and `arrays.npz`."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.catalog import METRICS, SOURCES
from retwin.data.quality.check import Checked
from retwin.data.trajectories import HEALTHY, PER_SAMPLE, Trajectories
from retwin.evaluation.fidelity.figures import Fidelity
from retwin.evaluation.fidelity.overlay import Overlay
from retwin.results import SCHEMA, Results
from retwin.results.sources import CurvePoint, SourceResults
from retwin.scores.bootstrap import Draws
from retwin.scores.comparison import MIN_RUNS, compare_runs, holm, no_verdict
from retwin.scores.uses import uses_of
from retwin.serialisation.files import write_atomically
from retwin.serialisation.models import read_about
from retwin.study.answers import Answers, answers
from retwin.study.files import Job
from retwin.study.work import Work
from retwin.update.agreement import check_with_twin


def write_results(
    work: Work, out: Path, *, about: Mapping[str, Any], provenance: Mapping[str, Any]
) -> Results:
    """Collect and score every job's result, and write `results.json` and `arrays.npz`.

    Parameters
    ----------
    work : Work
        The finished jobs.
    out : Path
        The folder of the study.
    about : mapping
        The description of the data.
    provenance : mapping
        The command, the seed.

    Returns
    -------
    Results
        The contents of `results.json`.

    """
    real = work.files.real_data()
    test = real[sorted(work.roles.tested)]
    found = answers(work)
    drawn = {name: found.drawn(name) for name in work.plan.sources}
    scored = {name: _fidelity_of(work, name) for name in work.plan.sources}
    fidelity = {name: each for name, each in scored.items() if each is not None}
    sources = {name: _source(work, found, name, drawn[name]) for name in work.plan.sources}
    checked = check_with_twin(work.case.twin, real)
    checked = replace(checked, findings=(*checked.findings, *found.findings()))
    arrays = found.arrays() | _record_arrays(checked)
    for name, each in fidelity.items():
        arrays |= _fidelity_arrays(name, each)
    overlays = [Overlay.load(work.files.path(job)) for job in work.overlay_jobs()]
    shown: dict[str, Any] = {}
    if overlays:  # a twin was corrected
        overlay = Overlay.concatenate(overlays)
        known = set(overlay.ids.tolist())
        shown_test = test[[name in known for name in test.ids.tolist()]]
        arrays |= _overlay_arrays(work, shown_test, overlay)
        shown["portrait"] = {
            "source": work.overlay_jobs()[0].name,
            "ids": shown_test.ids.tolist(),
            "movement": overlay.latent.names,
            "movement_units": overlay.latent.units,
        }
    diagnosed = work.case.diagnosed
    results = Results.model_validate(
        {
            "schema": SCHEMA,
            "case": work.case.name,
            "title": work.case.title,
            "preset": work.plan.preset,
            "classifier": work.plan.classifier_name if diagnosed else "",
            "runs": work.plan.number_of_runs,
            "classes": list(work.case.classes) if diagnosed else [],
            "inputs": vars(work.case.inputs),
            "outputs": vars(work.case.outputs),
            "emulated": real.emulated,
            "data": _data(work, real, test, about),
            "records": checked.values,
            "sources": sources,
            "published": {} if real.emulated else dict(work.case.published),
            "comparisons": _comparisons(work, found, sources, drawn),
            "surrogate": _surrogate(work),
            "fidelity": {name: each.as_dict() for name, each in fidelity.items()},
            "learning_curve": _learning_curve(work, found) or None,
            "timing": _timing(work),
            "provenance": {**_machine(), **provenance},
            **shown,
        }
    )
    results = results.model_copy(update={"uses": uses_of(results, arrays)})
    with write_atomically(out / "arrays.npz") as part:
        np.savez_compressed(part, allow_pickle=False, **arrays)
    with write_atomically(out / "results.json") as part:
        part.write_text(results.to_json(), encoding="utf-8")
    return results


def _record_arrays(checked: Checked) -> dict[str, NDArray]:
    """The records that have findings, of which the page shows pictures."""
    named = {each.record for each in checked.findings}
    own = checked.records[np.isin(checked.records.ids, list(named))]
    names = ("commands", "nominal", "observed", "mask", "ids")
    arrays = {f"records/{name}": getattr(own, name) for name in names}
    return arrays | {"records/rate": np.array(own.rate)}


def _source(work: Work, found: Answers, name: str, drawn: Mapping[str, Draws]) -> SourceResults:
    return SourceResults(
        scores=found.scores(name),
        intervals={metric: each.interval for metric, each in drawn.items()},
        **found.details(name),
        title=SOURCES[name].title,
        real_data=work.sees(name),
        **_costs(work, name),
    )


def _costs(work: Work, source: str) -> dict[str, Any]:
    """The costs of a source in one run and fold, all stages before it included.

    The keys are those of `SourceResults`.
    """
    costs: dict[str, list[dict[str, Any]]] = {}
    for job in _with_all_before(work, work.answers(source)):
        costs.setdefault(f"{job.kind} {job.name}", []).append(work.files.costs(job))
    kind = work.answers(source)[0].kind
    answered = [part for part in costs if part.startswith(f"{kind} ")]
    before = [part for part in costs if part not in answered]
    own = [f"{kind} {name}" for name in (source, *SOURCES[source].pool)]

    notes = [job["notes"] for part in costs.values() for job in part if job.get("notes")]

    def total(what: str, *parts: str) -> float | None:
        each = [_mean([job.get(what) for job in costs.get(part, [])]) for part in parts]
        known = [value for value in each if value is not None]
        return sum(known) if known else None

    runs = total("twin_runs", *costs)
    size = total("trajectories", *own)
    return {
        "update_s": total("seconds", *before) or 0.0,
        "generate_s": total("generate", *answered),
        "generated": None if size is None else round(size),
        "train_s": total("train", *answered),
        "predict_s": total("predict", *own),
        "twin_runs": 0 if runs is None else round(runs),
        "notes": sorted(set(notes)),
    }


def _with_all_before(work: Work, jobs: Sequence[Job]) -> set[Job]:
    before = {each for job in jobs for each in work.needed(job)}
    return {*jobs, *_with_all_before(work, sorted(before, key=str))} if before else set(jobs)


def _mean(values: Sequence[float | None]) -> float | None:
    """Over those that are known; None where none is."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _timing(work: Work) -> dict[str, Any]:
    """Mean seconds of each kind of job, and the sum of all."""
    kinds: dict[str, list[float | None]] = {}
    for job in work.graph():
        name = " ".join(part for part in (job.kind, job.name) if part)
        kinds.setdefault(name, []).append(work.files.costs(job).get("seconds"))
    return {
        "seconds": {name: _mean(each) for name, each in sorted(kinds.items())},
        "total_s": float(sum(value or 0.0 for each in kinds.values() for value in each)),
    }


def _learning_curve(work: Work, found: Answers) -> list[CurvePoint]:
    """Scores and coverage of each source by its number of healthy calibration trajectories."""
    points = []
    for source in work.plan.sources:
        counts = work.counts(source)
        for healthy in (*counts, 0) if counts else ():
            values, drawn = found.scores(source, healthy), found.drawn(source, healthy)
            scores: dict[str, Any] = {metric: values[metric] for metric in found.curved}
            intervals = {metric: drawn[metric].interval for metric in found.curved}
            fidelity = _fidelity_of(work, source, healthy)
            if fidelity is not None:
                covered = fidelity.figures["coverage90"]
                scores["coverage90"], intervals["coverage90"] = covered.value, covered.interval
            count = healthy or work.healthy
            points.append(
                CurvePoint(source=source, healthy=count, scores=scores, intervals=intervals)
            )
    return points


def _comparisons(
    work: Work,
    found: Answers,
    sources: Mapping[str, SourceResults],
    drawn: Mapping[str, Mapping[str, Draws]],
) -> list[dict[str, Any]]:
    """Every pair of sources, the later one minus the earlier one.

    From `MIN_RUNS` runs on the intervals contain the randomness of training. p-values of verdicts
    are adjusted over all pairs with a verdict on the same metric.
    """
    runs, out = work.plan.number_of_runs, []
    for b, a in combinations(sources, 2):
        pair = [work.sees(name) for name in (a, b)]
        reason = no_verdict(runs=runs, records=found.records, real_data=pair)
        rows: list[dict[str, Any]] = []
        for metric in found.compared:
            each = drawn[a][metric] - drawn[b][metric]
            ours, theirs = sources[a].runs(metric), sources[b].runs(metric)
            if runs >= MIN_RUNS:
                seed = work.plan.seed_of("bootstrap", 1)
                largest = np.inf if METRICS[metric].simulated else 1.0
                difference = np.subtract(ours, theirs).tolist()
                each = each.with_runs(difference, seed=seed, largest=largest)
            if each.interval is not None:
                row: dict[str, Any] = {"a": a, "b": b, "metric": metric}
                row |= compare_runs(ours, theirs)
                row |= {"bootstrap_ci95": each.interval, "p_bootstrap": each.p}
                rows.append({**row, "p_holm": None, "p_verdict": None, "no_verdict": reason})
        _adjust([row for row in rows if row["metric"] in found.family], "p", "p_holm")
        out += rows
    for metric in found.compared:
        family = [row for row in out if row["metric"] == metric and not row["no_verdict"]]
        _adjust(family, "p_bootstrap", "p_verdict")
    return out


def _adjust(rows: Sequence[dict[str, Any]], p: str, adjusted: str) -> None:
    """Add the adjusted p-values of the rows that have one."""
    family = [row for row in rows if row[p] is not None]
    for row, value in zip(family, holm([row[p] for row in family]), strict=True):
        row[adjusted] = value


def _data(
    work: Work, real: Trajectories, test: Trajectories, about: Mapping[str, Any]
) -> dict[str, Any]:
    pool = sorted({i for calibration, _ in work.roles.folds for i in calibration})
    seen = real.ids[pool]
    if work.plan.calibrate_on == "healthy":
        seen = seen[real.labels[pool] == HEALTHY]
    return {
        "twin": {**about["twin"], "n": len(work.files.twin_data())},
        "calibration": {**about["calibration"], "n": len(pool), "used": seen.tolist()},
        "test": {
            **about["test"],
            "n": len(test),
            "rate": float(test.rate),
            "ids": test.ids.tolist(),
            "labels": test.labels.tolist(),
        },
        "protocol": about["protocol"],
    }


def _surrogate(work: Work) -> dict[str, Any]:
    made = [Job("surrogate", run) for run in range(work.plan.number_of_runs)]
    figures = [
        read_about(path, "surrogate")["fitted"]["figures"]
        for path in map(work.files.path, made)
        if path.exists()
    ]
    outputs = work.case.outputs
    if not figures:
        return {}
    return {
        "rmse": {n: float(np.mean([f[f"rmse_{n}"] for f in figures])) for n in outputs.names},
        "nrmse": {n: float(np.mean([f[f"nrmse_{n}"] for f in figures])) for n in outputs.names},
        "unit": outputs.units[0],
    }


def _fidelity_of(work: Work, source: str, healthy: int = 0) -> Fidelity | None:
    """The fidelity of a source over all folds; None if no healthy trajectory is held out."""
    labels = work.files.real_data().labels
    parts = [
        Fidelity.load(work.files.path(job))
        for job in work.fidelity_jobs(source, healthy)
        if (labels[list(work.roles.folds[job.fold][1])] == HEALTHY).any()
    ]
    return Fidelity.concatenate(parts) if parts else None


def _fidelity_arrays(source: str, found: Fidelity) -> dict[str, NDArray]:
    """The arrays of the report's figures.

    `z/SOURCE/observed` and `/predicted` (k, d), per segment, NaN where z is not identified, and
    `/trajectory` (k,), the index of the trajectory of each observed segment;
    `pit/SOURCE` (3, 20), see `Fidelity.pit_shares`; `bands/SOURCE/…`: `nominal` and `observed`
    (2, P, d), `seen` (2, P), `quantiles` (2, 5, P, d), `ids` (2,), of the trajectory with the
    median energy score and of the one with the worst; `rate` in Hz.
    """
    identified = np.isfinite(found.segment_values).any(axis=-1)
    order = np.argsort(found.energy, kind="stable").tolist()
    index = list(dict.fromkeys([order[(len(order) - 1) // 2], order[-1]]))
    return {
        f"z/{source}/observed": found.segment_values[:, 0][identified[:, 0]].astype(np.float32),
        f"z/{source}/trajectory": np.nonzero(identified[:, 0])[0].astype(np.int32),
        f"z/{source}/predicted": found.segment_values[:, 1:][identified[:, 1:]].astype(np.float32),
        f"pit/{source}": found.pit_shares(),
        f"bands/{source}/nominal": found.nominal[index].astype(np.float32),
        f"bands/{source}/observed": found.observed[index].astype(np.float32),
        f"bands/{source}/seen": found.seen[index],
        f"bands/{source}/quantiles": found.bands[index].astype(np.float32),
        f"bands/{source}/ids": found.ids[index],
        f"bands/{source}/rate": np.array(found.rate),
    }


def _overlay_arrays(work: Work, test: Trajectories, overlay: Overlay) -> dict[str, NDArray]:
    """The simulated test trajectories at the sensor's rate, in the order of `data.test.ids`.

    `portrait/commands` (n, P, d_u), `/nominal`, `/observed` (n, P, d), the latter NaN where not
    measured, and `/rate` in Hz; the rest as in `Overlay`. Of a case with a body the skeletons
    `pose/nominal`, `pose/observed` and, of the median of the updated twin's draws, `pose/updated`
    (n, P, points, 3) in m.
    """
    every = max(1, round(test.rate / work.case.sensor_rate))
    arrays = {name: getattr(test, name)[:, ::every] for name in PER_SAMPLE}
    slow = test.replace(**arrays, rate=test.rate / every)
    names = overlay.ids.tolist()
    order = [names.index(name) for name in test.ids.tolist()]
    found = {
        "commands": slow.commands,
        "nominal": slow.nominal,
        "observed": slow.measured,
        **{name: getattr(overlay, name)[order] for name in ("bands", "z", "deviation", "times")},
        "rate": np.array(slow.rate),
    }
    made = {f"portrait/{name}": each for name, each in found.items()}
    if (body := work.case.body) is not None:
        median = found["bands"][:, 2].astype(slow.observed.dtype)
        predicted = slow.replace(observed=median, mask=np.ones(median.shape, dtype=bool))
        poses = (*body.poses(slow), body.poses(predicted)[1])
        for name, each in zip(("nominal", "observed", "updated"), poses, strict=True):
            made[f"pose/{name}"] = body.skeleton(each)
    return {name: each.astype(np.float32) for name, each in made.items()}


def _machine() -> dict[str, str]:
    return {
        **{name: version(name) for name in ("retwin", "torch", "numpy")},
        "python": platform.python_version(),
        "machine": platform.platform(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
