"""Every method on every system: scores on test records, in one table.

    python benchmarks/systems.py [NAME ...] [--data FOLDER] [--out FOLDER] [--show]

NAME is a key of `systems.SYSTEMS`; by default all. Each method sees the calibration records alone
and goes through the public interface with its defaults. Results are one JSON file per system and
method in the folder OUT; those that are there are not made again; the whole table goes to
benchmarks/results/systems.json, and the tables are those of docs/results.md. A job that needs more
processor time than `LIMIT` ends.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from record import machine, rounded
from systems import SYSTEMS, System
from systems.methods import AHEAD, JOBS, METHODS, score

from retwin.serialisation.files import write_atomically
from retwin.update.forecast_errors import FEW
from retwin.workers.pools import worker_pool

HERE = Path(__file__).parent
LIMIT = 400.0
"""Longest processor time of a job in s; what it has not fitted until then has no score."""
SHARED = {"arx", "narx", "neural_ss", "lstm"}
"""Jobs and models without a twin, which are fitted once for systems with the same records."""
Rows = dict[str, dict[str, Any]]
"""By row of the table and method, with scores."""


@cache
def load(name: str, data: Path) -> System:
    """A system; reading its records may take seconds."""
    return SYSTEMS[name](data)


def work(name: str, job: str, data: Path, out: Path, limit: float) -> None:
    """Fit and score what one job makes of one system, a file for each model."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, limit)
    system = load(name, data)
    spent, began = 0.0, time.process_time()
    for method, model, note in JOBS[job](system):
        spent += time.process_time() - began
        scores = [score(model, system, records) for records in system.tests.values()]
        write(out / name / f"{method}.json", {"scores": scores, "seconds": spent, "note": note})
        began = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, 0)


def late(*_: Any) -> None:
    raise TimeoutError("not within the limit of processor time")


def write(file: Path, result: Mapping[str, Any]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(file) as part:
        part.write_text(json.dumps(rounded(dict(result)), indent=1) + "\n", encoding="utf-8")


def run(names: list[str], options: argparse.Namespace) -> None:
    """Do the jobs that are not done."""
    out, futures = options.out, dict[tuple[str, str], Future]()
    with worker_pool(options.processes) as pool:
        for job, name in product(options.jobs or JOBS, names):
            own = owner(load(name, options.data), name, job)
            if (own, job) not in futures and not finished(out / own / f"done {job}.json", options):
                args = (own, job, options.data, out, options.limit)
                futures[own, job] = pool.schedule(work, args)
        for (name, job), future in futures.items():
            try:
                future.result()
                reason = ""
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
            ended = {"reason": reason, "limit": options.limit}
            write(out / name / f"done {job}.json", ended)
            print(f"{name}, {job}: {reason or 'done'}", flush=True)


def owner(system: System, name: str, what: str) -> str:
    """The system for which a job or a model is fitted: one of those with the same records."""
    return system.data if what in SHARED and system.data else name


def finished(file: Path, options: argparse.Namespace) -> bool:
    """Whether a job has ended, and not by a limit lower than that of today."""
    if not file.exists():
        return False
    found = json.loads(file.read_text("utf-8"))
    late = found["reason"].startswith("TimeoutError")
    return not late or found.get("limit", 0.0) >= options.limit


def gathered(names: list[str], data: Path, out: Path) -> Rows:
    """The scores that there are. Folds of a row are averaged, squares of its RMSE."""
    parts: dict[str, dict[str, list[dict[str, Any]]]] = {}
    about: Rows = {}
    missing: dict[str, dict[str, str]] = {}
    for name in names:
        system = load(name, data)
        for index, row in enumerate(system.tests):
            about[row] = {"unit": system.unit, "published": system.published}
            for job in JOBS:
                file = out / owner(system, name, job) / f"done {job}.json"
                reason = json.loads(file.read_text("utf-8"))["reason"] if file.exists() else ""
                if reason:
                    missing.setdefault(row, {})[job] = reason
            for method in METHODS:
                file = out / owner(system, name, method) / f"{method}.json"
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
    """The scores of several folds as those of one system."""
    notes = dict.fromkeys(each.pop("note") for each in entries)
    values = {key: np.array([each[key] for each in entries], float) for key in entries[0]}
    seconds = float(values.pop("seconds").sum())
    squares = {key: values.pop(key) for key in list(values) if key.startswith(("rmse", "ahead "))}
    roots = {key: float(np.sqrt(np.mean(each**2))) for key, each in squares.items()}
    means = {key: float(np.mean(each)) for key, each in values.items()}
    return {**roots, **means, "seconds": seconds, "note": "; ".join(notes)}


def number(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.3g}"


def rmse(scores: Mapping[str, Any]) -> str:
    return number(scores["rmse"])


def crps(scores: Mapping[str, Any]) -> str:
    return number(scores["crps"])


def bands(scores: Mapping[str, Any]) -> str:
    """What 90 % bands hold, and their width over that of Gaussian ones with this RMSE."""
    if np.isnan(scores["coverage"]):
        return "–"
    return f"{scores['coverage']:.2f}, {scores['width'] / (3.29 * scores['rmse']):.2g}"


def ahead(scores: Mapping[str, Any]) -> str:
    """RMSE after several times."""
    values = [each for name, each in scores.items() if name.startswith("ahead")]
    return "" if np.isnan(values).all() else " / ".join(f"{each:.2g}" for each in values)


def seconds(scores: Mapping[str, Any]) -> str:
    return f"{scores['seconds']:.0f}"


TABLES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "RMSE": rmse,
    "CRPS": crps,
    "Share of samples in 90 % bands, and their width over 3.29 RMSE": bands,
    "RMSE 1, 10 and 100 samples ahead of the last measurement": ahead,
    "Processor time of the fit in s, with all that it needs": seconds,
}


