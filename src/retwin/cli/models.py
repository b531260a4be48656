"""`retwin fit` and `generate`: a corrected twin from files, and trajectories from it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from retwin import catalog
from retwin.checks import given, require
from retwin.cli.completion import one_of
from retwin.cli.dynamics import fit_equations
from retwin.cli.options import (
    CaseArgument,
    Json,
    LogMapping,
    MaxBytes,
    Model,
    OtherCase,
    PerClass,
    Seed,
)
from retwin.cli.plans import Workers, carry_out
from retwin.cli.reading import read, system_of, updated_twin
from retwin.cli.terminal import answer, bar, note, table
from retwin.data.io import check_target
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.twins.samplers import CommandSampler
    from retwin.update.residual import ResidualModel, SequenceResidual
    from retwin.update.surrogate import Surrogate

data_option, model_option = (
    partial(typer.Option, rich_help_panel=panel)
    for panel in ("Data", "Model; by default the case's")
)

ModelFolder = Annotated[
    Path, typer.Option(metavar="FOLDER", help="Where to save the corrected twin.")
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
        help="Surrogate: mlp, lstm, tcn or state_space.",
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


def fit(
    case: CaseArgument,
    out: ModelFolder,
    real: RealSet = None,
    data: OneFile = None,
    twin_data: TwinSet = None,
    simulations: Simulations = None,
    calibrate_on: CalibrateOn = "healthy",
    network: Network = None,
    correction: Correction = None,
    density: Density = None,
    refine: Refine = False,
    dynamics: StateEquations = False,
    seed: Seed = 0,
    mapping: LogMapping = None,
    max_bytes: MaxBytes = None,
    as_json: Json = False,
) -> None:
    """Fit surrogate and residual model; save the corrected twin."""
    import retwin as rt
    from retwin.update.residual.fitting import calibrating

    check_place(
        out, folder=True, holds=("model.json", "weights.safetensors", "surrogate", "residual")
    )
    system = _system(case, network, correction, density, refine)
    measured = _measured(system, real, data, max_bytes, mapping)
    # The path is absolute, since a model is also used from other folders.
    name = str(Path(case).resolve()) if Path(case).suffix.lower() == ".toml" else case
    if dynamics:
        fit_equations(system, measured, out, name, seed, as_json=as_json)
        return
    measured = _labelled(system, measured)
    faults = system.faults if calibrate_on == "all" else calibrate_on
    calibrating(measured, faults)  # before the surrogate is trained, which takes minutes
    size = system.per_class if simulations is None else simulations
    if twin_data is None:
        nominal = _simulated(system, size, seed, measured)
    else:
        nominal = read(twin_data, system, max_bytes=max_bytes)
    with bar("fit") as show:
        ibg = rt.fit_surrogate(
            nominal,
            system.network,
            seed=seed,
            training=system.training,
            progress=lambda s: show("surrogate, 1 of 2", s),
        )
        rg = rt.fit_residual(
            ibg,
            measured,
            system.correction,
            system.density,
            seed=seed,
            calibrate_on=faults,
            twin=system.twin,
            progress=lambda s: show("residual model, 2 of 2", s),
        )
    rt.CorrectedTwin(ibg, rg, case=name).save(out)
    _print_fit(ibg, rg, out, as_json=as_json)


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


def _simulated(system: Case, simulations: int, seed: int, measured: Trajectories) -> Trajectories:
    """Healthy simulations of the case's twin, which contain what the real commands contain.

    Where the sampler of the case does not draw such commands, half as many are added that are like
    the real ones, and as many parts of these.
    """
    import retwin as rt
    from retwin.twins.command_range import CommandRange
    from retwin.twins.samplers import RecordedSampler

    def drawn(sampler: CommandSampler, count: int) -> Trajectories:
        healthy = replace(system, faults={HEALTHY: None}, sampler=sampler)
        with bar("simulate") as show:
            return rt.generate(
                system.twin, healthy, per_class=count, seed=seed, progress=lambda s: show("", s)
            )

    made = drawn(system.sampler, simulations)
    real, rate, inputs = measured.commands, measured.rate, system.inputs
    if (measured.inputs, rate) != (inputs, system.rate):
        return made
    outside = CommandRange.of(made.commands, rate).outside(real, rate, inputs)
    if not outside:
        return made
    similar = rt.twins.sampler_from(real, rate, limits=getattr(system.twin, "limits", None))
    duration = min(similar.duration, real.shape[1] / rate)
    count = max(1, simulations // 2)
    added = [drawn(each, count) for each in (similar, RecordedSampler(real, rate, duration))]
    note(
        f"The sampler of the case does not draw the real commands: {outside}. {2 * count} "
        "simulations of commands like these were added"
    )
    steps = max(each.steps for each in (made, *added))
    return Trajectories.concatenate([each.padded(steps) for each in (made, *added)])


def _print_fit(
    ibg: Surrogate, rg: ResidualModel | SequenceResidual, out: Path, *, as_json: bool
) -> None:
    """Print the errors of both models, and where they were saved."""
    assert ibg.fitted is not None
    assert rg.fitted is not None
    figures, channels = ibg.fitted.figures, ibg.outputs
    outputs = [
        {"output": n, "unit": u, "rmse": figures[f"rmse_{n}"], "nrmse": figures[f"nrmse_{n}"]}
        for n, u in zip(channels.names, channels.units, strict=True)
    ]
    residual = {"emulated": rg.emulated, "reason": rg.fitted.reason, "figures": rg.fitted.figures}
    rows = [(o["output"], f"{o['rmse']:.3g} {o['unit']}", f"{o['nrmse']:.2%}") for o in outputs]
    answer(
        {"saved": str(out), "surrogate": outputs, "residual": residual},
        "Surrogate on held-out twin trajectories:",
        table(("output", "RMSE", "NRMSE"), rows, numbers=("RMSE", "NRMSE")),
        "",
        _residual_line(rg),
        as_json=as_json,
    )
    note(f"Saved {out}")


def _residual_line(rg: ResidualModel | SequenceResidual) -> str:
    """The training data of a residual model, and its errors on held-out parts."""
    from retwin.update.residual import ResidualModel

    assert rg.fitted is not None
    figures, reason = rg.fitted.figures, rg.fitted.reason
    emulated = "EMULATED " if rg.emulated else ""
    if isinstance(rg, ResidualModel):
        counted = f"{figures['movements']:.0f} segments of {figures['trajectories']:.0f} "
        shares = [
            f"{figures[f'coverage90_{name}']:.0%} of {name}"
            for name in rg.outputs.names
            if f"coverage90_{name}" in figures
        ]
        bands = f" Bands of 90 % hold {', '.join(shares)} in the calibration." if shares else ""
        return f"Residual model: {counted}{emulated}trajectories; {reason}.{bands}"
    latent = zip(rg.latent.names, rg.latent.units, strict=True)
    errors = ", ".join(f"{name} {figures[f'rmse_{name}']:.3g} {unit}" for name, unit in latent)
    return (
        f"Residual model: {figures['samples']:.0f} {emulated}samples; {reason}. "
        f"On held-out parts the RMSE of its mean is {errors}, and its 90 % band covers "
        f"{figures['coverage90']:.0%}."
    )


def generate(
    model: Model,
    out: Annotated[Path, typer.Option(metavar="FILE", help="New *.npz, or *.zarr of any size.")],
    per_class: PerClass = 400,
    case: OtherCase = None,
    seed: Seed = 0,
    workers: Workers = None,
) -> None:
    """Generate a balanced labelled set from a corrected twin.

    A *.npz holds one class after the other; a *.zarr holds the classes in turn, with other draws,
    and is resumed after an interruption.
    """
    import retwin as rt

    kind = check_target(out)
    updated = updated_twin(model)
    system = system_of(updated, model, case)
    if kind == ".zarr" or workers is not None:
        n = per_class * len(system.faults)
        plan = rt.deploy.SimulationPlan(updated, system.sampler, seed, n, system.faults)
        carry_out(plan, out, "generate", workers=workers)
        return
    with bar("generate") as show:
        made = rt.generate(
            updated, system, per_class=per_class, seed=seed, progress=lambda s: show("", s)
        )
    rt.save(made, out)
    note(f"Wrote {len(made)} trajectories to {out}")
