"""Print the table of a benchmark, and store its last figures with the machine in results.json.

RETWIN_RESULTS may name another file.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import statistics
import time
import timeit
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.table import Table

from retwin._version import __version__
from retwin.serialisation.files import write_atomically

Result = TypeVar("Result")
RESULTS = Path(os.environ.get("RETWIN_RESULTS", Path(__file__).parent / "results.json"))


def peak_memory_gb() -> float:
    """The highest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2


def machine() -> dict[str, Any]:
    """The machine, versions and the date, for what is measured."""
    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "retwin": __version__,
        "processor": (*names, platform.processor())[0],
        "cores": os.cpu_count(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "torch": version("torch"),
    }


def memory_bandwidth() -> float:
    """Bytes per second that one core writes to memory, the best of five copies of 256 MB."""
    source, target = np.ones(2**25), np.zeros(2**25)
    return target.nbytes / min(timed(lambda: np.copyto(target, source))[0] for _ in range(5))


def timed(
    make: Callable[[], Result], clock: Callable[[], float] = time.perf_counter
) -> tuple[float, Result]:
    """Time of `make` in s, by the wall clock unless another is given, and its result."""
    started = clock()
    result = make()
    return clock() - started, result


def median_seconds(make: Callable[[], object], repeats: int = 3) -> float:
    """Median time of `make` in s, by the wall clock."""
    return statistics.median(timeit.repeat(make, repeat=repeats, number=1))


def record(name: str, title: str, rows: dict[str, float] | dict[str, dict[str, float]]) -> None:
    """Print `rows`, of one value or of a value per column, and store them with four digits.

    They replace the earlier figures of the benchmark `name`.
    """
    several = {what: row if isinstance(row, dict) else {"value": row} for what, row in rows.items()}
    table = Table("", *next(iter(several.values())), title=title)
    for what, row in several.items():
        table.add_row(what, *(f"{value:.3g}" for value in row.values()))
    Console().print(table)
    store(name, {"title": title, "machine": machine(), "rows": rounded(rows)})


def store(name: str, result: dict[str, Any]) -> None:
    """Replace the figures of one benchmark, and keep those of the others."""
    every = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
    every = dict(sorted({**every, name: result}.items()))
    with write_atomically(RESULTS) as part:
        part.write_text(json.dumps(every, indent=1) + "\n", encoding="utf-8")


def rounded(value: Any) -> Any:
    """Numbers with four digits, None for those that are not finite, which JSON does not have."""
    if isinstance(value, dict):
        return {name: rounded(each) for name, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    if not isinstance(value, float):
        return value
    return float(f"{value:.4g}") if isfinite(value) else None
