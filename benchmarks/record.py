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


def record(name: str, title: str, rows: dict[str, float]) -> None:
    """Print `rows` and write them, with the machine, to benchmarks/out/`name`.json."""
    table = Table("what", "value", title=title)
    for what, value in rows.items():
        table.add_row(what, f"{value:.3g}")
    Console().print(table)
    OUT.mkdir(exist_ok=True)
    machine = {"platform": platform.platform(), "cores": os.cpu_count()}
    text = json.dumps({"title": title, "rows": rows, "machine": machine}, indent=1)
    (OUT / f"{name}.json").write_text(text + "\n", encoding="utf-8")
