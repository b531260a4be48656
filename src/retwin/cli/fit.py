"""`retwin fit`: a twin updated by real records, its correction chosen by parts of them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from retwin import catalog
from retwin.checks import given, one_of, require
from retwin.cli import options
from retwin.cli.options import option, rare
from retwin.cli.reading import read, shown_records, stored_name
from retwin.cli.terminal import Interrupted, answer, bar, note, table
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.evaluation import Choice, Fitted
    from retwin.evaluation.choice.surrogates import StandIn, SurrogateSettings

ModelFolder = Annotated[Path, option("FOLDER", "Where to save the updated twin.")]
RealSet = Annotated[list[Path], option("FILE", "Real records; may be repeated.")]
StateEquations = Annotated[
    bool, option("", "Correct the state equations, if better.", "--dynamics")
]
Correction = Annotated[
    str | None,
    option("NAME", "additive, delay_offset or command_space.", names=catalog.CORRECTIONS),
]
Compare = Annotated[bool, rare("", "Compare candidates.", "--compare/--no-compare")]
Yardstick = Annotated[
    bool | None, rare("", "Add models without a twin.", "--yardstick/--no-yardstick")
]
TwinSet = Annotated[Path | None, rare("FILE", "Trajectories of the twin; else simulated.")]
Simulations = Annotated[int | None, rare("N", "Trajectories simulated; else the case's.")]
CalibrateOn = Annotated[str, rare("NAME", "healthy or all.", names=catalog.CALIBRATE_ON)]
SurrogateMode = Annotated[str, rare("NAME", "auto, on or off.", names=catalog.SURROGATE_MODES)]
Network = Annotated[
    str | None,
    rare("NAME", "Of a surrogate: mlp, lstm, tcn or state_space.", names=catalog.NETWORKS),
]
Density = Annotated[
    str | None, rare("NAME", "mixture, flow or sequence_mixture.", names=catalog.DENSITIES)
]
Prior = Annotated[list[Path] | None, option("FOLDER", "Models of other such machines.")]
Refine = Annotated[bool, rare("", "Fine-tune on outputs afterwards.", "--refine")]


def fit(
    case: options.CaseArgument,
    real: RealSet,
    out: ModelFolder,
    horizon: options.Horizon = "free",
    dynamics: StateEquations = False,
    correction: Correction = None,
    prior: Prior = None,
    mapping: options.LogMapping = None,
    seed: options.Seed = 0,
    as_json: options.Json = False,
    compare: Compare = True,
    yardstick: Yardstick = None,
    surrogate: SurrogateMode = "auto",
    twin_data: TwinSet = None,
    simulations: Simulations = None,
    calibrate_on: CalibrateOn = "healthy",
    network: Network = None,
    density: Density = None,
    refine: Refine = False,
    max_bytes: options.MaxBytes = None,
) -> None:
    """Update a twin by real records; save the updated twin.

    The simplest candidate is taken that predicts left-out parts of the records
    best; or that of --dynamics, of --correction, or of a case with classes.
    """
    import retwin as rt
    from retwin.deploy.identified import identified_by
    from retwin.evaluation.choice.fitted import HOLDS
    from retwin.evaluation.choice.surrogates import SurrogateSettings
    from retwin.update.residual.fitting import calibrating
    from retwin.update.residual.priors import other_machines

    check_place(out, folder=True, holds=HOLDS)
    seconds = options.seconds_of("--horizon", horizon)
    one_of("--surrogate", surrogate, catalog.SURROGATE_MODES)
    require(
        not dynamics or (correction is network is twin_data is None and calibrate_on == "healthy"),
        "--dynamics",
        expected="neither --correction, --network, --twin-data nor --calibrate-on all",
        got="one of them",
        remedy="state equations are corrected alone, by healthy records",
    )
    system = _system(case, network, correction, density, refine, simulations)
    other_machines(prior, system.correction, system.twin)
    measured = read(real, system, part="calibration", max_bytes=max_bytes, mapping=mapping)
    measured = _labelled(system, measured)
    faults = system.faults if calibrate_on == "all" else calibrate_on
    calibrating(measured, faults)  # before a surrogate is trained, which takes minutes
    decided = compare or system.diagnosed or dynamics or correction is not None
    expected = "--dynamics or --correction with it, or a case with classes, whose own is taken"
    remedy = "name a method, or let the candidates be compared"
    require(decided, "--no-compare", expected=expected, got="neither", remedy=remedy)
    forced = system.diagnosed or correction is not None or not compare or faults != "healthy"
    method = "dynamics" if dynamics else _own(system) if forced else ""
    trained = system.diagnosed or refine or any((network, twin_data, simulations))
    equations = system.state_surrogate
    if dynamics and simulations is not None:
        equations = replace(equations, simulations=simulations)
    how = SurrogateSettings(
        "on" if trained and surrogate == "auto" else surrogate,
        system.sampler,
        system.per_class,
        system.network,
        system.training,
        read(twin_data, system, max_bytes=max_bytes) if twin_data else None,
        equations if dynamics else None,
    )
    settings = replace(
        rt.Choice.of(system),
        horizon=seconds,
        method=method,
        forced=not dynamics or not compare,
        compare=compare,
        identified=identified_by(case, measured),
        calibrate_on=faults,
        prior=prior,
    )
    name = stored_name(case)
    last = not method if yardstick is None else yardstick
    found, base = _carry_out(system, measured, how, settings, name, out, seed, yardstick=last)
    _print(found, base, out, as_json=as_json)


def _carry_out(
    system: Case,
    measured: Trajectories,
    how: SurrogateSettings,
    settings: Choice,
    name: str,
    out: Path,
    seed: int,
    *,
    yardstick: bool,
) -> tuple[Fitted, StandIn]:
    """Train a surrogate, compare, save, and compare with models without the twin."""
    import retwin as rt
    from retwin.evaluation.choice.fitting import with_yardstick
    from retwin.evaluation.choice.surrogates import stand_in
    from retwin.report.choice import fit_page
    from retwin.twins import keep_workers

    with keep_workers(), bar("fit") as show:
        base = stand_in(
            system.twin, measured, how, seed=seed, progress=lambda s: show("surrogate", s)
        )
    if base.text:
        note(base.text)
    stage = "candidates" if settings.compared else "model"
    with bar("fit") as show:
        found = rt.fit(
            base.twin,
            measured,
            settings,
            seed=seed,
            case=name,
            original=system.twin if isinstance(base.twin, rt.Surrogate) else None,
            progress=lambda s: show(stage, s),
        )
        found.save(out, page=fit_page(found, str(out), title=system.title))
        if yardstick:
            note(
                f"Saved {out}; now models without the twin, to compare it with, which may take "
                "longer: Ctrl-C ends that and keeps it, --no-yardstick leaves that out"
            )
            try:
                found = with_yardstick(
                    found,
                    seed=seed,
                    workers=os.cpu_count() or 1,
                    progress=lambda s: show("yardstick", s),
                )
            except KeyboardInterrupt:
                kept = f"{out} stays as it was saved, not compared with models without the twin"
                raise Interrupted(kept) from None
            found.save(out, page=fit_page(found, str(out), title=system.title))
    return found, base


def _own(system: Case) -> str:
    """The candidate that is the case's own correction."""
    from retwin.update.corrections import DelayOffset

    if system.correction.resolution == "step":
        return "output"
    return "delay_offset" if system.correction == DelayOffset() else "segments"


