"""`retwin study`, `report` and `demo`: the comparison of sources, and its page."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from retwin.cli.terminal import INTERRUPTED, bar, complain
from retwin.errors import InputError

__all__ = ["demo", "report", "study"]

COLUMNS = {
    "macro_f1": "macro-F1",
    "balanced_accuracy": "balanced acc.",
    "auroc": "AUROC",
    "healthy_recall": "healthy recall",
    "rmse": "RMSE",
    "nrmse": "NRMSE",
    "crps": "CRPS",
    "coverage90": "in 90 % band",
}


def study(
    case: Annotated[str, typer.Argument(help="Built-in case, case.toml, or module:object.")],
    out: Annotated[Path, typer.Option(help="Folder; called again, the study goes on there.")],
    twin_data: Annotated[Path | None, typer.Option(help="Trajectories of the twin.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="Real set to calibrate on.")] = None,
    test: Annotated[Path | None, typer.Option(help="Real set to test on.")] = None,
    real: Annotated[Path | None, typer.Option(help="One real set, split into folds.")] = None,
    folds: Annotated[int, typer.Option(help="Folds of --real.")] = 3,
    data: Annotated[Path | None, typer.Option(help="One file that the case splits itself.")] = None,
    sources: Annotated[
        str | None,
        typer.Option(help="Names joined by commas, or all; by default twin, IBG, IBG + RG."),
    ] = None,
    classifier: Annotated[str | None, typer.Option(help="cnn, lstm or rocket.")] = None,
    runs: Annotated[int | None, typer.Option(help="Runs; the preset's if not given.")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same result.", min=0)] = 0,
    preset: Annotated[str, typer.Option(help="quick or paper.")] = "quick",
    rate: Annotated[float | None, typer.Option(help="Hz that the classifier looks at.")] = None,
    per_class: Annotated[
        int | None, typer.Option(help="Generated trajectories per class; the case's if not given.")
    ] = None,
    calibrate_on: Annotated[str, typer.Option(help="healthy or all.")] = "healthy",
    random_onset: Annotated[bool, typer.Option(help="Draw the onset of stuck motors.")] = False,
    encoder_noise: Annotated[
        float, typer.Option(help="Command units of noise on frozen joints, training and test.")
    ] = 0.0,
    learning_curve: Annotated[
        bool, typer.Option(help="Also calibrate on 1, 2, 4, 6 … healthy trajectories.")
    ] = False,
    processes: Annotated[int | None, typer.Option(help="Jobs at a time; one per core.")] = None,
) -> None:
    """Compare updated twins and their rivals on real trajectories."""
    import retwin as rt
    from retwin.study import StudyData, StudyPlan, possible_sources

    system = rt.cases.get(case)
    if random_onset:
        system = system.with_random_onset()
    plain = "dt" if system.diagnosed else "twin"
    usual = (plain, "ibg", "ibg_rg")
    plan = StudyPlan(
        sources=usual if sources in (None, "all") else tuple(sources.split(",")),
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
    _run(system, plan, StudyData(twin_data, calibration, test, real, data), out, processes)


def report(folder: Annotated[Path, typer.Argument(help="Folder of a study.")]) -> None:
    """Write the report page again from a study's results."""
    from retwin.report import write_report

    Console().print(str(write_report(folder)), soft_wrap=True)


def demo(
    out: Annotated[
        Path | None, typer.Option(help="Folder for results; demo/real or demo/emulated.")
    ] = None,
    runs: Annotated[int, typer.Option(help="Runs.")] = 1,
    seed: Annotated[int, typer.Option(help="Same seed, same result.", min=0)] = 0,
) -> None:
    """The whole job of the paper, on real data in `RETWIN_DATA` if set, else on emulated ones."""
    import retwin as rt
    from retwin.study import StudyData, StudyPlan

    data, folds = StudyData(), 3
    folder = os.environ.get("RETWIN_DATA")
    if folder:
        arm = Path(folder) / "armpi"
        given = [arm / name for name in ("real_a.mat", "my_dataset_test.mat")]
        real = next((file for file in given if file.exists()), None)
        if real is None:
            raise InputError(
                "RETWIN_DATA",
                expected="a folder with armpi/real_a.mat or armpi/my_dataset_test.mat",
                got=folder,
                remedy="set it to the folder of the public data, or unset it",
            )
        recorded = arm / "sim.mat"
        data = StudyData(twin=recorded if recorded.exists() else None, real=real)
    target = out or Path("demo", "real" if folder else "emulated")
    plan = StudyPlan(runs=runs, seed=seed, folds=folds)
    _run(rt.cases.get("armpi"), plan, data, target, None)


def _run(case: Any, plan: Any, data: Any, out: Path, processes: int | None) -> None:
    from retwin.report import write_report
    from retwin.study import run_study

    command = shlex.join(["retwin", *sys.argv[1:]])
    try:
        with bar("study") as tell:
            results = run_study(
                case, plan, data, out, processes=processes, report=tell, command=command
            )
            tell("report", 1.0)
            page = write_report(out)
    except KeyboardInterrupt:
        # Typer would end without a word.
        complain(f"interrupted; give the same command again to go on: {command}")
        raise typer.Exit(INTERRUPTED) from None
    console = Console()
    console.print(_table(results))
    for line in _gaps(results):
        console.print(line)
    console.print(f"Report: {page}", soft_wrap=True)


def _table(results: Mapping[str, Any]) -> Table:
    n, runs = results["data"]["test"]["n"], results["runs"]
    kind = "EMULATED data (no real measurements)" if results["emulated"] else results["title"]
    counted = f"{runs} run{'s' if runs > 1 else ''}"
    what = f"{n} test trajector{'ies' if n > 1 else 'y'}"
    told = [kind + f": {what}", counted, results["classifier"]]
    table = Table(title=", ".join(filter(None, told)))
    sources = results["sources"]
    shown = {
        name: title for name, title in COLUMNS.items() if any(name in s for s in sources.values())
    }
    table.add_column("training data" if results["classes"] else "source")
    for title in shown.values():
        table.add_column(title, justify="right")
    for source in sources.values():
        table.add_row(source["title"], *(_over_runs(source[metric]) for metric in shown))
    for name, figures in results["published"].items():
        title = sources[name]["title"] if name in sources else name
        table.add_row(f"  paper: {title}", *(figures.get(m, "") for m in shown), style="dim")
    return table


def _over_runs(values: list[float]) -> str:
    if not np.isfinite(values).all():
        return "–"
    mean = f"{np.mean(values):.3f}"
    return mean if len(values) < 2 else f"{mean} ± {np.std(values, ddof=1):.3f}"


def _gaps(results: Mapping[str, Any]) -> list[str]:
    """What each source gains over the plain twin, with the interval over test trajectories."""
    told = []
    first, metric = next(iter(results["sources"])), "macro_f1" if results["classes"] else "nrmse"
    for row in results["comparisons"]:
        if row["b"] == first and row["metric"] == metric:
            low, high = row["bootstrap_ci95"]
            told.append(
                f"{row['a']} - {first}, {COLUMNS[metric]}: {row['mean_diff']:+.3f} "
                f"(95 % bootstrap interval {low:+.3f} to {high:+.3f})"
            )
    return told
