"""The command line: parse, call the public API, print; no logic.

Exit codes: 0 done, 1 failed, 2 bad input with one line that says what was expected, what came, and
what to do.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from retwin import __version__
from retwin.cli import data, models, studies, twins
from retwin.cli.terminal import BAD_INPUT, FAILED, complain, show_warnings
from retwin.errors import InputError

__all__ = ["app", "main"]

app = typer.Typer(
    help="Update digital twins so that they behave like the real machine.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
app.command("demo", epilog="Example: `retwin demo`")(studies.demo)
app.add_typer(data.app, name="data")
app.add_typer(twins.app, name="twin")
app.command(
    "fit",
    epilog="Example: `retwin fit armpi --twin-data sim.mat --real real.mat --out model`",
)(models.fit)
app.command("generate", epilog="Example: `retwin generate model --per-class 400 --out made.npz`")(
    models.generate
)
app.add_typer(models.diagnose, name="diagnose")
app.command(
    "study",
    epilog="Example: `retwin study armpi --twin-data sim.mat --real real.mat --out study`",
)(studies.study)
app.command("report", epilog="Example: `retwin report study`")(studies.report)


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Update digital twins so that they behave like the real machine."""
    if version:
        typer.echo(f"retwin {__version__}")
        raise typer.Exit


def main() -> None:
    """Run the command line and exit with its code."""
    with show_warnings():
        try:
            app()
        except InputError as error:
            complain(str(error))
            sys.exit(BAD_INPUT)
        except (OSError, RuntimeError) as error:
            complain(f"{type(error).__name__}: {error}")
            sys.exit(FAILED)
