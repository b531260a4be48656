"""Output of all commands: results on stdout, everything else on stderr, exit codes.

Bars and notes go to stderr unless `--quiet` is given; warnings and errors always do.
"""

from __future__ import annotations

import json
import logging
import os
import shlex
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import typer
from rich import box
from rich.console import Console, JustifyMethod, RenderableType
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskProgressColumn, TextColumn
from rich.table import Table
from rich.text import Text

from retwin.checks import install_command
from retwin.errors import place_of
from retwin.progress import FinishedStage, ResumedStage

USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]
"""Click's UsageError, as a base class of Typer's, since newer Typers vendor their own Click."""

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
"""Exit codes."""

LOG_DELAY = 2.0
"""Seconds before the first line of progress in a log; shorter work leaves none."""
CONTROL = {
    code: f"\\u{code:04x}"
    for code in (*range(32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A))
    if chr(code) not in "\n\t"
}
"""Characters by which a name could steer a terminal or reverse a line, and what is printed."""

_quiet = False
_live: Console | None = None
"""The console of the bar that is on the screen; what else is printed must pass through it."""


def be_quiet(quiet: bool) -> None:
    """Leave out bars and notes from now on, or show them again."""
    global _quiet
    _quiet = quiet


def example(command: str) -> str:
    """The last line of a command's help: a command that works, in one line of 80 characters."""
    return f"Example: {command}"


def command_given() -> str:
    """The command line of this process, quoted for a shell."""
    return shlex.join(["retwin", *sys.argv[1:]])


def plain(text: object) -> Text:
    """Text as it is, without markup, in which control characters are made visible."""
    readable = str(text).encode(errors="backslashreplace").decode()
    return Text(readable.translate(CONTROL))


# Results.


def answer(result: object, *shown: RenderableType, as_json: bool = False) -> None:
    """Print a result on stdout.

    Parameters
    ----------
    result : object
        The result as plain values or dataclasses, printed as JSON with null for NaN.
    *shown : renderables
        The result for people, printed instead of JSON.
    as_json : bool
        Whether JSON is printed.

    """
    if as_json:
        from pydantic_core import to_jsonable_python

        # Not `to_json`, which refuses file names whose bytes are no text.
        values = to_jsonable_python(result, inf_nan_mode="null")
        text = json.dumps(values, indent=2, ensure_ascii=False)
        typer.echo(text.translate(CONTROL).encode(errors="backslashreplace").decode())
        return
    console = Console()
    for each in shown:
        if isinstance(each, str):
            console.print(plain(each), soft_wrap=True)
        else:
            console.print(each)


def table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], *, numbers: Sequence[str] = ()
) -> Table:
    """A table of plain texts, which are folded on a narrow screen and never cut off.

    Parameters
    ----------
    columns : sequence of str
        Titles of the columns.
    rows : iterable of sequence
        Cells of each row.
    numbers : sequence of str
        Titles of the columns that are aligned to the right.

    """
    made = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name in columns:
        justify: JustifyMethod = "right" if name in numbers else "left"
        made.add_column(plain(name), overflow="fold", justify=justify)
    for row in rows:
        made.add_row(*map(plain, row))
    return made


# Progress.


def note(text: str) -> None:
    """Print a line on stderr about what was done."""
    _stderr().print(plain(text), soft_wrap=True)


class _TimeLeft(ProgressColumn):
    """The time left at the mean speed since the work began, so that a standstill counts too."""

    def render(self, task: Task) -> Text:
        elapsed, before = task.elapsed or 0.0, task.fields["before"]
        done, left = task.completed - before, 1.0 - task.completed
        # Seconds before the first time left on a bar; the first steps are no sample of the others.
        if elapsed < 5.0 or done <= 0:
            return Text("-:--:-- left", style="progress.remaining")
        minutes, seconds = divmod(round(elapsed * left / done), 60)
        hours, minutes = divmod(minutes, 60)
        return Text(f"{hours}:{minutes:02d}:{seconds:02d} left", style="progress.remaining")


@contextmanager
def bar(what: str) -> Iterator[Callable[[str, float], None]]:
    """Show progress on stderr while the block runs.

    On a terminal it is a bar; elsewhere a line for every tenth of the work.

    Parameters
    ----------
    what : str
        Name of the work.

    Yields
    ------
    callable
        Function of the current step's name and the share that is done. A share smaller than the
        one before starts a new part of the work, with its own remaining time. A `FinishedStage`
        leaves a line with its name and the time since the work began; what a `ResumedStage` adds
        to the share does not count for the time left.

    """
    console = _stderr()
    if _quiet or not console.is_terminal:
        yield _lines(console, what)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        TaskProgressColumn(),
        _TimeLeft(),
    )
    with _shown(console), Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task(what, total=1.0, before=0.0)
        begun = time.monotonic()

        def show(text: str, share: float) -> None:
            if isinstance(text, FinishedStage):
                bars.console.print(_finished(text, time.monotonic() - begun))
                return
            done = bars.tasks[task].completed
            if share < done:
                bars.reset(task, total=1.0, before=0.0)
            if isinstance(text, ResumedStage):
                bars.update(task, before=bars.tasks[task].fields["before"] + share - done)
            described = plain(f"{what}: {text}" if text else what).plain
            bars.update(task, completed=share, description=described)

        yield show


