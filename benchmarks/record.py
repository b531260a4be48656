"""Print a benchmark's table and keep it as JSON."""

from __future__ import annotations

import json
import os
import platform
import resource
from pathlib import Path

from rich.console import Console
from rich.table import Table

OUT = Path(__file__).parent / "out"


def peak_memory_gb() -> float:
    """The highest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2


def record(name: str, title: str, rows: dict[str, float] | dict[str, dict[str, float]]) -> None:
    """Print `rows`, of one value or of a value per column, and keep them with the machine.

    Written to benchmarks/out/`name`.json.
    """
    several = {what: row if isinstance(row, dict) else {"value": row} for what, row in rows.items()}
    table = Table("what", *next(iter(several.values())), title=title)
    for what, row in several.items():
        table.add_row(what, *(f"{value:.3g}" for value in row.values()))
    Console().print(table)
    OUT.mkdir(exist_ok=True)
    machine = {"platform": platform.platform(), "cores": os.cpu_count()}
    text = json.dumps({"title": title, "rows": rows, "machine": machine}, indent=1)
    (OUT / f"{name}.json").write_text(text + "\n", encoding="utf-8")
