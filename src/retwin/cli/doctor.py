"""`retwin doctor`: is everything here that is needed?"""

from __future__ import annotations

from collections import Counter
from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING

import typer
from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table

from retwin.cli.options import Json
from retwin.cli.terminal import FAILED, answer, bar

if TYPE_CHECKING:
    from retwin.cli.environment import Check

__all__ = ["doctor"]

COLOURS = {"ok": "green", "warning": "yellow", "missing": "cyan", "broken": "bold red"}


def doctor(as_json: Json = False) -> None:
    """Look at installation, machine and data, and say what is missing."""
    from retwin.cli.environment import examine

    with bar("doctor") as tell:
        checks = examine(tell)
    broken = any(check.state == "broken" for check in checks)
    answer({"ok": not broken, "checks": checks}, _shown(checks), as_json=as_json)
    if broken:
        raise typer.Exit(FAILED)


def _shown(checks: list[Check]) -> RenderableType:
    parts: list[RenderableType] = []
    for group, members in groupby(checks, attrgetter("group")):
        grid = Table.grid(padding=(0, 2))
        grid.add_column(min_width=7)
        grid.add_column(min_width=12)
        grid.add_column(overflow="fold")
        for each in members:
            found = escape(each.found)
            if each.remedy:
                found += f"\n[dim]→[/] {escape(each.remedy)}"
            colour = COLOURS[each.state]
            grid.add_row(f"[{colour}]{each.state}[/]", escape(each.name), found)
        parts += [f"[bold]{group}[/]", grid, ""]
    return Group(*parts, _verdict(checks))


def _verdict(checks: list[Check]) -> str:
    counts = Counter(check.state for check in checks)
    if counts["broken"]:
        return f"[bold red]{counts['broken']} broken[/]: retwin cannot work like this."
    besides = [f"{counts[state]} {state}" for state in ("warning", "missing") if counts[state]]
    more = f" ({', '.join(besides)})" if besides else ""
    return f"[green]Everything that is needed is here[/]{more}."
