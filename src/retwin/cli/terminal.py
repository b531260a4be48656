"""What every command shares: the answer on stdout, everything else on stderr, exit codes.

On stderr go bars and notes, which `--quiet` leaves out, and warnings and errors, which it does not.
"""

from __future__ import annotations

import logging
import shlex
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import typer
from rich import box
from rich.console import Console, JustifyMethod, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from retwin.errors import place_of

__all__ = [
    "BAD_INPUT",
    "FAILED",
    "INTERRUPTED",
    "USAGE_ERROR",
    "Interrupted",
    "answer",
    "bar",
    "be_quiet",
    "command_given",
    "complain",
    "complain_of_interruption",
    "complain_of_usage",
    "described",
    "example",
    "interrupted_by_term",
    "note",
    "resumable",
    "show_warnings",
    "table",
]

USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]
"""Click's UsageError, by a way that leads to it in any Typer: newer ones bring a Click along."""

FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130

MOMENT = 2.0
"""Seconds that a command may take before a log is told how far it is."""
HOUR = 3600.0
"""Over which the time left is reckoned: jobs of a study differ much, their mean does not."""

_quiet = False


def be_quiet(quiet: bool) -> None:
    """Leave out bars and notes from now on, or show them again."""
    global _quiet
    _quiet = quiet


def example(command: str) -> str:
    """The last line of a command's help: a command that works.

    Of 69 characters at most: then it fits into one line of 80, and can be copied.
    """
    return f"Example: {command}"


def command_given() -> str:
    """The command as it was given, to be given again."""
    return shlex.join(["retwin", *sys.argv[1:]])


# The answer.


def answer(told: object, *shown: RenderableType, as_json: bool = False) -> None:
    """The result on stdout: `told` as JSON and nothing else, or what is `shown` to people.

    JSON has no NaN: figures that are not defined are null.
    """
    if as_json:
        from pydantic_core import to_json

        typer.echo(to_json(told, indent=2, inf_nan_mode="null").decode())
        return
    console = Console()
    for each in shown:
        if isinstance(each, str):
            console.print(each, markup=False, highlight=False, soft_wrap=True)
        else:
            console.print(each)


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    numbers: Sequence[str] = (),
) -> Table:
    """A table of plain texts, of which nothing is cut off however narrow the screen.

    `numbers` names the columns that stand to the right.
    """
    made = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    # What comes from files is no markup: a class named [red] must not colour the table.
    for name in columns:
        justify: JustifyMethod = "right" if name in numbers else "left"
        made.add_column(escape(name), overflow="fold", justify=justify)
    for row in rows:
        made.add_row(*(escape(str(cell)) for cell in row))
    return made


# How far it is.


def note(text: str) -> None:
    """A line on stderr about what was done."""
    _stderr().print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def bar(what: str) -> Iterator[Callable[[str, float], None]]:
    """A bar on stderr, told what is going on and the share done; gone when the work is done.

    A share that is less than the one before begins a new part of the work, with a time left of its
    own. Without a terminal a line is printed at every tenth, so that the log of a long work shows
    life.
    """
    console = _stderr()
    if not console.is_terminal:
        yield _lines(console, what)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Progress(
        *columns, console=console, transient=True, speed_estimate_period=HOUR, disable=_quiet
    ) as bars:
        task = bars.add_task(what, total=1.0)

        def tell(text: str, share: float) -> None:
            if share < bars.tasks[task].completed:
                bars.reset(task, total=1.0)
            bars.update(task, completed=share, description=f"{what}: {text}" if text else what)

        yield tell


def _lines(console: Console, what: str) -> Callable[[str, float], None]:
    begun = since = time.monotonic()
    first, tenth = 0.0, -1

    def tell(text: str, share: float) -> None:
        nonlocal since, first, tenth
        now, before, tenth = time.monotonic(), tenth, int(10 * share)
        if before < 0 or tenth < before:
            since, first = now, share
        if tenth == before or now - begun < MOMENT:
            return
        left = (now - since) * (1 - share) / (share - first) if share > first else 0.0
        after = f", {left:.0f} s left" if left else ""
        line = f"{what}: {text} {share:.0%}{after}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    return tell


def _stderr() -> Console:
    return Console(stderr=True, quiet=_quiet)


# What went wrong.


def complain(text: str) -> None:
    """One line on stderr, never wrapped."""
    line = escape(" ".join(text.split()))
    Console(stderr=True, soft_wrap=True).print(f"[red]error:[/] {line}", highlight=False)


def complain_of_usage(error: Any) -> None:
    """One line on words that are no command, and where to read on."""
    told = error.format_message().rstrip(".")
    if getattr(error, "option_name", "") in ("--quiet", "-q"):
        told = "--quiet stands before the command: retwin --quiet …"
    if told:  # without any words the help was shown, and that is all
        where = f"; see `{error.ctx.command_path} --help`" if error.ctx is not None else ""
        complain(f"{told}{where}")


def complain_of_interruption(*, kept: bool) -> None:
    """One line on Ctrl-C; `kept`: the same command goes on where this one stopped."""
    # Zarr's event loop would tell at length, as the process ends, what it was cut off in.
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    how = "to go on" if kept else "to begin anew, nothing is left half-written"
    complain(f"interrupted; give the same command again {how}: {command_given()}")


def described(error: Exception) -> str:
    """Kind and message of an exception, and where in the user's own code it comes from."""
    at = "; ".join(getattr(error, "__notes__", ())) or place_of(error)
    if not (at or isinstance(error, OSError | RuntimeError)):
        at = "RETWIN_TRACEBACK=1 in the environment shows where"
    return f"{type(error).__name__}: {error}" + (f" ({at})" if at else "")


class Interrupted(Exception):
    """Ctrl-C in a work of which the same command makes the rest."""


@contextmanager
def resumable() -> Iterator[None]:
    """For work that leaves what is finished, and goes on when it is called again."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted from None


@contextmanager
def interrupted_by_term() -> Iterator[None]:
    """SIGTERM does what Ctrl-C does."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def show_warnings() -> Iterator[None]:
    """Our warnings as one line on stderr each, without the source line Python would add."""
    console = Console(stderr=True, soft_wrap=True)

    def show(message: Warning | str, *_: object, **__: object) -> None:
        console.print(f"[yellow]warning:[/] {escape(str(message))}", highlight=False)

    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = show
        yield
