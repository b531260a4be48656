"""`retwin study`, `report` and `demo`: the comparison of sources, and its page."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.table import Table

from retwin import catalog
from retwin.checks import given
from retwin.cli.options import (
    CaseArgument,
    Json,
    LogMapping,
    Seed,
    argument,
    complete_sources,
    option,
    rare,
)
from retwin.cli.plans import Scheduler
from retwin.cli.terminal import answer, bar, command_given, note, plain, resumable, table
from retwin.progress import FinishedStage

if TYPE_CHECKING:
    from retwin.results import Results

COLUMNS = {name: metric.head for name, metric in catalog.METRICS.items() if metric.head}
"""Scores that are shown, and the heads of their columns."""
DEMO = ("dt", "ibg_rg_command", "inversion")
"""What the demo compares: the original twin, and what is best here."""
DEMO_SETTINGS: Any = {
    "folds": 2,
    "per_class": 100,  # generated trajectories, a quarter of a study's, which keeps it short
    "emulated_healthy": 125,  # a promise at 5 % false alarms can then be decided
    "calibrated": 20,  # healthy trajectories of each fold: of real machines there are few
    "simulated": 10,  # healthy trajectories of each fold
    "overlaid": 1,  # faulty trajectories of each class and fold, which the page shows in full
}
"""Settings of the plan of the demo."""
COMPARED = {"a", "b", "metric", "mean_diff", "bootstrap_ci95", "p_verdict", "no_verdict"}
"""What is printed of a comparison as JSON."""
Folds = Annotated[int, option("N", "Folds of --real.")]
Runs = Annotated[int | None, option("N", "Runs; else the preset's.")]
Rate = Annotated[float | None, rare("HZ", "Rate of the features; else the sensor's.")]


def study(
    case: CaseArgument,
    out: Annotated[Path, option("FOLDER", "Called again, the study goes on there.")],
    real: Annotated[Path | None, option("FILE", "One real set, split into --folds.")] = None,
    folds: Folds = 3,
    calibration: Annotated[
        Path | None, option("FILE", "Or one to calibrate on, and --test.")
    ] = None,
    test: Annotated[Path | None, option("FILE", "One to test on.")] = None,
    data: Annotated[Path | None, option("FILE", "Or one file that the case splits.")] = None,
    twin_data: Annotated[
        Path | None, option("FILE", "Trajectories of the twin; else simulated.")
    ] = None,
    mapping: LogMapping = None,
    sources: Annotated[
        str | None,
        option(
            "NAMES",
            "Joined by commas, or all; else dt (or twin), ibg, ibg_rg.",
            autocompletion=complete_sources,
        ),
    ] = None,
    preset: Annotated[
        str, option("NAME", "quick or paper: classifier, training, runs.", names=catalog.PRESETS)
    ] = "quick",
    runs: Runs = None,
    per_class: Annotated[
        int | None, option("N", "Generated trajectories; else the case's.")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
    classifier: Annotated[
        str | None,
        rare("NAME", "cnn, lstm or rocket; else the preset's.", names=catalog.CLASSIFIERS),
    ] = None,
    rate: Rate = None,
    calibrate_on: Annotated[
        str, rare("NAME", "healthy or all.", names=catalog.CALIBRATE_ON)
    ] = "healthy",
    random_onset: Annotated[
        bool, rare("", "Draw the onset of stuck motors.", "--random-onset")
    ] = False,
    encoder_noise: Annotated[float, rare("X", "Noise on frozen joints, in command units.")] = 0.0,
    learning_curve: Annotated[
        bool, rare("", "Also calibrate on 1, 2, 4, 6 … healthy ones.", "--learning-curve")
    ] = False,
    processes: Annotated[int | None, rare("N", "Jobs at a time; else one per core.")] = None,
    scheduler: Scheduler = None,
) -> None:
    """Compare updated twins with other sources on real trajectories."""
    import retwin as rt
    from retwin.study import StudyData, StudyPlan, possible_sources

    system = rt.cases.get(case)
    if random_onset:
        system = system.with_random_onset()
    plain = "dt" if system.diagnosed else "twin"
    default = (plain, "ibg", "ibg_rg")
    plan = StudyPlan(
        sources=default if sources in (None, "all") else tuple(sources.split(",")),
        preset=preset,
        classifier=classifier,
        runs=runs,
        seed=seed,
        folds=folds,
        rate=rate,
        per_class=per_class,
        calibrate_on=calibrate_on,
        encoder_noise=encoder_noise,
        learning_curve=learning_curve,
    )
    if sources == "all":
        plan = replace(plan, sources=possible_sources(system, plan))
    found = StudyData(twin_data, calibration, test, real, data, mapping)
    where = {"processes": processes, "scheduler": scheduler}
    _run(system, plan, found, out, as_json=as_json, **where)


def report(
    folder: Annotated[Path, argument("STUDY", "Folder of a study.")],
    figures: Annotated[bool, option("", "Also figures/*.png, for a paper.", "--figures")] = False,
) -> None:
    """Write the report page again from a study's results."""
    from retwin.report import write_report

    page = write_report(folder, figures=figures)
    answer(page, str(page))


