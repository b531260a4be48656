"""Every method on every system: free simulation of test records, in one table.

    python benchmarks/systems.py [NAME ...] [--data FOLDER] [--out FOLDER] [--show] [--markdown]

NAME is a key of `systems.SYSTEMS`; by default all. Each method sees the calibration records alone
and goes through the public interface with its defaults. Results are one JSON file per system and
method in the folder OUT; those that are there are not made again; the whole table goes to
benchmarks/results/systems.json. A job that needs more processor time than
`LIMIT` ends.
`--markdown` prints the tables of docs/results.md.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from systems import SYSTEMS
from systems.methods import JOBS, METHODS, score

from retwin.cli.benchmark import machine
from retwin.processes import worker_pool
from retwin.serialisation.files import write_atomically

HERE = Path(__file__).parent
LIMIT = 180.0
"""Longest processor time of a job in s; what it has not fitted until then has no score."""
SHARED = {"arx", "narx", "neural_ss", "lstm"}
"""Jobs and models without a twin, which are fitted once for systems with the same records."""
Rows = dict[str, dict[str, Any]]
"""By row of the table and method, with scores."""


def work(name: str, job: str, data: Path, out: Path) -> None:
    """Fit and score what one job makes of one system, a file for each model."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, LIMIT)
    system = SYSTEMS[name](data)
    spent, began = 0.0, time.process_time()
    for method, model, note in JOBS[job](system):
        spent += time.process_time() - began
        scores = [
            score(model, records, system.warm_up, system.scale) for records in system.tests.values()
        ]
        write(out / name / f"{method}.json", {"scores": scores, "seconds": spent, "note": note})
        began = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, 0)


def late(*_: Any) -> None:
    raise TimeoutError(f"not within {LIMIT:g} s")


def write(file: Path, result: Mapping[str, Any]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(file) as part:
        part.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def run(names: list[str], data: Path, out: Path, processes: int) -> None:
    """Do the jobs that are not done."""
    with worker_pool(processes) as pool:
        futures: dict[tuple[str, str], Future] = {}
        for name in names:
            system = SYSTEMS[name](data)
            for job in JOBS:
                own = system.data if job in SHARED and system.data else name
                if not (out / own / f"done {job}.json").exists():
                    args = (own, job, data, out)
                    futures.setdefault((own, job), pool.schedule(work, args))
        for (name, job), future in futures.items():
            try:
                future.result()
                reason = ""
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
            write(out / name / f"done {job}.json", {"reason": reason})
            Console().print(f"{name}, {job}: {reason or 'done'}", highlight=False)


def gathered(names: list[str], data: Path, out: Path) -> Rows:
    """The scores that there are. Folds of a row are averaged, squares of its RMSE."""
    parts: dict[str, dict[str, list[dict[str, Any]]]] = {}
    about: Rows = {}
    missing: dict[str, dict[str, str]] = {}
    for name in names:
        system = SYSTEMS[name](data)
        for index, row in enumerate(system.tests):
            about[row] = {"unit": system.unit, "published": system.published}
            for job in JOBS:
                own = system.data if job in SHARED and system.data else name
                file = out / own / f"done {job}.json"
                reason = json.loads(file.read_text("utf-8"))["reason"] if file.exists() else ""
                if reason:
                    missing.setdefault(row, {})[job] = reason
            for method in METHODS:
                own = system.data if method in SHARED and system.data else name
                file = out / own / f"{method}.json"
                if file.exists():
                    found = json.loads(file.read_text("utf-8"))
                    entry = found.pop("scores")[index] | found
                    parts.setdefault(row, {}).setdefault(method, []).append(entry)
    return {
        row: about[row]
        | {"methods": {method: pooled(each) for method, each in methods.items()}}
        | {"missing": missing.get(row, {})}
        for row, methods in parts.items()
    }


def pooled(entries: list[dict[str, Any]]) -> dict[str, Any]:
    mean = {key: float(np.mean([each[key] for each in entries])) for key in ("crps", "coverage")}
    return {
        "rmse": float(np.sqrt(np.mean([each["rmse"] ** 2 for each in entries]))),
        **mean,
        "width": float(np.mean([each["width"] for each in entries])),
        "seconds": sum(each["seconds"] for each in entries),
        "note": "; ".join(dict.fromkeys(each["note"] for each in entries)),
    }


def rmse(scores: Mapping[str, Any]) -> str:
    return f"{scores['rmse']:.3g}"


def crps(scores: Mapping[str, Any]) -> str:
    return f"{scores['crps']:.3g}"


def bands(scores: Mapping[str, Any]) -> str:
    """What 90 % bands hold, and their width over that of Gaussian ones with this RMSE."""
    if np.isnan(scores["coverage"]):
        return "–"
    return f"{scores['coverage']:.2f}, {scores['width'] / (3.29 * scores['rmse']):.2g}"


def seconds(scores: Mapping[str, Any]) -> str:
    return f"{scores['seconds']:.0f}"


TABLES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "RMSE of free simulation": rmse,
    "CRPS": crps,
    "Share of samples in 90 % bands, and their width over 3.29 RMSE": bands,
    "Processor time of the fit in s, with all that it needs": seconds,
}


def cells(rows: Rows, of: Callable[[Mapping[str, Any]], str]) -> Iterator[list[str]]:
    """The header of a table and its rows."""
    yield ["", "unit", *METHODS.values()]
    for row, found in rows.items():
        methods = found["methods"]
        own = [of(methods[each]) if each in methods else "" for each in METHODS]
        yield [row, found["unit"], *own]


def markdown(rows: Rows) -> str:
    """The tables of docs/results.md."""
    made = []
    for title, of in TABLES.items():
        header, *body = cells(rows, of)
        lines = [header, ["---"] * len(header), *body]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        made.append(f"**{title}**\n\n{table}")
    return "\n\n".join(made)


def show(rows: Rows) -> None:
    console = Console(width=max(Console().width, 200))
    for title, of in TABLES.items():
        header, *body = cells(rows, of)
        table = Table(*header, title=title)
        for line in body:
            table.add_row(*line)
        console.print(table)
    for row, found in rows.items():
        notes = {name: each["note"] for name, each in found["methods"].items() if each["note"]}
        lines = [f"  {name}: {note}" for name, note in (notes | found["missing"]).items()]
        console.print(f"{row}; published: {found['published'] or '–'}", *lines, sep="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", choices=[[], *SYSTEMS], metavar="NAME")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("RETWIN_DATA", ".")))
    parser.add_argument("--out", type=Path, default=HERE.parent / "runs" / "systems")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--show", action="store_true", help="fit nothing, print what is there")
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args()
    names = options.names or list(SYSTEMS)
    if not options.show:
        run(names, options.data, options.out, options.processes)
    rows = gathered(names, options.data, options.out)
    if options.markdown:
        print(markdown(rows))
    else:
        show(rows)
    if not options.names:
        result = {"machine": machine(), "rows": rows}
        write(HERE / "results" / "systems.json", result)


if __name__ == "__main__":  # worker processes are spawned
    main()
