"""Arguments and options that several commands share, and how a shell completes them."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from math import inf
from pathlib import Path
from typing import Annotated, Any

import typer

from retwin import catalog
from retwin.catalog import CASES
from retwin.checks import require, whole

Complete = Callable[[str], list[str]]


def one_of(names: Iterable[str]) -> Complete:
    """A function that completes to one of these names."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return complete


def complete_sources(incomplete: str) -> list[str]:
    """Complete the last of several names joined by commas; none is offered twice."""
    *chosen, last = incomplete.split(",")
    before = "".join(f"{name}," for name in chosen)
    remaining = [
        name for name in (*catalog.SOURCES, *(() if chosen else ("all",))) if name not in chosen
    ]
    return [before + name for name in remaining if name.startswith(last)]


def complete_twins(incomplete: str) -> list[tuple[str, str]]:
    """Complete to a built-in twin, with its title."""
    titles = ((name, entry.title) for name, entry in catalog.TWINS.items())
    return [(name, title) for name, title in titles if name.startswith(incomplete)]


def complete_faults(ctx: typer.Context, incomplete: str) -> list[str]:
    """Complete to a class of the case, or of the twin's own case, that the command names."""
    # While an option lacks its value, click leaves the arguments in `args`.
    named = ctx.params.get("case") or ctx.params.get("twin") or next(iter(ctx.args), "")
    return one_of(("none", "all", *_faults(named)))(incomplete)


def _faults(named: str) -> Sequence[str]:
    if not named.endswith(".toml"):
        entry = catalog.CASES.get(named.partition("-")[0])
        return catalog.resolve(entry.recorded).classes if entry else ()
    try:
        faults = tomllib.loads(Path(named).read_text("utf-8")).get("faults", {})
    except (OSError, ValueError):
        return ()  # the command itself reports what is wrong with the file
    return ("Healthy", *faults)


def option(
    metavar: str, text: str, *flags: str, names: Iterable[str] | None = None, **more: Any
) -> Any:
    """An option of a command.

    Parameters
    ----------
    metavar : str
        The name of its value in the help; "" for a flag.
    text : str
        What it does.
    *flags : str
        Its names; by default that of the parameter.
    names : iterable of str, optional
        Values to which a shell completes.
    **more : object
        Further parameters of `typer.Option`.

    """
    if names is not None:
        more["autocompletion"] = one_of(names)
    return typer.Option(*flags, metavar=metavar or None, help=text, **more)


RARE = "Rarely needed"
"""The panel of help with the options that few users need."""
rare = partial(option, rich_help_panel=RARE)
"""An option in that panel; see `option`."""


def argument(metavar: str, text: str, *, names: Iterable[str] | None = None, **more: Any) -> Any:
    """An argument of a command; see `option`."""
    if names is not None:
        more["autocompletion"] = one_of(names)
    return typer.Argument(metavar=metavar, help=text, **more)


CASE = "Built-in case, case.toml, or module:object."
case_option = partial(typer.Option, "--case", metavar="CASE", autocompletion=one_of(CASES))

CaseArgument = Annotated[str, argument("CASE", CASE, names=CASES)]
CaseOption = Annotated[str | None, case_option(help=CASE)]
OtherCase = Annotated[
    str | None, case_option(help="If another than it was fitted for.", rich_help_panel=RARE)
]
Model = Annotated[Path, argument("MODEL", "Folder of a corrected twin.")]
Rate = Annotated[float | None, option("HZ", "Samples per second, if the file has none.", "--rate")]
LogMapping = Annotated[Path | None, option("FILE", "What `retwin data map` wrote.", "--mapping")]
Inputs = Annotated[str, option("NAMES", "Of a function's inputs, joined by commas.", "--inputs")]
Outputs = Annotated[str, option("NAMES", "Of its outputs, joined by commas.", "--outputs")]
MaxBytes = Annotated[int | None, rare("N", "Limit of a file; else what is free.", min=1)]
MAX_SEED = 2**63 - 1
"""The largest seed that every generator of random numbers takes."""
Seed = Annotated[
    int,
    option(
        "N",
        "Same seed, same result.",
        "--seed",
        min=0,
        callback=lambda seed: whole("--seed", seed, at_most=MAX_SEED),
    ),
]
Json = Annotated[bool, option("", "Print JSON instead, and nothing else.", "--json")]

Horizon = Annotated[
    str, option("TIME", "Judge by predictions so far ahead: 1s, free.", "--horizon")
]

WarmUp = Annotated[
    str, option("TIME", "Begin of each record that gives its start, not scored: 5s.", "--warm-up")
]


def leave_out(options: Mapping[str, object], when: str) -> None:
    """Refuse options that have no meaning `when`; None and False are those that were not given."""
    for name, value in options.items():
        absent = value is None or value is False
        require(absent, name, expected=f"none {when}", got=value, remedy="leave it out")


SECONDS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""By unit of a time."""


def seconds_of(option: str, text: str) -> float | None:
    """The time in s of a text such as `0.5`, `1s`, `15min` or `2h`; None for `free`.

    Raises InputError for another text.
    """
    if text == "free":
        return None
    found = re.fullmatch(r"\s*((?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([a-z]*)\s*", text)
    value = float(found[1]) * SECONDS.get(found[2], 0.0) if found else 0.0
    expected = "free, or a time above 0 such as 90s, 15min, 2h or 1d"
    remedy = "a number alone is in seconds"
    require(0 < value < inf, option, expected=expected, got=text, remedy=remedy)
    return value


def channel_names(text: str) -> tuple[str, ...]:
    """The names in the value of `--inputs` or `--outputs`."""
    return tuple(each.strip() for each in text.split(",") if each.strip())
