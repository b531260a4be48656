"""`retwin fit`: a twin updated by real records, its correction chosen by parts of them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retwin import catalog
from retwin.checks import given, require
from retwin.checks import one_of as in_catalog
from retwin.cli.completion import one_of
from retwin.cli.dynamics import LARGEST, SIGNIFICANT, fit_equations, white_errors
from retwin.cli.methods import fit_method, residual_line
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
    correction of the outputs. An option that names a method forces it, without a comparison; so
    does a case with classes.
    """
    from retwin.evaluation.choice.stand_in import Simulating, stand_in
    from retwin.update.residual.fitting import calibrating

    holds = ("model.json", "weights.safetensors", "surrogate", "residual", "choice.json")
    check_place(out, folder=True, holds=(*holds, "report.html"))
    seconds = seconds_of("--horizon", horizon)
    in_catalog("--surrogate", surrogate, catalog.SURROGATE_MODES)
    system = _system(case, network, correction, density, refine)
    named = (network, correction, density, twin_data, simulations)
    forced = dynamics or refine or calibrate_on != "healthy" or any(x is not None for x in named)
    compared = not (forced or system.diagnosed)
    require(
        compared or (horizon == "free" and surrogate == "auto"),
        "--horizon, --surrogate",
        expected="neither where a method is named, or the case has classes: nothing is compared",
        got=f"--horizon {horizon}, --surrogate {surrogate}",
        remedy="leave them out, or the options that name a method",
    )
    measured = _measured(system, real, data, max_bytes, mapping)
    # The path is absolute, since a model is also used from other folders.
    name = str(Path(case).resolve()) if Path(case).suffix.lower() == ".toml" else case
    if dynamics:
        fit_equations(system, measured, out, name, seed, as_json=as_json)
        return
    measured = _labelled(system, measured)
    faults = system.faults if calibrate_on == "all" else calibrate_on
    calibrating(measured, faults)  # before a surrogate is trained, which takes minutes
    if not compared:
        fit_method(
            system, measured, faults, name, out, twin_data=twin_data, simulations=simulations,
            max_bytes=max_bytes, seed=seed, as_json=as_json,
        )  # fmt: skip
        return
    how = Simulating(surrogate, system.sampler, system.per_class, system.network, system.training)
    with bar("fit") as show:
        twin, text = stand_in(
            system.twin, measured, how, seed=seed, progress=lambda s: show("surrogate", s)
        )
    if text:
        note(text)
    settings = _choice(system, seconds)
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
    from retwin.report.choice import fit_page

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
        found.save(out, page=fit_page(found, str(out), title=system.title))
        if yardstick:
            note(f"Saved {out}; now models without the twin, to be compared with")
            found = with_yardstick(found, seed=seed, progress=lambda s: show("yardstick", s))
            found.save(out, page=fit_page(found, str(out), title=system.title))
    _print(found, twin, out, as_json=as_json)


def _choice(system: Case, horizon: float | None) -> Choice:
    """The settings of the comparison, by the case."""
    import retwin as rt
    from retwin.update.residual import Density as PerSegment
    from retwin.update.residual import SequenceMixture

    own, density = system.correction, system.density
    return rt.Choice(
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


def _print(found: Fitted, twin: Twin, out: Path, *, as_json: bool) -> None:
    """Print the comparison and what it shows."""
    import retwin as rt
    from retwin.update import DynamicsTwin

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
    lines = []
    if isinstance(found.twin, rt.CorrectedTwin):
        lines.append(residual_line(found.twin.residual))
    white = {}
    if isinstance(found.twin, DynamicsTwin):
        white = white_errors(found.twin.predictive(found.records))
        lines += [
            f"One-step errors of {name} are {'not ' * (each['p'] < SIGNIFICANT)}white noise: the "
            f"largest autocorrelation is {each['autocorrelation']:.2g} at {each['lag']:.3g} s "
            f"(95 % limit {each['limit']:.2g}, Ljung and Box p = {each['p']:.2g})."
            for name, each in white.items()
        ]
    surrogate = _surrogate_rows(twin)
    if surrogate:
        own = [
            (e["output"], f"{e['rmse']:.3g} {e['unit']}", f"{e['nrmse']:.2%}") for e in surrogate
        ]
        text = "Surrogate on held-out twin trajectories:"
        shown += [text, table(("output", "RMSE", "NRMSE"), own, numbers=("RMSE", "NRMSE")), ""]
    failed = [f"{each.title}: {each.reason}" for each in found.scores if each.reason]
    values = {"saved": str(out), **found.values, "surrogate": surrogate, "one_step_errors": white}
    answer(values, *shown, *found.remarks, *lines, *failed, as_json=as_json)
    note(f"Saved {out}, with the comparison in {out / 'report.html'}")


def _surrogate_rows(twin: Twin) -> list[dict[str, Any]]:
    """The errors of a surrogate on simulations of the twin that were held out."""
    import retwin as rt

    if not isinstance(twin, rt.Surrogate) or twin.fitted is None:
        return []
    figures, channels = twin.fitted.figures, twin.outputs
    return [
        {"output": n, "unit": u, "rmse": figures[f"rmse_{n}"], "nrmse": figures[f"nrmse_{n}"]}
        for n, u in zip(channels.names, channels.units, strict=True)
    ]
