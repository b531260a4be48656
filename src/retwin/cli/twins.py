"""`retwin twin`: which twins there are, what they are, and what they say."""

from __future__ import annotations

import json
import shlex
import sys
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from retwin import twins
from retwin.cli.animate import animate
from retwin.cli.terminal import FAILED, INTERRUPTED, bar, complain
from retwin.errors import InputError
from retwin.storage import check_target

if TYPE_CHECKING:
    from retwin.case import Case
    from retwin.twins.protocol import Twin

__all__ = ["app"]

app = typer.Typer(
    help="List, describe and simulate twins.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)

TwinName = Annotated[
    str, typer.Argument(metavar="TWIN", help="See `retwin twin list`; or a saved model's folder.")
]
Inputs = Annotated[str, typer.Option(help="Names of the inputs, joined by commas.")]
Outputs = Annotated[str, typer.Option(help="Names of the outputs, joined by commas.")]
Rate = Annotated[float | None, typer.Option(help="Samples per second.", min=1e-9)]

app.command(
    "animate",
    epilog="Example: `retwin twin animate real.mat --case armpi --id 00036 --out arm.mp4`",
)(animate)

OTHERS = {
    "FILE.fmu": "an FMU for co-simulation (FMI 2 or 3)",
    "FILE.xml, FILE.urdf": "a MuJoCo model",
    "case.toml": "the twin of a case of your own",
    "package.module:object": "a twin, or a function from commands to outputs",
    "FOLDER": "a corrected twin or a surrogate that was saved",
}


@app.command("list", epilog="Example: `retwin twin list`")
def list_twins() -> None:
    """Say which twins are built in, and what else can be named."""
    table = Table("TWIN", "is")
    for name, (_, _, title) in twins.BUILT_IN.items():
        table.add_row(name, title)
    table.add_section()
    for form, title in OTHERS.items():
        table.add_row(form, title)
    Console().print(table)


@app.command(epilog="Example: `retwin twin info armpi`")
def info(twin: TwinName, inputs: Inputs = "", outputs: Outputs = "", rate: Rate = None) -> None:
    """Say what a twin is: its inputs with their limits, its outputs, its rate."""
    found = _twin(twin, inputs, outputs, rate)
    limits = getattr(found, "limits", None)
    console = Console()
    console.print(_title(twin, found), markup=False, highlight=False, soft_wrap=True)
    table = Table("", "name", "unit", "least", "greatest")
    for i, (name, unit) in enumerate(zip(found.inputs.names, found.inputs.units, strict=True)):
        ends = ("", "") if limits is None else (f"{limits.low[i]:g}", f"{limits.high[i]:g}")
        table.add_row("input", escape(name), escape(unit), *ends)
    for name, unit in zip(found.outputs.names, found.outputs.units, strict=True):
        table.add_row("output", escape(name), escape(unit))
    console.print(table)
    console.print(f"{found.rate:g} samples per second")


@app.command(
    epilog="Example: `retwin twin simulate armpi --n 20000 --fault all --seed 1 --out made.zarr`. "
    "A module in the current folder can be named, too: `retwin twin simulate plant:twin …`"
)
def simulate(
    twin: TwinName,
    out: Annotated[Path, typer.Option(help="File *.npz, or folder *.zarr of any size.")],
    n: Annotated[
        int | None,
        typer.Option("--n", help="Trajectories; by default one per row of --commands, or class."),
    ] = None,
    case: Annotated[
        str | None,
        typer.Option(
            help="Case that draws commands and knows faults; a built-in twin has its own."
        ),
    ] = None,
    commands: Annotated[
        Path | None, typer.Option(help="Trajectories whose commands are taken in turn.")
    ] = None,
    fault: Annotated[
        str, typer.Option(help="A class of the case, all (dealt in turn) or none.")
    ] = "none",
    inputs: Inputs = "",
    outputs: Outputs = "",
    rate: Rate = None,
    seed: Annotated[int, typer.Option(help="Same seed, same result.", min=0)] = 0,
    clip: Annotated[bool, typer.Option("--clip", help="Clip commands to the limits.")] = False,
    workers: Annotated[
        int | None, typer.Option(help="Processes for *.zarr; by default one per core.", min=1)
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, in place of processes.")
    ] = None,
    chunk: Annotated[int, typer.Option(help="Trajectories done together.", min=1)] = 256,
) -> None:
    """Simulate trajectories to a file; interrupted on the way to *.zarr, it can go on."""
    from retwin.scale import SimulationPlan, simulate_to

    check_target(out)
    found = _twin(twin, inputs, outputs, rate)
    system = _case(case, twin, found)
    faults = _faults(system, fault)
    drawn = _sampler(system, found) if commands is None else _recorded(commands, system)
    if commands is None and n is None:
        n = len(faults)
    plan = SimulationPlan(found, drawn, seed, n, faults, clip=clip, chunk=chunk)
    try:
        with bar("simulate") as tell:
            done = simulate_to(
                out,
                plan,
                workers=workers,
                scheduler=scheduler,
                progress=lambda share: tell(f"{share * plan.count:.0f} of {plan.count}", share),
            )
    except KeyboardInterrupt:
        # Typer would end without a word.
        again = shlex.join(["retwin", *sys.argv[1:]])
        complain(f"interrupted; give the same command again to go on: {again}")
        raise typer.Exit(INTERRUPTED) from None
    Console().print(f"Wrote {done.count - len(done.failed)} trajectories to {out}", soft_wrap=True)
    if done.failed:
        named = "; ".join(f"trajectory {i}: {why}" for i, why in list(done.failed.items())[:5])
        more = "; …" if len(done.failed) > 5 else ""
        complain(f"{len(done.failed)} of {done.count} simulations failed: {named}{more}")
        raise typer.Exit(FAILED)


def _twin(name: str, inputs: str, outputs: str, rate: float | None) -> Twin:
    """The twin of that name, or the model that was saved in that folder."""
    if (Path(name) / "model.json").is_file() and not (inputs or outputs or rate):
        return _model(Path(name))
    if _is_case(name) and not (inputs or outputs or rate):
        from retwin import cases

        return cases.get(name).twin
    return twins.get(name, inputs=_names(inputs), outputs=_names(outputs), rate=rate)


def _is_case(name: str) -> bool:
    return Path(name).suffix.lower() == ".toml"


def _model(folder: Path) -> Twin:
    try:
        kind = json.loads((folder / "model.json").read_text("utf-8"))["kind"]
    except (OSError, ValueError, LookupError, TypeError):
        kind = "damaged"
    if kind == "surrogate":
        from retwin.surrogate import Surrogate

        return Surrogate.load(folder)
    from retwin.corrected import CorrectedTwin

    return CorrectedTwin.load(folder)  # and says so of any other kind


def _names(given: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in given.split(",") if name.strip())


def _title(name: str, found: Twin) -> str:
    if name in twins.BUILT_IN:
        return f"{name}: {twins.BUILT_IN[name][2]}"
    if _is_case(name):
        from retwin import cases

        return f"{name}: {cases.get(name).title}"
    told = (type(found).__doc__ or "").strip().partition("\n")[0]
    return f"{Path(name).name} ({type(found).__name__}): {told}"


def _case(given: str | None, name: str, found: Twin) -> Case | None:
    """The case that is named, that of the twin's name, or that a corrected twin was fitted for."""
    from retwin import cases

    own = getattr(found, "case", "")
    if _is_case(name):
        own = name
    elif name in twins.BUILT_IN:
        own = name.partition("-")[0]
    if not (given or own):
        return None
    system = cases.get(given or own)
    if (system.inputs, system.rate) != (found.inputs, found.rate):
        raise InputError(
            "--case",
            expected=f"a case with the twin's inputs, {', '.join(found.inputs.names)}, at "
            f"{found.rate:g} Hz",
            got=f"{system.name} with {', '.join(system.inputs.names)} at {system.rate:g} Hz",
            remedy="name the case that this twin belongs to",
        )
    return system


def _faults(system: Case | None, fault: str) -> dict[str, Any]:
    from retwin.twins.protocol import HEALTHY

    if fault == "none":
        return {HEALTHY: None}
    known = {} if system is None else dict(system.faults)
    if known and fault == "all":
        return known
    if fault in known:
        return {fault: known[fault]}
    raise InputError(
        "--fault",
        expected=", ".join(["none", *(["all", *known] if known else [])]),
        got=fault,
        remedy="check the spelling" if known else "give --case, which knows what can go wrong",
    )


def _sampler(system: Case | None, found: Twin) -> Any:
    if system is not None:
        return system.sampler
    from retwin.commands import RampSampler

    limits = getattr(found, "limits", None)
    if limits is None or not all(map(isfinite, limits.low + limits.high)):
        raise InputError(
            "--commands",
            expected="commands, since not all inputs have limits within which to draw them",
            got="none",
            remedy="give --commands FILE, or --case NAME",
        )
    return RampSampler(limits.low, limits.high)


def _recorded(file: Path, system: Case | None) -> Any:
    from retwin.storage import load

    with bar("read") as tell:
        return load(file, case=system, progress=lambda share: tell(file.name, share))