@contextmanager
def _shown(console: Console) -> Iterator[None]:
    """The block has a bar on this console."""
    global _live
    before, _live = _live, console
    try:
        yield
    finally:
        _live = before


def _lines(console: Console, what: str) -> Callable[[str, float], None]:
    begun = since = time.monotonic()
    first, last, tenth = 0.0, 0.0, -1

    def show(text: str, share: float) -> None:
        nonlocal since, first, last, tenth
        if isinstance(text, FinishedStage):
            console.print(_finished(text, time.monotonic() - begun), soft_wrap=True)
            return
        now, before, tenth = time.monotonic(), tenth, int(10 * share)
        if before < 0 or tenth < before:
            since, first = now, share
        if isinstance(text, ResumedStage):
            first += share - last
        last = share
        if tenth == before or now - begun < LOG_DELAY:
            return
        left = (now - since) * (1 - share) / (share - first) if share > first else 0.0
        after = f", {left:.0f} s left" if left else ""
        console.print(plain(f"{what}: {text} {share:.0%}{after}"), soft_wrap=True)

    return show


def _finished(stage: str, seconds: float) -> Text:
    """The line that a finished stage leaves, with the time since the work began."""
    minutes, rest = divmod(round(seconds), 60)
    return Text.assemble(("✓", "green"), f" {minutes}:{rest:02d}  ", plain(stage))


def _stderr() -> Console:
    return Console(stderr=True, quiet=_quiet)


# Errors.


def complain(text: str) -> None:
    """Print an error in one line on stderr, never wrapped."""
    _mark("error", "red", " ".join(text.split()))


def _mark(kind: str, colour: str, text: str) -> None:
    line = Text.assemble((f"{kind}:", colour), " ", plain(text))
    (_live or Console(stderr=True)).print(line, soft_wrap=True)


def complain_of_usage(error: Any) -> None:
    """Print a usage error in one line, with the command whose help explains it."""
    text = error.format_message().rstrip(".")
    if getattr(error, "option_name", "") in ("--quiet", "-q"):
        text = "--quiet stands before the command: retwin --quiet …"
    if text:  # there is none when typer has printed the help
        where = f"; see `{error.ctx.command_path} --help`" if error.ctx is not None else ""
        complain(f"{text}{where}")


def complain_of_interruption(kept: str = "") -> None:
    """Print a line after Ctrl-C: what is `kept`, or that nothing is."""
    # Zarr's event loop would log what was interrupted when the process ends.
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    anew = "give the same command again to begin anew, nothing is left half-written"
    complain(f"interrupted; {kept or f'{anew}: {command_given()}'}")


def described(error: Exception) -> str:
    """Type and message of an exception, and the line of the user's code that raised it."""
    at = "; ".join(dict.fromkeys(getattr(error, "__notes__", ()))) or place_of(error)
    if isinstance(error, ModuleNotFoundError) and not at:
        at = f"install what retwin needs: {install_command()}"
    if not (at or isinstance(error, OSError | RuntimeError)):
        at = "RETWIN_TRACEBACK=1 in the environment shows where"
    return f"{type(error).__name__}: {error}" + (f" ({at})" if at else "")


class Interrupted(Exception):
    """Ctrl-C in work of which something is kept; the message says what."""


@contextmanager
def resumable() -> Iterator[None]:
    """Raise Interrupted for Ctrl-C in work that the same command resumes."""
    try:
        yield
    except KeyboardInterrupt:
        again = f"give the same command again to go on: {command_given()}"
        raise Interrupted(again) from None


@contextmanager
def interrupted_by_term() -> Iterator[None]:
    """Let SIGTERM act as Ctrl-C in the block, and repeat an interrupt that Python ignored.

    Python prints and forgets an exception that is raised while an object is deleted.
    """
    hook, main = sys.unraisablehook, threading.main_thread().ident

    def repeat(ignored: sys.UnraisableHookArgs) -> None:
        if os.name != "posix" or not issubclass(ignored.exc_type, KeyboardInterrupt):
            return hook(ignored)
        # Later, since an interrupt within this function would be ignored as well.
        later = threading.Timer(0.05, signal.pthread_kill, [main, signal.SIGTERM])
        later.daemon = True
        return later.start()

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.unraisablehook = repeat
    try:
        yield
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, before)


@contextmanager
def show_warnings() -> Iterator[None]:
    """Print each warning as one line on stderr, once and without its source line."""
    shown: set[str] = set()

    def show(message: Warning | str, *_: object, **__: object) -> None:
        # Python's own record of what was shown is lost with every `catch_warnings`.
        if str(message) not in shown:
            shown.add(str(message))
            _mark("warning", "yellow", str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = show
        yield
