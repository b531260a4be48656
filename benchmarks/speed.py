"""Everything of results/speed.md that one command can measure, in processor time and by the clock.

The argument is a folder that `CorrectedTwin.save` wrote for the arm, in command space; a second one
may be of a twin with `DelayOffset`. Processor time is that of all threads, and counts on a busy
machine too; the time of the clock is of use on an idle one. Figures are medians. Studies and
reports are timed by `time retwin demo --out demo` and `time retwin report demo`.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import psutil
import torch
from record import peak_memory_gb, record

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC
from retwin.diagnosis import fit_inversion

COUNT = 3600
REPEATS = 5
REAL = 54


def both(make: Callable[[], object], repeats: int = REPEATS) -> dict[str, float]:
    """Medians of processor and wall-clock seconds."""
    taken = []
    for _ in range(repeats):
        started = time.process_time(), time.perf_counter()
        make()
        taken.append((time.process_time() - started[0], time.perf_counter() - started[1]))
    processor, wall = map(statistics.median, zip(*taken, strict=True))
    return {"processor (s)": processor, "clock (s)": wall}


def memory(twin: rt.CorrectedTwin, case: rt.Case, each: int) -> dict[str, float]:
    """Memory in GB that the first generation of this process takes beyond its result."""
    rt.generate(twin, case, per_class=4, seed=0)
    before = psutil.Process().memory_info().rss / 1024**3
    made = rt.generate(twin, case, per_class=each, seed=2)
    size = sum(getattr(made, name).nbytes for name in ("commands", "nominal", "observed"))
    return {"set": size / 1024**3, "beyond it": peak_memory_gb() - before - size / 1024**3}


def main(folders: list[str]) -> None:
    case = rt.cases.armpi()
    loaded = [rt.CorrectedTwin.load(each) for each in folders]
    twin = loaded[0]
    ways = {type(each.residual.correction).__name__: each for each in loaded}
    each = COUNT // len(case.classes)
    record("speed_memory", f"GB for {COUNT} trajectories", memory(twin, case, each))
    rows = {}
    for name, way in {**ways, "surrogate": twin.surrogate, "closed form": KINEMATIC}.items():
        rt.generate(way, case, per_class=4, seed=0)
        rows[f"{COUNT} of {name}"] = both(
            lambda way=way: rt.generate(way, case, per_class=each, seed=2)
        )
    sent = case.sampler.sample(REAL, rng=np.random.default_rng(3))
    real = case.emulator.simulate(sent, seed=3)
    context = twin.residual.context(twin.surrogate, np.ascontiguousarray(real.commands))
    measured = torch.as_tensor(real.observed.astype(np.float64)), torch.as_tensor(real.mask.copy())
    infer = twin.residual.correction.infer
    rows[f"inference of {REAL} in command space"] = both(lambda: infer(context, *measured), 3)
    healthy = real[:12].replace(labels=np.repeat("Healthy", 12))
    diagnoser = fit_inversion(twin.surrogate, twin.residual, healthy, case.faults)
    faulty = rt.generate(case.emulator, case, per_class=1, seed=4)

    def one_by_one() -> None:
        for i in range(len(faulty)):
            diagnoser.diagnose(faulty[i : i + 1])

    one_by_one()
    found = both(one_by_one).items()
    rows["inversion of one trajectory"] = {k: v / len(faulty) for k, v in found}
    record("speed", f"with {torch.get_num_threads()} threads", rows)


if __name__ == "__main__":
    main(sys.argv[1:])
