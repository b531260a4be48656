"""`retwin fit`: a twin updated by real records, its correction chosen by parts of them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retwin import catalog
from retwin.checks import given, require
from retwin.cli.completion import one_of
from retwin.cli.options import CaseArgument, Horizon, Json, LogMapping, MaxBytes, Seed, seconds_of
from retwin.cli.reading import read
from retwin.cli.terminal import answer, bar, note, table
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.evaluation import Choice, Fitted
    from retwin.twins.twin import Twin

data_option, model_option, choice_option = (
    partial(typer.Option, rich_help_panel=panel)
    for panel in ("Data", "Model; by default the case's", "Choice")
)

ModelFolder = Annotated[
    Path, typer.Option(metavar="FOLDER", help="Where to save the updated twin.")
]
RealSet = Annotated[
    Path | None, data_option(metavar="FILE", help="Real trajectories to calibrate on.")
]
OneFile = Annotated[
    Path | None, data_option(metavar="FILE", help="Or one file that the case splits in two.")
]
TwinSet = Annotated[
    Path | None, data_option(metavar="FILE", help="Trajectories of the twin; else simulated.")
]
Simulations = Annotated[
    int | None, data_option(metavar="N", help="Trajectories simulated; else the case's.")
]
CalibrateOn = Annotated[
    str,
    data_option(
        metavar="NAME", help="healthy or all.", autocompletion=one_of(catalog.CALIBRATE_ON)
    ),
]
Network = Annotated[
    str | None,
    model_option(
        metavar="NAME",
        help="Of a surrogate: mlp, lstm, tcn or state_space.",
        autocompletion=one_of(catalog.NETWORKS),
    ),
]
Correction = Annotated[
    str | None,
    model_option(
        metavar="NAME",
        help="additive, delay_offset or command_space.",
        autocompletion=one_of(catalog.CORRECTIONS),
    ),
]
Density = Annotated[
    str | None,
    model_option(
        metavar="NAME",
        help="Distribution: mixture, flow or sequence_mixture.",
        autocompletion=one_of(catalog.DENSITIES),
    ),
]
Refine = Annotated[bool, model_option("--refine", help="Fine-tune on outputs afterwards.")]
StateEquations = Annotated[
    bool,
    model_option(
        "--dynamics",
        help="Correct the state equations, which are learned first if the twin is no StateTwin.",
    ),
]
SurrogateMode = Annotated[
    str,
    model_option(
        "--surrogate",
        metavar="MODE",
        help="auto (for a slow twin), on or off.",
        autocompletion=one_of(catalog.SURROGATE_MODES),
    ),
]
Yardstick = Annotated[
    bool,
    choice_option(
        "--yardstick/--no-yardstick", help="Compare with models without the twin, once saved."
    ),
]
LARGEST = 8
"""Number of terms of the state equations that are printed."""
METHODS = {"additive": "output", "delay_offset": "delay_offset", "command_space": "segments"}
"""The candidate that a correction, given by its name, stands for."""


def fit(
    case: CaseArgument,
    out: ModelFolder,
    real: RealSet = None,
    data: OneFile = None,
    horizon: Horizon = "free",
    yardstick: Yardstick = True,
    dynamics: StateEquations = False,
    correction: Correction = None,
    surrogate: SurrogateMode = "auto",
    twin_data: TwinSet = None,
    simulations: Simulations = None,
    calibrate_on: CalibrateOn = "healthy",
    network: Network = None,
    density: Density = None,
    refine: Refine = False,
    seed: Seed = 0,
    mapping: LogMapping = None,
    max_bytes: MaxBytes = None,
    as_json: Json = False,
) -> None:
    """Update a twin by real records; save the updated twin.

    Candidates are compared on parts of the records that are left out in turn, and the simplest of
    the best is taken: the twin as it is, identified parameters, corrected state equations, a
    correction of the outputs. An option that names a method forces it.
    """
    from retwin.evaluation.choice.stand_in import Simulating, needs_gradient, stand_in
    from retwin.update.residual.fitting import calibrating

    holds = ("model.json", "weights.safetensors", "surrogate", "residual", "choice.json")
    check_place(out, folder=True, holds=(*holds, "report.html"))
    seconds = seconds_of("--horizon", horizon)
    catalog_mode = catalog.SURROGATE_MODES  # checked before the work
    require(
        surrogate in catalog_mode,
        "--surrogate",
        expected=", ".join(catalog_mode),
        got=repr(surrogate),
        remedy="leave it out",
    )
    system = _system(case, network, correction, density, refine)
    measured = _labelled(system, _measured(system, real, data, max_bytes, mapping))
    # The path is absolute, since a model is also used from other folders.
    name = str(Path(case).resolve()) if Path(case).suffix.lower() == ".toml" else case
    faults = system.faults if calibrate_on == "all" else calibrate_on
    calibrating(measured, faults)  # before a surrogate is trained, which takes minutes
    settings = _choice(system, correction, seconds, dynamics=dynamics)
    recorded = None if twin_data is None else read(twin_data, system, max_bytes=max_bytes)
    given_by_user = twin_data is not None or network is not None
    if dynamics:
        twin: Twin = _with_states(system, measured, seed)
    else:
        by_gradient = getattr(settings.correction, "resolution", "") == "segment"
        wanted = given_by_user or system.diagnosed or (by_gradient and needs_gradient(system.twin))
        how = Simulating(
            "on" if surrogate == "auto" and wanted else surrogate,
            system.sampler,
            system.per_class if simulations is None else simulations,
            recorded,
            system.network,
            system.training,
            strict=given_by_user or system.diagnosed,
        )
        with bar("fit") as show:
            twin, text = stand_in(
                system.twin, measured, how, seed=seed, progress=lambda s: show("surrogate", s)
            )
        if text:
            note(text)
    if calibrate_on == "all":
        _fit_all(system, twin, measured, name, out, seed, as_json=as_json)
        return
    _fit_chosen(
        system, twin, measured, settings, name, out, seed, yardstick=yardstick, as_json=as_json
    )


def _fit_chosen(
    system: Case,
    twin: Twin,
    measured: Trajectories,
    settings: Choice,
    name: str,
    out: Path,
    seed: int,
    *,
    yardstick: bool,
    as_json: bool,
) -> None:
    """Compare, save, compare with models without the twin, and print."""
    import retwin as rt
    from retwin.evaluation.choice.fitting import with_yardstick
    from retwin.report.choice.page import write_page

    original = system.twin if isinstance(twin, rt.Surrogate) else None
    with bar("fit") as show:
        found = rt.fit(
            twin,
            measured,
            settings,
            seed=seed,
            case=name,
            original=original,
            progress=lambda s: show("candidates", s),
        )
        found.save(out)
        if yardstick and not system.diagnosed:
            note(f"Saved {out}; now models without the twin, to be compared with")
            found = with_yardstick(found, seed=seed, progress=lambda s: show("yardstick", s))
            found.save(out)
    write_page(found, out / "report.html", title=system.title)
    _print(found, twin, out, as_json=as_json)


def _fit_all(
    system: Case,
    twin: Twin,
    measured: Trajectories,
    name: str,
    out: Path,
    seed: int,
    *,
    as_json: bool,
) -> None:
    """The correction of the case, calibrated on faulty trajectories too: an ablation."""
    import retwin as rt

    with bar("fit") as show:
        residual = rt.fit_residual(
            twin,
            measured,
            system.correction,
            system.density,
            seed=seed,
            calibrate_on=system.faults,
            twin=system.twin,
            progress=lambda s: show("residual model", s),
        )
    model = rt.CorrectedTwin(twin, residual, case=name)  # type: ignore[arg-type]
    model.save(out)
    assert residual.fitted is not None
    answer(
        {"saved": str(out), "residual": residual.fitted.figures, "reason": residual.fitted.reason},
        f"Residual model of all classes: {residual.fitted.reason}.",
        as_json=as_json,
    )
    note(f"Saved {out}")


def _choice(
    system: Case, correction: str | None, horizon: float | None, *, dynamics: bool
) -> Choice:
    """The settings of the comparison, by the case and the options."""
    import retwin as rt
    from retwin.update.residual import Density as PerSegment
    from retwin.update.residual import SequenceMixture

    own, density = system.correction, system.density
    method = "dynamics" if dynamics else METHODS.get(correction or "", "")
    return rt.Choice(
        candidates=("none", "delay_offset", "segments") if system.diagnosed else (),
        method=method,
        horizon=horizon,
        dynamics=system.dynamics,
        correction=own if own.resolution == "segment" else None,
        density=density if isinstance(density, PerSegment) else rt.Mixture(),
        sequence=density if isinstance(density, SequenceMixture) else SequenceMixture(),
    )


def _labelled(system: Case, measured: Trajectories) -> Trajectories:
    """The same with labels where there can be only one: a case without faults is healthy."""
    if measured.known_labels or set(system.faults) - {HEALTHY}:
        return measured
    note(f"No trajectory has a label and the case has no faults: all count as {HEALTHY}")
    return measured.replace(labels=[HEALTHY] * len(measured))


def _system(
    case: str, network: str | None, correction: str | None, density: str | None, refine: bool
) -> Case:
    """The case, with the options of the command in place of its own."""
    import retwin as rt
    from retwin.cases.file import check_density
    from retwin.update.residual import Density

    system = rt.cases.get(case)
    if network is not None:
        system = replace(
            system, network=catalog.make(catalog.NETWORKS, network, "network"), training=None
        )
    if correction is not None:
        system = replace(
            system, correction=catalog.make(catalog.CORRECTIONS, correction, "correction")
        )
    if density is not None:
        system = replace(system, density=catalog.make(catalog.DENSITIES, density, "density"))
    check_density(system.correction, system.density)
    if not refine:
        return system
    if not isinstance(system.density, Density):
        raise rt.InputError(
            "--refine",
            expected="a density of one z per segment, mixture or flow",
            got=type(system.density).__name__,
            remedy="leave it out",
        )
    return replace(system, density=replace(system.density, refinement=rt.Refinement()))


def _measured(
    system: Case,
    real: Path | None,
    data: Path | None,
    max_bytes: int | None,
    mapping: Path | None,
) -> Trajectories:
    """The real trajectories to calibrate on."""
    require(
        (real is None) != (data is None),
        "real data",
        expected="either --real or --data",
        got="none" if real is None else "both",
        remedy="give --real FILE; or --data FILE, for a case that defines how it is split",
    )
    if real is not None:
        return read(real, system, max_bytes=max_bytes, mapping=mapping)
    assert data is not None
    expected, got = "a case that defines how its file is split", f"{system.name!r}, which does not"
    return given("--data", system.records, expected, got=got, remedy="give --real FILE")(data)[0]


def _with_states(system: Case, measured: Trajectories, seed: int) -> Twin:
    """The twin of the case, or state equations that stand in for it if it is no `StateTwin`."""
    from retwin.twins import keep_workers
    from retwin.update import fit_state_surrogate
    from retwin.update.dynamics import state_names

    if state_names(system.twin):
        return system.twin
    with keep_workers(), bar("fit") as show:
        found = fit_state_surrogate(
            system.twin,
            system.sampler,
            measured,
            system.state_surrogate,
            seed=seed,
            progress=lambda s: show("state surrogate", s),
        )
    errors = (
        f"{found.figures[f'own_{name}']:.3g} {unit} of {name}"
        for name, unit in zip(found.twin.outputs.names, found.twin.outputs.units, strict=True)
    )
    note(
        f"The twin shows no state equations. Others with {found.figures['states']:.0f} states "
        "stand in for it, learned from simulations; on the measured commands their RMS error is "
        f"{', '.join(errors)}"
    )
    return found.twin


def _print(found: Fitted, twin: Twin, out: Path, *, as_json: bool) -> None:
    """Print the comparison and what it shows."""
    units = dict(zip(found.records.outputs.names, found.records.outputs.units, strict=True))
    columns = [f"RMSE {name} [{unit}]" for name, unit in units.items()]
    rows = [
        (
            ("→ " if each.name == found.chosen else "  ") + each.title,
            *(f"{each.rmse[name]:.3g}" if each.rmse else "–" for name in units),
            "–" if not each.rmse else f"{each.crps:.4f}",
            f"{each.coverage:.0%}" if each.rmse else "–",
            f"{each.seconds:.0f} s",
        )
        for each in found.scores
    ]
    heads = ["", *columns, "CRPS", "90 % bands hold", "time"]
    how = "free simulation" if found.horizon is None else f"{found.horizon:g} s ahead"
    parameters = [
        (name, *(f"{value:.4g}" for value in each)) for name, each in found.parameters.items()
    ]
    shown: list[Any] = [
        f"Predictions of parts of the records that were left out ({how}; CRPS in standard "
        "deviations of the outputs):",
        table(heads, rows, numbers=heads[1:]),
        "",
    ]
    if parameters:
        titles = ("parameter", "before", "identified", "in the model")
        shown += [table(titles, parameters, numbers=titles[1:]), ""]
    if found.learned is not None:
        terms = [
            (each, f"{size:.3f}") for each, size in list(found.learned.terms.items())[:LARGEST]
        ]
        text = "The largest terms of the state equations, over the usual derivative of their state:"
        shown += [text, table(("term", "size"), terms, numbers=("size",)), ""]
    failed = [f"{each.title}: {each.reason}" for each in found.scores if each.reason]
    answer({"saved": str(out), **found.values}, *shown, *found.remarks, *failed, as_json=as_json)
    note(f"Saved {out}, with the comparison in {out / 'report.html'}")