def demo(
    out: Annotated[
        Path | None, option("FOLDER", "Else demo/real, or demo/emulated without real data.")
    ] = None,
    runs: Annotated[int, option("N", "Runs.")] = 1,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Update the twin of a robot arm, emulated or real; write a report.

    Real data are those in the folder that `RETWIN_DATA` names.
    """
    import retwin as rt
    from retwin.study import StudyData, StudyPlan
    from retwin.update.surrogate import surrogate_training

    data, folder = StudyData(), os.environ.get("RETWIN_DATA")
    if folder:
        sets = Path(folder) / "armpi"
        names = [sets / name for name in ("real_a.mat", "my_dataset_test.mat")]
        real = next((file for file in names if file.exists()), None)
        expected = "a folder with armpi/real_a.mat or armpi/my_dataset_test.mat"
        remedy = "set it to the folder of the public data, or unset it"
        real = given("RETWIN_DATA", real, expected, got=folder, remedy=remedy)
        recorded = sets / "sim.mat"
        data = StudyData(twin=recorded if recorded.exists() else None, real=real)
    target = out or Path("demo", "real" if folder else "emulated")
    plan = StudyPlan(DEMO, runs=runs, seed=seed, ablations=False, **DEMO_SETTINGS)
    titles = ", ".join(catalog.SOURCES[name].title for name in DEMO)
    kind = "real" if folder else "emulated"
    # Minutes that a run of the demo takes at most on two cores, as measured.
    minutes = 2 * plan.number_of_runs
    note(f"Compares on {kind} data, within {minutes} minutes on two quiet cores: {titles}.")
    arm = rt.cases.get("armpi")
    # Epochs of the demo's surrogate, whose error is then a tenth of the discrepancy.
    training = replace(surrogate_training(arm.network), max_epochs=6)
    _run(replace(arm, training=training), plan, data, target, as_json=as_json)
    note("Next: watch a machine live with retwin monitor run --demo --open;")
    note("or start with a twin and records of your own: retwin identify --help.")


def _run(case: Any, plan: Any, data: Any, out: Path, *, as_json: bool, **where: Any) -> None:
    """Run a study `where` `run_study` is to run it, write its page, and print what it says."""
    from retwin.report import write_report
    from retwin.study import run_study

    with resumable(), bar("study") as show:
        given = command_given()
        results = run_study(case, plan, data, out, report=show, command=given, **where)
        show("report", 0.99)
        page = write_report(out)
        show(FinishedStage("report"), 1.0)
    shown = (_title(results), _uses(results), "", _table(results))
    answer(_summary(results, page), *shown, as_json=as_json)
    note(f"Report: {page}")


def _summary(results: Results, page: Path) -> dict[str, Any]:
    """The contents of the table as JSON; everything else is in results.json."""
    from retwin.report.verdict import outcome_of

    shown = _metrics(results)
    return {
        "title": results.title,
        "emulated": results.emulated,
        "classifier": results.classifier,
        "runs": results.runs,
        "test_trajectories": results.data.test.n,
        "sources": {
            name: {"title": source.title, **{metric: source.runs(metric) for metric in shown}}
            for name, source in results.sources.items()
        },
        "comparisons": [
            row.model_dump(include=COMPARED) | {"outcome": outcome_of(row)}
            for row in results.comparisons
        ],
        "uses": [use.model_dump() for use in results.uses],
        "report": str(page),
    }


def _title(results: Results) -> str:
    n, runs = results.data.test.size, results.runs
    kind = "EMULATED data (no real measurements)" if results.emulated else results.title
    counted = f"{runs} run{'s' if runs > 1 else ''}"
    what = f"{n} test trajector{'ies' if n > 1 else 'y'}"
    classifier = (results.classifier or "").upper()
    return ", ".join(filter(None, (f"{kind}: {what}", counted, classifier)))


def _table(results: Results) -> Table:
    from retwin.report.labels import source_name

    sources, shown = results.sources, _metrics(results)
    titles = [COLUMNS[metric] for metric in shown]
    rows = [
        (source_name(name), *(_over_runs(source.runs(metric)) for metric in shown))
        for name, source in sources.items()
    ]
    heads = ("training data" if results.classes else "source", *titles)
    made = table(heads, rows, numbers=titles)
    for name, figures in results.published.items():
        cells = (f"  paper: {source_name(name)}", *(figures.get(metric, "") for metric in shown))
        made.add_row(*map(plain, cells), style="dim")
    return made


def _metrics(results: Results) -> list[str]:
    """The metrics of this study: those of diagnoses, or those of simulations."""
    return [metric for metric in COLUMNS if results.has(metric)]


def _over_runs(values: list[float]) -> str:
    from retwin.report.labels import mean_and_deviation

    return mean_and_deviation(values) if np.isfinite(values).all() else "–"


def _uses(results: Results) -> Table:
    """The four uses, as on the first screen of the page."""
    from retwin.report.uses import use_rows

    rows = []
    for row in use_rows(results):
        reached = f"{row.source}: {row.reached}" if row.source else row.reached
        answer = f"{row.title}\n{row.answer} {row.scope}".rstrip()
        rows.append((answer, f"Requires {row.required}.\n{reached}\nMissing: {row.missing}."))
    return table(("use", "best updated source, and what it reaches"), rows)
