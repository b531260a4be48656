"""A study that is killed again and again, and resumed; run as a script.

`python killing.py FOLDER KILLS` runs the study of `FOLDER`, which holds a case and its real data,
kills it at random moments until there were so many kills, and prints a line for every difference
from the study that was not interrupted. Everything is imported once; each attempt is a forked
process, whose jobs run one after the other in itself, since a worker writes as it does.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import numpy as np

import retwin as rt
from retwin import study
from retwin.study import StudyData, StudyPlan
from retwin.study.work import Work

PLAN = StudyPlan(sources=("dt", "ibg_rg"), runs=1, per_class=6, folds=2, seed=2)
COSTS = ("update_s", "generate_s", "train_s", "predict_s")


def in_turn(work: Work, *_: object) -> None:
    """Do the missing jobs one after the other, in place of worker processes."""
    for job in TopologicalSorter(work.graph()).static_order():
        if not work.files.path(job).exists():
            work.do(job, lambda _: None)


def attempt(folder: Path, out: Path, seconds: float | None) -> bool:
    """Run or resume the study in a process of its own; False if it was killed after `seconds`."""
    process = os.fork()
    if not process:
        code = 1
        try:
            study.run_jobs = in_turn
            case = rt.cases.get(str(folder / "case.toml"))
            study.run_study(case, PLAN, StudyData(real=folder / "real.npz"), out, processes=1)
            code = 0
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            os._exit(code)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(process, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    assert code in (0, -signal.SIGKILL), code
    return code == 0


def contents(out: Path) -> dict[str, Any]:
    """The bytes of all files by name, and what of results.json does not depend on time."""
    files = {file.relative_to(out).as_posix(): file for file in out.rglob("*") if file.is_file()}
    found: dict[str, Any] = {name: file.read_bytes() for name, file in files.items()}
    # The costs of a job are lost if its process is killed before it writes them.
    found = {name: each for name, each in found.items() if not name.endswith(".costs.json")}
    results = json.loads(found["results.json"])
    for name in ("timing", "provenance"):
        del results[name]
    for source in results["sources"].values():
        for cost in COSTS:
            source.pop(cost, None)
    return found | {"results.json": results}


def differences(folder: Path, kills: int) -> Iterator[str]:
    """Kill and resume studies until there were so many kills."""
    rng = np.random.default_rng(0)
    begun = time.monotonic()
    assert attempt(folder, folder / "whole", None)
    longest = time.monotonic() - begun
    expected = contents(folder / "whole")
    killed = number = 0
    while killed < kills:
        number, before = number + 1, killed
        out = folder / f"killed-{number}"
        while not attempt(folder, out, rng.uniform(0, longest)):
            killed += 1
        found = contents(out)
        for name in sorted(expected.keys() | found.keys()):
            if found.get(name) != expected.get(name):
                state = "differs" if name in found and name in expected else "is missing or left"
                yield f"{out.name}, killed {killed - before} times: {name} {state}"
        shutil.rmtree(out)


if __name__ == "__main__":
    for line in differences(Path(sys.argv[1]), int(sys.argv[2])):
        print(line, flush=True)