def _labelled(system: Case, measured: Trajectories) -> Trajectories:
    """The same with labels where there can be only one: a case without faults is healthy."""
    if measured.known_labels or set(system.faults) - {HEALTHY}:
        return measured
    note(f"No trajectory has a label and the case has no faults: all count as {HEALTHY}")
    return measured.replace(labels=[HEALTHY] * len(measured))


def _system(
    case: str,
    network: str | None,
    correction: str | None,
    density: str | None,
    refine: bool,
    simulations: int | None,
) -> Case:
    """The case, with the options of the command in place of its own."""
    import retwin as rt
    from retwin.cases.file import check_density
    from retwin.update.residual import Density, SequenceMixture

    system = rt.cases.get(case)
    if network is not None:
        system = replace(
            system, network=catalog.make(catalog.NETWORKS, network, "network"), training=None
        )
    if simulations is not None:
        system = replace(system, per_class=simulations)
    if correction is not None:
        own = catalog.make(catalog.CORRECTIONS, correction, "correction")
        stepwise, suited = own.resolution == "step", system.density
        if stepwise != isinstance(suited, SequenceMixture):
            suited = SequenceMixture() if stepwise else rt.Mixture()
        system = replace(system, correction=own, density=suited)
    if density is not None:
        system = replace(system, density=catalog.make(catalog.DENSITIES, density, "density"))
    check_density(system.correction, system.density)
    if not refine:
        return system
    now = system.density
    refined = given(
        "--refine",
        now if isinstance(now, Density) else None,
        "a density of one z per segment, mixture or flow",
        got=type(now).__name__,
        remedy="leave it out",
    )
    return replace(system, density=replace(refined, refinement=rt.Refinement()))


def _print(found: Fitted, base: StandIn, out: Path, *, as_json: bool) -> None:
    """Print the comparison and what it shows."""
    from retwin.report.choice import comparison_table, model_sentences, parameter_table, term_table

    shown: list[Any] = []
    for each in (comparison_table(found), parameter_table(found), term_table(found)):
        heads = [f"{column.group} {column.text}".strip() for column in each.columns]
        rows = [
            ("→ " * row[0].best + row[0].text, *(f"{cell.text} {cell.below}" for cell in row[1:]))
            for row in each.rows
        ]
        if rows:
            shown += [f"{each.title}:", table(heads, rows, numbers=heads[1:]), ""]
    if found.parts and found.chosen == found.preferred:
        shown.insert(
            2, "→ is the simplest than which none is better by over a standard error, and 2 %."
        )
    if found.parts:
        shown.insert(2, f"Errors are those of {found.how}.")
    figures, outputs = base.figures, found.records.outputs
    if figures:
        own = [
            (name, f"{figures[f'rmse_{name}']:.3g} {unit}", f"{figures[f'nrmse_{name}']:.2%}")
            for name, unit in zip(outputs.names, outputs.units, strict=True)
        ]
        text = "Surrogate on held-out twin trajectories:"
        shown += [text, table(("output", "RMSE", "NRMSE"), own, numbers=("RMSE", "NRMSE")), ""]
    failed = [f"{e.title}: {e.reason}" for e in found.scores if e.reason and found.parts]
    values = {"saved": str(out), **found.values, "surrogate": figures}
    shown += shown_records(found.checked)
    answer(values, *shown, *found.remarks, *model_sentences(found), *failed, as_json=as_json)
    note(f"Saved {out}, with the report {out / 'report.html'}")
    command = f"retwin evaluate {out} --real OTHER_LOG{found.option}"
    note(f"Next, on runs that it has not seen: {command}")
