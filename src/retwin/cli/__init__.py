"""The command line: parse, call the public API, print; no logic.

Exit codes: 0 done, 1 failed, 2 bad input with one line that says what was expected, what came, and
what to do, 130 interrupted. With RETWIN_TRACEBACK=1 in the environment, an exception that nobody
expected is shown in full.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from retwin import __version__
from retwin.cli import bundle, data, models, studies, twins
from retwin.cli.terminal import (
    BAD_INPUT,
    FAILED,
    INTERRUPTED,
    USAGE_ERROR,
    complain,
    complain_of_usage,
    described,
    interrupted_by_term,
    show_warnings,
)
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
app.add_typer(bundle.app, name="bundle")
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
    """Run the command line and exit with its code.

    SIGTERM is taken as Ctrl-C, so that nothing is left lying about. Modules in the current folder
    can be imported, after all that is installed: a file there must not stand in for a package.
    """
    if "" not in sys.path:
        sys.path.append("")
    with show_warnings(), interrupted_by_term():
        sys.exit(_run())


def _run() -> int:
    """The exit code; what went wrong is told in one line."""
    try:
        return app(standalone_mode=False) or 0
    except InputError as error:
        complain(str(error))
        return BAD_INPUT
    except USAGE_ERROR as error:
        complain_of_usage(error)
        return BAD_INPUT
    except typer.Abort:
        return INTERRUPTED
    except Exception as error:
        if os.environ.get("RETWIN_TRACEBACK"):
            raise
        complain(described(error))
        return FAILED
