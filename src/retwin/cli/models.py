"""`retwin fit`, `generate` and `diagnose`: the steps one by one."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from retwin.cli.terminal import bar
from retwin.configs import named
from retwin.storage import check_target, write_atomically
from retwin.trajectories import Trajectories
from retwin.twins.protocol import HEALTHY

if TYPE_CHECKING:
    from retwin.case import Case
    from retwin.residual import ResidualModel, SequenceResidual
    from retwin.surrogate import Surrogate

__all__ = ["diagnose", "fit", "generate"]

CaseName = Annotated[str, typer.Argument(help="Built-in case, case.toml, or module:object.")]
Seed = Annotated[int, typer.Option(help="Same seed, same result.", min=0)]


def fit(
    case: CaseName,
    out: Annotated[Path, typer.Option(help="Folder for the corrected twin.")],
    real: Annotated[
        Path | None, typer.Option(help="Real trajectories to calibrate on.", show_default=False)
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Or one file that the case splits; its first part serves.")
    ] = None,
    twin_data: Annotated[
        Path | None, typer.Option(help="Trajectories of the twin; simulated if not given.")
    ] = None,
    simulations: Annotated[
        int | None, typer.Option(help="How many, without --twin-data; the case's if not given.")
    ] = None,
    network: Annotated[
        str | None, typer.Option(help="Surrogate: mlp, lstm, tcn or state_space.")
    ] = None,
    correction: Annotated[
        str | None, typer.Option(help="additive, delay_offset or command_space.")
    ] = None,
    density: Annotated[
        str | None, typer.Option(help="Law of the gap: mixture, flow or sequence_mixture.")
    ] = None,
    refine: Annotated[bool, typer.Option(help="Fine-tune on outputs afterwards.")] = False,
    calibrate_on: Annotated[str, typer.Option(help="healthy or all.")] = "healthy",
    seed: Seed = 0,
) -> None:
    """Fit surrogate and residual model; save the corrected twin.

    Network, correction and density are the case's, if not given.
    """
    import retwin as rt

    system = _system(case, network, correction, density, refine)
    measured = _measured(system, real, data)
    size = system.per_class if simulations is None else simulations
    twin = _of_twin(system, twin_data, size, seed)
    with bar("fit") as tell:
        ibg = rt.fit_surrogate(
            twin,
            system.network,
            seed=seed,
            training=system.training,
            progress=lambda s: tell("surrogate", s),
        )
        rg = rt.fit_residual(
            ibg,
            measured,
            system.correction,
            system.density,
            seed=seed,
            calibrate_on=system.faults if calibrate_on == "all" else calibrate_on,
            progress=lambda s: tell("residual model", s),
        )
    # A model is used from other folders, too.
    name = str(Path(case).resolve()) if Path(case).suffix.lower() == ".toml" else case
    rt.CorrectedTwin(ibg, rg, case=name).save(out)
    console = Console()
    console.print("Surrogate on held-out twin trajectories:")
    console.print(_of_surrogate(ibg))
    console.print(_of_residual(rg))
    console.print(f"Saved {out}", soft_wrap=True)


def _system(
    case: str, network: str | None, correction: str | None, density: str | None, refine: bool
) -> Case:
    """The case, with what the command line says otherwise."""
    import retwin as rt
    from retwin.cases.file import check_density
    from retwin.corrections import NAMED_OPERATORS
    from retwin.networks import SURROGATES
    from retwin.residual import NAMED_DENSITIES, Density

    system = rt.cases.get(case)
    if network is not None:
        system = replace(system, network=named(network, SURROGATES, "network"), training=None)
    if correction is not None:
        system = replace(system, correction=named(correction, NAMED_OPERATORS, "correction"))
    if density is not None:
        system = replace(system, density=named(density, NAMED_DENSITIES, "density"))
    check_density(system.correction, system.density)
    if not refine:
        return system
    if not isinstance(system.density, Density):
        raise rt.InputError(
            "--refine",
            expected="a density of one z per movement, mixture or flow",
            got=type(system.density).__name__,
            remedy="leave it out",
        )
    return replace(system, density=replace(system.density, refinement=rt.Refinement()))


def _measured(system: Case, real: Path | None, data: Path | None) -> Trajectories:
    """The real trajectories to calibrate on."""
    import retwin as rt

    if (real is None) == (data is None):
        raise rt.InputError(
            "real data",
            expected="either --real or --data",
            got="none" if real is None else "both",
            remedy="give --real FILE; or --data FILE, for a case that says how it is split",
        )
    if real is not None:
        with bar("read") as tell:
            return rt.load(real, case=system, progress=lambda s: tell(real.name, s))
    assert data is not None
    if system.records is None:
        raise rt.InputError(
            "--data",
            expected="a case that says how its file is split",
            got=f"{system.name!r}, which does not",
            remedy="give --real FILE",
        )
    return system.records(data)[0]


def _of_twin(system: Case, file: Path | None, simulations: int, seed: int) -> Trajectories:
    """What the twin says: from a file, or healthy simulations of the case's own."""
    import retwin as rt

    if file is not None:
        with bar("read") as tell:
            return rt.load(file, case=system, progress=lambda s: tell(file.name, s))
    healthy = replace(system, faults={HEALTHY: None})
    with bar("simulate") as tell:
        return rt.generate(
            system.twin, healthy, per_class=simulations, seed=seed, progress=lambda s: tell("", s)
        )


def _of_surrogate(ibg: Surrogate) -> Table:
    assert ibg.fitted is not None
    table = Table("output", "RMSE", "NRMSE")
    figures = ibg.fitted.figures
    for name, unit in zip(ibg.outputs.names, ibg.outputs.units, strict=True):
        table.add_row(
            name, f"{figures[f'rmse_{name}']:.3g} {unit}", f"{figures[f'nrmse_{name}']:.2%}"
        )
    return table


def _of_residual(rg: ResidualModel | SequenceResidual) -> str:
    """What a residual model learned from, and how it fared on what it did not."""
    from retwin.residual import ResidualModel

    assert rg.fitted is not None
    figures, reason = rg.fitted.figures, rg.fitted.reason
    emulated = "EMULATED " if rg.emulated else ""
    if isinstance(rg, ResidualModel):
        counted = f"{figures['movements']:.0f} movements of {figures['trajectories']:.0f} "
        return f"Residual model: {counted}{emulated}trajectories; {reason}."
    latent = zip(rg.latent.names, rg.latent.units, strict=True)
    errors = ", ".join(f"{name} {figures[f'rmse_{name}']:.3g} {unit}" for name, unit in latent)
    return (
        f"Residual model: {figures['samples']:.0f} {emulated}samples; {reason}. "
        f"On parts held out its mean errs by {errors} (RMSE), and its 90 % band holds "
        f"{figures['coverage90']:.0%}."
    )


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
