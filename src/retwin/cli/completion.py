"""Shell completion of names from the catalog and of the classes of a case."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import typer

from retwin import catalog

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
