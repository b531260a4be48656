"""How long do 3600 corrected, labelled trajectories take, and how much memory?

Target: at most 10 s on two cores and 2 GB. Beside it the surrogate alone and plain vectorised
physics: on a static arm closed-form kinematics is the faster simulator, and no surrogate is needed
for speed. Writes benchmarks/out/generation.json.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

from record import peak_memory_gb, record

import retwin as rt
from retwin.twins.armpi import KINEMATIC

REPEATS = 3
PER_CLASS = 400


def median_seconds(make: Callable[[], object]) -> float:
    took = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        make()
        took.append(time.perf_counter() - started)
    return statistics.median(took)


def main() -> None:
    case = rt.cases.armpi()
    twin = rt.generate(case.twin, case, per_class=40, seed=0)
    real = rt.generate(case.emulator, case, per_class=10, seed=1)
    # The time of generation does not depend on how well the models are fitted.
    ibg = rt.fit_surrogate(twin, seed=0, training=rt.Training(epochs=2, batch=256, rate=5e-3))
    updated = rt.CorrectedTwin(ibg, rt.fit_residual(ibg, real, seed=0))
    before = peak_memory_gb()
    rows = {
        "IBG + RG, corrected and labelled": median_seconds(
            lambda: rt.generate(updated, case, per_class=PER_CLASS, seed=2)
        ),
        "memory, highest so far (GB)": peak_memory_gb(),
        "IBG alone": median_seconds(lambda: rt.generate(ibg, case, per_class=PER_CLASS, seed=2)),
        "closed-form kinematics with servo lag": median_seconds(
            lambda: rt.generate(KINEMATIC, case, per_class=PER_CLASS, seed=2)
        ),
        "memory before generating (GB)": before,
    }
    record("generation", f"{9 * PER_CLASS} trajectories of 10 s at 100 Hz, median s", rows)


if __name__ == "__main__":
    main()
