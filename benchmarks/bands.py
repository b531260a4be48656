"""Coverage of the bands of a corrected twin that few trajectories calibrated.

The emulated robot gives any number of trajectories: 4 healthy ones, as many as in a fold of set A,
calibrate, and 20 others are compared with the bands; six times. Target: the 90 % bands contain 85
to 95 % of the points.
"""

from __future__ import annotations

import numpy as np
import torch
from record import record

import retwin as rt
from retwin.data.trajectories import HEALTHY

CALIBRATE, HELD_OUT = 4, 20
SETS = 6


def main() -> None:
    torch.set_num_threads(1)
    case = rt.cases.armpi()
    ibg = rt.fit_surrogate(rt.generate(case.twin, case, per_class=40, seed=0), seed=0)
    columns: dict[str, dict[str, float]] = {}
    for name, operator in (
        ("delay and offset", case.output_correction),
        ("command space", case.correction),
    ):
        found = [coverage(case, ibg, operator, seed) for seed in range(SETS)]
        columns[name] = {f"set {i + 1}": share for i, share in enumerate(found)}
        columns[name]["mean"] = float(np.mean(found))
        columns[name]["standard error"] = float(np.std(found, ddof=1) / np.sqrt(SETS))
    record("bands", f"points inside the 90 % band, {HELD_OUT} emulated trajectories a set", columns)


def coverage(case: rt.Case, ibg: rt.Surrogate, operator: rt.Correction, seed: int) -> float:
    """The share of held-out points inside the 90 % band."""
    commands = case.sampler.sample(CALIBRATE + HELD_OUT, rng=np.random.default_rng(100 + seed))
    real = case.emulator.simulate(commands, seed=200 + seed).with_label(HEALTHY)
    rg = rt.fit_residual(ibg, real[:CALIBRATE], operator, seed=seed)
    twin = rt.CorrectedTwin(ibg, rg)
    found = rt.measure_fidelity(twin, real[CALIBRATE:], seed=seed, rate=case.sensor_rate)
    return float(found.figures["coverage90"].value)


if __name__ == "__main__":
    main()
