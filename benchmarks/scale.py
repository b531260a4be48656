"""Time, memory and disk space of labelled trajectories that are written to Zarr and read again.

Target: at most 2 GB for parent and workers together, whatever the number of trajectories. The twin
is the closed-form arm, 1000 samples, all nine classes. The uses of the data are timed too: features
for a classifier, and the samples from which a surrogate learns (it trains for one epoch, which
takes the same time for any number of trajectories). For results/scaling.md, several twins are timed
on one core in processor time, which excludes other work of the machine. The arguments are the
number of trajectories, where 0 skips the first part, and folders that `CorrectedTwin.save` wrote
for the arm, in whose place the closed-form arm is not written; then the second part is skipped.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import psutil
from record import record, timed

import retwin as rt
from retwin import twins
from retwin.deploy.simulations import SimulationPlan, simulate_to
from retwin.diagnosis.trained.features import Features

MILLION = 1_000_000
COUNT = 1024


class PeakMemory:
    """The highest resident memory of this process and its children, sampled ten times a second."""

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


def whole(case: rt.Case, n: int, name: str, twin: rt.Twin) -> None:
    workers = os.cpu_count() or 1
    plan = SimulationPlan(twin, case.sampler, seed=0, n=n, faults=case.faults)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "made.zarr"
        with PeakMemory() as peak:
            took, _ = timed(lambda: simulate_to(target, plan, workers=workers))
        size = sum(file.stat().st_size for file in target.rglob("*") if file.is_file())
        loaded, made = timed(lambda: rt.load(target))
        featured, _ = timed(lambda: Features.at(made)(made))
        once = rt.Training(max_epochs=1, batch_size=256)
        learned, _ = timed(lambda: rt.fit_surrogate(made, seed=0, training=once))
        numbers = sum(getattr(made, name).nbytes for name in ("commands", "nominal", "observed"))
    rows = {
        "trajectories": n,
        "workers": workers,
        "time (s)": took,
        "trajectories/s": n / took,
        "peak memory, parent and workers (GB)": peak.gb,
        "on disk (GB)": size / 1e9,
        "on disk, share of the numbers and the mask": size / (numbers + made.mask.nbytes),
        "loading, checked (s)": loaded,
        "features of a classifier (s)": featured,
        "a surrogate, one epoch (s)": learned,
        "a million, extrapolated (min)": MILLION / n * took / 60,
        "a million on disk, extrapolated (GB)": MILLION / n * size / 1e9,
    }
    record(f"scale_{name.split()[0].lower()}", f"{name} to Zarr, 1000 samples", rows)


def per_core(case: rt.Case) -> None:
    simulator = replace(case.twin, threads=1)
    real = rt.generate(case.emulator, case, per_class=6, seed=1)
    # The time to generate does not depend on the quality of the models.
    brief = rt.Training(max_epochs=1, batch_size=256, learning_rate=5e-3)
    simulated = rt.generate(simulator, case, per_class=20, seed=0)
    ibg = rt.fit_surrogate(simulated, seed=0, training=brief)
    ways = {
        "closed form": twins.get("armpi-kinematic"),
        "MuJoCo, 5 ms": simulator,
        "corrected, delay and offset": rt.CorrectedTwin(
            ibg, rt.fit_residual(ibg, real, case.output_correction, seed=0)
        ),
        "corrected, command space": rt.CorrectedTwin(ibg, rt.fit_residual(ibg, real, seed=0)),
    }
    rows, clock = {}, time.process_time
    for name, twin in ways.items():
        plan = SimulationPlan(twin, case.sampler, seed=0, n=COUNT, faults=case.faults)
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / "made.zarr"
            made, _ = timed(lambda to=target, of=plan: simulate_to(to, of, workers=1), clock)
            read, found = timed(lambda of=target: rt.load(of), clock)
            extracted, _ = timed(lambda of=found: Features.at(of)(of), clock)
            size = sum(file.stat().st_size for file in target.rglob("*") if file.is_file())
        rows[name] = {
            "generated/s": COUNT / made,
            "read/s": COUNT / read,
            "features/s": COUNT / extracted,
            "kB": size / COUNT / 1e3,
        }
    record("scale_per_core", "Trajectories per second of one core, and bytes on disk", rows)


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    case = rt.cases.armpi()
    corrected = [rt.CorrectedTwin.load(each) for each in sys.argv[2:]]
    for twin in corrected:
        name = type(twin.residual.correction).__name__
        whole(case, n, f"Corrected arm ({name})", twin)
    if n and not corrected:
        whole(case, n, "Closed-form arm", twins.get("armpi-kinematic"))
    if not corrected:
        per_core(case)


if __name__ == "__main__":
    main()
