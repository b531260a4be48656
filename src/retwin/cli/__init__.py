"""The command line: parses arguments, calls the public interface, prints results.

Belongs here: commands, options, completion, messages on a terminal, and `doctor`. Not here:
anything that computes a result.

Exit codes: 0 done; 1 failed; 2 bad input, with one line that states what was expected, what came
and the remedy; 130 interrupted. With RETWIN_TRACEBACK=1 in the environment, the traceback of an
unexpected exception is shown in full.
"""

from __future__ import annotations

import os
import sys
from errno import ENAMETOOLONG
from functools import lru_cache
from typing import Annotated, Any

import typer

from retwin._version import __version__
from retwin.cli import (
    bundle,
    data,
    diagnose,
    doctor,
    export,
    fit,
    identify,
    models,
    monitor,
    proposals,
    studies,
    twins,
)
from retwin.cli.commands import Commands, Group
from retwin.cli.options import option
from retwin.cli.terminal import (
    BAD_INPUT,
    FAILED,
    INTERRUPTED,
    USAGE_ERROR,
    Interrupted,
    be_quiet,
    complain,
    complain_of_interruption,
    complain_of_usage,
    described,
    example,
    interrupted_by_term,
    show_warnings,
)
from retwin.errors import InputError, place_of

__all__ = ["app", "command_tree", "main"]

UNSHOWN = ("version", "quiet", "help", "install_completion", "show_completion")
"""Options for which the first screen has no line."""


class FirstScreen(Group):
    """All commands; its help fits into 24 lines of 80."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The options; --quiet and those that Typer adds are in the documentation."""
        params: list[Any] = [*super().get_params(ctx)]
        for each in params:
            each.hidden = each.name in UNSHOWN
        return params


app = Commands(
    help="Update digital twins so that they behave like the real machine.",
    cls=FirstScreen,
    pretty_exceptions_enable=False,
)
for function, shown in (
    (studies.demo, "demo"),
    (doctor.doctor, "doctor"),
    (identify.identify, "identify plant.fmu log.csv --free gain=0.1:10 --out identified"),
    (fit.fit, "fit armpi --twin-data sim.mat --real real.mat --out model"),
    (models.evaluate, "evaluate model --real other.csv"),
    (models.generate, "generate model --per-class 400 --out made.npz"),
    (proposals.propose, "next armpi model --real real.mat --out next.npz"),
    (studies.study, "study armpi --twin-data sim.mat --real real.mat --out study"),
    (studies.report, "report study"),
):
    app.command(shown.split()[0], epilog=example(f"retwin {shown}"))(function)
app.add_typer(data.app, name="data")
app.add_typer(twins.app, name="twin")
app.add_typer(diagnose.app, name="diagnose")
app.add_typer(bundle.app, name="bundle")
app.add_typer(export.app, name="export")
app.add_typer(monitor.app, name="monitor")


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, option("", "Print the version and exit.", "--version")] = False,
    quiet: Annotated[
        bool,
        option(
            "",
            "No progress, no notes: only results.",
            "--quiet",
            "-q",
            envvar="RETWIN_QUIET",
            show_envvar=False,
        ),
    ] = False,
) -> None:
    """Update digital twins so that they behave like the real machine."""
    be_quiet(quiet)
    if version:
        typer.echo(f"retwin {__version__}")
        raise typer.Exit


@lru_cache(maxsize=1)
def command_tree() -> Any:
    """The tree of all commands with their options, made once per process."""
    return typer.main.get_command(app)


def main() -> None:
    """Run the command line and exit with its code.

    SIGTERM acts as Ctrl-C, so that temporary files are removed.
    """
    with show_warnings(), interrupted_by_term():
        sys.exit(_run())


def _run() -> int:
    """Run the command; print an error as one line, and return the exit code."""
    try:
        # Typer ends Ctrl-C with this code and no message; older versions raise Abort.
        code: int = command_tree()(prog_name="retwin", standalone_mode=False) or 0
        if code != INTERRUPTED:
            return code
        complain_of_interruption()
    except Interrupted as error:
        complain_of_interruption(str(error))
    except (KeyboardInterrupt, typer.Abort):
        complain_of_interruption()
    except InputError as error:
        complain(str(error))
        return BAD_INPUT
    except USAGE_ERROR as error:
        complain_of_usage(error)
        return BAD_INPUT
    except SystemExit as error:
        at = place_of(error)
        if not at:  # as the completion of words ends
            raise
        complain(f"{at}: this line ended the program (SystemExit: {error.code})")
        return FAILED
    except Exception as error:
        if os.environ.get("RETWIN_TRACEBACK"):
            raise
        complain(described(error))
        return BAD_INPUT if getattr(error, "errno", None) == ENAMETOOLONG else FAILED
    return INTERRUPTED