def table(rows: Rows, of: Callable[[Mapping[str, Any]], str]) -> str:
    """A table in Markdown, which text shows too; columns without any score are left out."""
    lines = [["", "unit", *METHODS.values()]]
    for row, found in rows.items():
        methods = found["methods"]
        own = [of(methods[each]) if each in methods else "" for each in METHODS]
        lines.append([row, found["unit"], *own])
    columns = [each for each in zip(*lines, strict=True) if not each[0] or any(each[1:])]
    widths = [max(map(len, each)) for each in columns]
    body = [
        "| " + " | ".join(map(str.ljust, line, widths)) + " |"
        for line in zip(*columns, strict=True)
    ]
    return "\n".join(
        [body[0], "|" + "|".join("-" * (each + 2) for each in widths) + "|", *body[1:]]
    )


def band_table(rows: Rows) -> str:
    """What bands of `rt.fit` hold, with its interval, and their width, by time ahead."""
    lines = []
    for row, found in rows.items():
        scores = found["methods"].get("fit", {})
        cells = []
        for name in (*map(str, AHEAD), "free"):
            held = scores.get(f"held {name}", float("nan"))
            if scores.get(f"given {name}") == 0:
                cells.append("none")
            elif np.isnan(held):
                cells.append("–")
            else:
                low, high = (scores[f"{end} {name}"] for end in ("low", "high"))
                few = "" if scores[f"independent {name}"] >= FEW else " (few)"
                given = scores[f"given {name}"]
                part = "" if given > 0.995 else f", of {given:.0%}"
                width = f"{scores[f'relative {name}']:.2g}"
                cells.append(f"{held:.2f} ({low:.2f}–{high:.2f}), {width}{part}{few}")
        lines.append(f"| {row} | " + " | ".join(cells) + " |")
    heads = (*(f"{n} ahead" for n in AHEAD), "free")
    return "\n".join(["| | " + " | ".join(heads) + " |", "|" + "---|" * (len(heads) + 1), *lines])


def show(rows: Rows) -> None:
    for title, of in TABLES.items():
        print(f"\n{title}\n\n{table(rows, of)}")
    print(f"\nBands of rt.fit\n\n{band_table(rows)}\n")
    for row, found in rows.items():
        notes = {name: each["note"] for name, each in found["methods"].items() if each["note"]}
        lines = [f"    {name}: {note}" for name, note in (notes | found["missing"]).items()]
        print(f"{row}; published: {found['published'] or '–'}", *lines, sep="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", choices=[[], *SYSTEMS], metavar="NAME")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("RETWIN_DATA", ".")))
    parser.add_argument("--out", type=Path, default=HERE.parent / "runs" / "systems")
    parser.add_argument("--jobs", nargs="*", choices=list(JOBS))
    parser.add_argument("--limit", type=float, default=LIMIT)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--show", action="store_true", help="fit nothing, print what is there")
    options = parser.parse_args()
    names = options.names or list(SYSTEMS)
    if not options.show:
        run(names, options)
    rows = gathered(names, options.data, options.out)
    show(rows)
    if not options.names and not options.show:
        result = {"machine": machine(), "rows": rows}
        write(HERE / "results" / "systems.json", result)


if __name__ == "__main__":  # worker processes are spawned
    main()
