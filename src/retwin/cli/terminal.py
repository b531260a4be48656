"""What every command shares: progress bars, warnings and errors on stderr, exit codes."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from retwin.errors import place_of

__all__ = [
    "BAD_INPUT",
    "FAILED",
    "INTERRUPTED",
    "USAGE_ERROR",
    "bar",
    "complain",
    "complain_of_usage",
    "described",
    "interrupted_by_term",
    "show_warnings",
]

USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]
"""Click's UsageError, by a way that leads to it in any Typer: newer ones bring a Click along."""

FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130


@contextmanager
def bar(what: str) -> Iterator[Callable[[str, float], None]]:
    """A bar on stderr, told what is going on and the share done; gone when the work is done.

    Without a terminal a line is printed at every tenth, so that a log shows life.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(console, what)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task(what, total=1.0)

        def tell(text: str, share: float) -> None:
            bars.update(task, completed=share, description=f"{what}: {text}" if text else what)

        yield tell


def _lines(console: Console, what: str) -> Callable[[str, float], None]:
    shown = {"text": "", "tenth": -1}

    def tell(text: str, share: float) -> None:
        tenth = int(10 * share)
        if tenth != shown["tenth"]:
            shown["tenth"] = tenth
            console.print(f"{what}: {escape(text)} {share:.0%}", highlight=False)

    return tell


def complain(text: str) -> None:
    """One line on stderr, never wrapped."""
    line = escape(" ".join(text.split()))
    Console(stderr=True, soft_wrap=True).print(f"[red]error:[/] {line}", highlight=False)


def complain_of_usage(error: Any) -> None:
    """One line on words that are no command, and where to read on."""
    told = error.format_message().rstrip(".")
    if told:  # without any words the help was shown, and that is all
        where = f"; see `{error.ctx.command_path} --help`" if error.ctx is not None else ""
        complain(f"{told}{where}")


def described(error: Exception) -> str:
    """Kind and message of an exception, and where in the user's own code it comes from."""
    at = "; ".join(getattr(error, "__notes__", ())) or place_of(error)
    if not (at or isinstance(error, OSError | RuntimeError)):
        at = "RETWIN_TRACEBACK=1 in the environment shows where"
    return f"{type(error).__name__}: {error}" + (f" ({at})" if at else "")


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
