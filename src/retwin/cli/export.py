"""`retwin export`: updated twins for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from retwin.cli.options import Json
from retwin.cli.reading import updated_twin
from retwin.cli.terminal import answer, bar, example, note
from retwin.serialisation.places import check_place

__all__ = ["app"]

app = typer.Typer(
    help="Take an updated twin to other tools.",
    epilog=example("retwin export fmu model --out twin.fmu"),
    no_args_is_help=True,
)


@app.callback()
def _export() -> None:
    """Without it, the only command would be the group itself."""


@app.command(epilog=example("retwin export fmu model --out twin.fmu --version 3.0"))
def fmu(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Folder of an updated twin, of retwin fit.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The FMU to write, *.fmu.")],
    version: Annotated[
        Literal["2.0", "3.0"], typer.Option(metavar="FMI", help="Version of FMI: 2.0 or 3.0.")
    ] = "2.0",
    source_only: Annotated[
        bool,
        typer.Option("--source-only", metavar="", help="Write no binary for this machine."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Write an updated twin as an FMU with C source code inside."""
    from retwin.deploy.fmu.export import export_fmu

    check_place(out)
    twin = updated_twin(model)
    with bar("export") as show:
        show("compile", 0.0)
        made = export_fmu(twin, out, version=version, compiled=not source_only)
    delayed = (
        f"Its outputs are {made.delay:g} s behind, since the command at the end of a step is not "
        "known when the step begins."
    )
    answer(
        {"saved": str(out), "variables": list(made.variables), "delay": made.delay},
        *([delayed] if made.delay else []),
        as_json=as_json,
    )
    note(f"Saved {out}")
