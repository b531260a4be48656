"""How fast are labelled trajectories written to Zarr, in how much memory and space?

Target: at most 2 GB for parent and workers together, whatever the number of trajectories. The
closed-form arm, 1000 samples, all nine classes. Writes benchmarks/out/scale.json; a number of
trajectories can be given as the argument.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil
from record import record

import retwin as rt
from retwin import twins
from retwin.scale import SimulationPlan, simulate_to

MILLION = 1_000_000


class PeakMemory:
    """The highest resident memory of this process and its children, watched ten times a second."""

    def __init__(self) -> None:
        self.gb = 0.0
        self._stop = threading.Event()
        self._watcher = threading.Thread(target=self._watch)

    def _watch(self) -> None:
        me = psutil.Process()
        while not self._stop.wait(0.1):
            total = 0
            for process in [me, *me.children(recursive=True)]:
                try:
                    total += process.memory_info().rss
                except psutil.NoSuchProcess:
                    continue
            self.gb = max(self.gb, total / 1024**3)

    def __enter__(self) -> PeakMemory:
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._watcher.join()


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    workers = os.cpu_count() or 1
    case = rt.cases.armpi()
    twin = twins.get("armpi-kinematic")
    plan = SimulationPlan(twin, case.sampler, seed=0, n=n, faults=case.faults)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "made.zarr"
        started = time.perf_counter()
        with PeakMemory() as peak:
            simulate_to(target, plan, workers=workers)
        took = time.perf_counter() - started
        size = sum(file.stat().st_size for file in target.rglob("*") if file.is_file())
        started = time.perf_counter()
        rt.load(target)
        loaded = time.perf_counter() - started
    rows = {
        "trajectories": n,
        "workers": workers,
        "time (s)": took,
        "trajectories/s": n / took,
        "peak memory, parent and workers (GB)": peak.gb,
        "on disk (GB)": size / 1e9,
        "loading, checked (s)": loaded,
        "a million, extrapolated (min)": MILLION / n * took / 60,
        "a million on disk, extrapolated (GB)": MILLION / n * size / 1e9,
    }
    record("scale", "Closed-form arm to Zarr, 1000 samples", rows)


if __name__ == "__main__":
    main()
