"""`retwin fit`, `generate` and `diagnose`: the steps one by one."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from retwin.cli.terminal import bar
from retwin.configs import named
from retwin.storage import check_target, write_atomically

__all__ = ["diagnose", "fit", "generate"]

CaseName = Annotated[str, typer.Argument(help="Built-in case or package.module:object.")]
Seed = Annotated[int, typer.Option(help="Same seed, same result.", min=0)]


def fit(
    case: CaseName,
    twin_data: Annotated[Path, typer.Option(help="Trajectories of the twin.")],
    real: Annotated[Path, typer.Option(help="Real trajectories to calibrate on.")],
    out: Annotated[Path, typer.Option(help="Folder for the corrected twin.")],
    network: Annotated[str, typer.Option(help="Surrogate: mlp, lstm or tcn.")] = "mlp",
    correction: Annotated[
        str | None, typer.Option(help="delay_offset or command_space; the case's if not given.")
    ] = None,
    density: Annotated[str, typer.Option(help="Law of the gap: mixture or flow.")] = "mixture",
    refine: Annotated[bool, typer.Option(help="Fine-tune on outputs afterwards.")] = False,
    calibrate_on: Annotated[str, typer.Option(help="healthy or all.")] = "healthy",
    seed: Seed = 0,
) -> None:
    """Fit surrogate and residual model; save the corrected twin."""
    import retwin as rt
    from retwin.corrections import NAMED_OPERATORS
    from retwin.networks import SURROGATES
    from retwin.residual import NAMED_DENSITIES

    system = rt.cases.get(case)
    config = named(network, SURROGATES, "network")
    operator = system.correction
    if correction is not None:
        operator = named(correction, NAMED_OPERATORS, "correction")
    law = replace(
        named(density, NAMED_DENSITIES, "density"), refinement=rt.Refinement() if refine else None
    )
    with bar("read") as tell:
        twin = rt.load(twin_data, case=system, progress=lambda s: tell(twin_data.name, s))
        measured = rt.load(real, case=system, progress=lambda s: tell(real.name, s))
    with bar("fit") as tell:
        ibg = rt.fit_surrogate(twin, config, seed=seed, progress=lambda s: tell("surrogate", s))
        rg = rt.fit_residual(
            ibg,
            measured,
            operator,
            law,
            seed=seed,
            calibrate_on=system.faults if calibrate_on == "all" else calibrate_on,
            progress=lambda s: tell("residual model", s),
        )
    rt.CorrectedTwin(ibg, rg, case=case).save(out)
    table = Table("output", "RMSE", "NRMSE")
    assert ibg.fitted is not None
    assert rg.fitted is not None
    for name, unit in zip(ibg.outputs.names, ibg.outputs.units, strict=True):
        figures = ibg.fitted.figures
        table.add_row(
            name, f"{figures[f'rmse_{name}']:.3g} {unit}", f"{figures[f'nrmse_{name}']:.2%}"
        )
    console = Console()
    console.print("Surrogate on held-out twin trajectories:")
    console.print(table)
    console.print(
        f"Residual model: {rg.fitted.figures['movements']:.0f} movements of "
        f"{rg.fitted.figures['trajectories']:.0f} "
        f"{'EMULATED ' if rg.emulated else ''}trajectories; {rg.fitted.reason}."
    )
    console.print(f"Saved {out}", soft_wrap=True)


def generate(
    model: Annotated[Path, typer.Argument(help="Folder of a corrected twin.")],
    out: Annotated[Path, typer.Option(help="File to write, .npz or .zarr.")],
    per_class: Annotated[int, typer.Option(help="Trajectories per class.")] = 400,
    case: Annotated[
        str | None, typer.Option(help="Case, if another than the twin was fitted for.")
    ] = None,
    seed: Seed = 0,
) -> None:
    """Generate a balanced labelled set from a corrected twin."""
    import retwin as rt

    check_target(out)
    updated = rt.CorrectedTwin.load(model)
    if not (case or updated.case):
        raise rt.InputError(
            "case",
            expected="the name of a case",
            got=f"none, and {model} was saved without one",
            remedy="give --case",
        )
    system = rt.cases.get(case or updated.case)
    with bar("generate") as tell:
        made = rt.generate(
            updated, system, per_class=per_class, seed=seed, progress=lambda s: tell("", s)
        )
    rt.save(made, out)
    Console().print(f"Wrote {len(made)} trajectories to {out}", soft_wrap=True)


diagnose = typer.Typer(help="Train a diagnoser, and use it.", no_args_is_help=True)


@diagnose.command("fit", epilog="Example: `retwin diagnose fit made.npz --out cnn`")
def diagnose_fit(
    file: Annotated[Path, typer.Argument(help="Labelled trajectories.")],
    out: Annotated[Path, typer.Option(help="Folder for the diagnoser.")],
    classifier: Annotated[str, typer.Option(help="cnn, lstm or rocket.")] = "cnn",
    case: Annotated[str | None, typer.Option(help="Case the file belongs to.")] = None,
    rate: Annotated[float | None, typer.Option(help="Hz that the classifier looks at.")] = None,
    seed: Seed = 0,
) -> None:
    """Train a diagnoser on labelled trajectories."""
    import retwin as rt
    from retwin.networks import CLASSIFIERS

    system = None if case is None else rt.cases.get(case)
    fit: dict[str, Callable[..., Any]] = {
        name: partial(rt.fit_diagnoser, network=network) for name, network in CLASSIFIERS.items()
    }
    chosen = named(classifier, {**fit, "rocket": rt.fit_rocket}, "classifier")
    with bar("diagnose") as tell:
        training = rt.load(file, case=system, progress=lambda s: tell("read", s))
        diagnoser = chosen(
            training,
            seed=seed,
            classes=None if system is None else system.classes,
            rate=rate,
            progress=lambda s: tell("train", s),
        )
    diagnoser.save(out)
    assert diagnoser.fitted is not None
    console = Console()
    console.print(
        f"Accuracy on the held-out fifth of {file.name}: {diagnoser.fitted.figures['accuracy']:.3f}"
    )
    console.print(f"Saved {out}", soft_wrap=True)


@diagnose.command("invert", epilog="Example: `retwin diagnose invert model real.mat --out physics`")
def diagnose_invert(
    model: Annotated[Path, typer.Argument(help="Folder of a corrected twin, in command space.")],
    real: Annotated[Path, typer.Argument(help="The trajectories it was calibrated on.")],
    out: Annotated[Path, typer.Option(help="Folder for the diagnoser.")],
    random_onset: Annotated[
        bool, typer.Option(help="Leave the onset of stuck motors open.")
    ] = False,
) -> None:
    """Make a diagnoser by physics: no training, only healthy trajectories are used."""
    import retwin as rt

    updated = rt.CorrectedTwin.load(model)
    system = rt.cases.get(updated.case)
    if random_onset:
        system = system.with_random_onset()
    with bar("invert") as tell:
        calibration = rt.load(real, case=system, progress=lambda s: tell("read", s))
        diagnoser = rt.fit_inversion(
            updated.surrogate, updated.residual, calibration, system.faults
        )
    diagnoser.save(out)
    Console().print(f"Saved {out}", soft_wrap=True)


@diagnose.command("predict", epilog="Example: `retwin diagnose predict cnn real.mat --case armpi`")
def diagnose_predict(
    model: Annotated[Path, typer.Argument(help="Folder of a diagnoser.")],
    file: Annotated[Path, typer.Argument(help="Trajectories; labels are not needed.")],
    case: Annotated[str | None, typer.Option(help="Case the file belongs to.")] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file for all probabilities.")] = None,
) -> None:
    """Say which class each trajectory belongs to, and score it where labels are known."""
    import retwin as rt

    diagnoser = rt.load_diagnoser(model)
    system = None if case is None else rt.cases.get(case)
    with bar("read") as tell:
        trajectories = rt.load(file, case=system, progress=lambda s: tell(file.name, s))
    probabilities = diagnoser.predict_proba(trajectories)
    table = Table("trajectory", "diagnosis", "probability", "label")
    best = probabilities.argmax(axis=1)
    for i, index in enumerate(best):
        table.add_row(
            str(trajectories.ids[i]),
            diagnoser.classes[index],
            f"{probabilities[i, index]:.2f}",
            str(trajectories.labels[i]),
        )
    console = Console()
    console.print(table)
    if trajectories.emulated:
        console.print("These trajectories are EMULATED: no real measurements.")
    if trajectories.known_labels and "" not in trajectories.labels:
        console.print(str(rt.evaluate(diagnoser, trajectories)))
    if out is not None:
        with write_atomically(out) as part, part.open("w", newline="", encoding="utf-8") as sheet:
            writer = csv.writer(sheet)
            writer.writerow(["trajectory", *diagnoser.classes])
            for name, row in zip(trajectories.ids, probabilities.tolist(), strict=True):
                writer.writerow([name, *row])
        console.print(f"Wrote {out}", soft_wrap=True)
