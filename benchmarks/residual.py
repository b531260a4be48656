"""Fidelity of residual models with several densities.

The data are the healthy trajectories of one real set (set A, in `RETWIN_DATA`), in three folds: the
RG is fitted to the calibration trajectories of a fold, and its samples are compared with held-out
healthy ones. `healthy`: fitted to healthy trajectories alone; `all`: to those of all classes, with
the severity of each fault inferred in addition. Densities: mixtures of one, two and three
Gaussians, a normalising flow, and the mixture refined on outputs by the energy score. Scores are
averaged over trajectories. `below single` is the relative reduction of the CRPS against that of one
Gaussian, with its 95 % bootstrap interval over trajectories, and `below mean` the same against the
mean correction.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from record import record

import retwin as rt
from retwin.evaluation.fidelity.figures import Fidelity
from retwin.evaluation.fidelity.measure import measure_fidelity
from retwin.update.corrected import CorrectedTwin
from retwin.update.residual import Flow, Mixture, Refinement, fit_residual

DENSITIES = {
    "one Gaussian": Mixture(components=1),
    "two": Mixture(components=2),
    "three": Mixture(components=3),
    "flow": Flow(),
    "two, refined": Mixture(components=2, refinement=Refinement()),
}


def main() -> None:
    folder = os.environ.get("RETWIN_DATA")
    if not folder:
        print("residual: set RETWIN_DATA to the folder of the public data")
        return
    torch.set_num_threads(1)
    case = rt.cases.armpi()
    real = rt.load(Path(folder) / "armpi" / "real_a.mat", case=case)
    surrogate = rt.fit_surrogate(rt.generate(case.twin, case, per_class=40, seed=0), seed=0)
    rows: dict[str, dict[str, float]] = {}
    for kind, correction, on in (
        ("outputs, healthy", case.output_correction, "healthy"),
        ("commands, healthy", case.correction, "healthy"),
        ("commands, all", case.correction, case.faults),
    ):
        found: dict[str, list[Fidelity]] = {name: [] for name in DENSITIES}
        seconds = dict.fromkeys(DENSITIES, 0.0)
        for calibration, test in real.folds(3, seed=0):
            held_out = real[test].with_label("Healthy")
            twins = {}
            for name, density in DENSITIES.items():
                begin = time.perf_counter()
                residual = fit_residual(
                    surrogate, real[calibration], correction, density, seed=0, calibrate_on=on
                )
                seconds[name] += (time.perf_counter() - begin) / 3
                twins[name] = CorrectedTwin(surrogate, residual)
            for name, twin in twins.items():
                rivals = {"mean": replace(twin, random=False), "single": twins["one Gaussian"]}
                found[name].append(
                    measure_fidelity(twin, held_out, seed=0, rate=case.sensor_rate, against=rivals)
                )
        for name, parts in found.items():
            rows[f"{kind}: {name}"] = _row(Fidelity.concatenate(parts), seconds[name])
            print(kind, name, rows[f"{kind}: {name}"], flush=True)
    record("residual", "Held-out healthy trajectories of set A, three folds", rows)


def _row(found: Fidelity, seconds: float) -> dict[str, float]:
    figures = found.figures
    below, mean = figures["crps_below/single"], figures["crps_below/mean"]
    nan = (np.nan, np.nan)
    return {
        "energy, mm": 1e3 * figures["energy"].value,
        "CRPS, mm": 1e3 * float(found.crps.mean()),
        "90 % band": figures["coverage90"].value,
        "below single": below.value,
        "from": (below.interval or nan)[0],
        "to": (below.interval or nan)[1],
        "below mean": mean.value,
        "from ": (mean.interval or nan)[0],
        "to ": (mean.interval or nan)[1],
        "fit, s": seconds,
    }


if __name__ == "__main__":
    main()
