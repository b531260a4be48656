"""Cost of updating the MuJoCo arm, and accuracy of the updated twins.

Of the healthy trajectories of set A (needs RETWIN_DATA) a third is held out, and the others
calibrate; `python benchmarks/updating.py 3` holds out every third in turn. Compared are the
residual model without its surrogate, which is fitted once, and with it, including its twin data and
its training; least squares on the twin's own parameters (Eq. 2); and their posterior by a network
(Eq. 3), with default settings. Accuracy on the held-out trajectories, at the sensor's rate: CRPS
(the mean absolute error of a deterministic twin), energy score, and coverage of the 90 % bands.
Expectation: the RG is at least 10 times faster than least squares, and 100 times than Bayes.

Seconds are processor time of one thread, which excludes other work of the machine.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
from record import record

import retwin as rt
from retwin.cases.armpi_fpv.twin import armpi_parametric
from retwin.update.identification import NPE, identify

FOLDS = 3
PER_CLASS = 100
DRAWS = 50
ARM = rt.cases.ArmPiTwin(threads=1)

Found = tuple[rt.Twin, int]
"""An updated twin, and the number of runs of the MuJoCo arm that it took."""
Score = tuple[float, int, rt.evaluation.Fidelity]
"""Seconds, runs, and fidelity on the held-out trajectories."""


def rivals(case: rt.Case, ibg: rt.Surrogate) -> dict[str, Callable[[rt.Trajectories], Found]]:
    """Functions from calibration trajectories to an updated twin, by name."""
    twin, rate = armpi_parametric(ARM), case.sensor_rate

    def corrected(correction: rt.Correction) -> Callable[[rt.Trajectories], Found]:
        return lambda data: (
            rt.CorrectedTwin(ibg, rt.fit_residual(ibg, data, correction, seed=0)),
            0,
        )

    def least_squares(data: rt.Trajectories) -> Found:
        found = identify(twin, data, seed=0, rate=rate)
        return found.twin, found.twin_runs

    def network(data: rt.Trajectories) -> Found:
        found = identify(twin, data, NPE(), seed=0, rate=rate)
        return found.twin, found.twin_runs

    return {
        "original twin": lambda data: (twin, 0),
        "RG, delay and offset": corrected(case.output_correction),
        "RG, command space": corrected(case.correction),
        "pi_ls": least_squares,
        "pi_bayes": network,
    }


def accuracy(fidelity: rt.evaluation.Fidelity) -> dict[str, float]:
    figures = fidelity.figures
    crps = [each.value for name, each in figures.items() if name.startswith("crps/")]
    return {
        "CRPS (mm)": 1e3 * float(np.mean(crps)),
        "energy score (mm)": 1e3 * figures["energy"].value,
        "coverage of the 90 % bands": figures["coverage90"].value,
    }


def main(folds: int) -> None:
    folder = os.environ.get("RETWIN_DATA")
    if not folder:
        print("updating: set RETWIN_DATA to the folder of the public data")
        return
    import sbi.neural_nets  # noqa: F401 - the import is not timed

    case = rt.cases.armpi()
    real = rt.load(Path(folder) / "armpi" / "real_a.mat", case=case).with_label("Healthy")
    started = time.process_time()
    twin_data = rt.generate(ARM, case, per_class=PER_CLASS, seed=0)
    simulation = time.process_time() - started
    ibg = rt.fit_surrogate(twin_data, seed=0)
    once = time.process_time() - started
    scored: dict[str, list[Score]] = {}
    for calibration, held_out in islice(real.folds(FOLDS, seed=0), folds):
        for name, update in rivals(case, ibg).items():
            began = time.process_time()
            twin, runs = update(real[calibration])
            took = time.process_time() - began
            fidelity = rt.measure_fidelity(
                twin, real[held_out], draws=DRAWS, seed=0, rate=case.sensor_rate, against={}
            )
            scored.setdefault(name, []).append((took, runs, fidelity))
        # After every fold, so that an interrupted run has results.
        publish(scored, once, simulation, len(twin_data))


def publish(
    scored: dict[str, list[Score]], once: float, simulation: float, simulations: int
) -> None:
    """Record the tables for the folds so far, with the costs of the surrogate.

    The costs are `once`, in s, its part `simulation`, and the number of runs, `simulations`.
    """
    rows, seconds = {}, {}
    for name, folds in scored.items():
        seconds[name] = float(np.mean([took for took, _, _ in folds]))
        surrogate = name.startswith("RG")
        rows[name] = {
            "seconds": seconds[name],
            "with the surrogate": seconds[name] + once * surrogate,
            "twin runs": float(np.mean([runs for _, runs, _ in folds])) + simulations * surrogate,
            **accuracy(rt.evaluation.Fidelity.concatenate([fidelity for _, _, fidelity in folds])),
        }
    held_out = sum(len(fidelity) for _, _, fidelity in next(iter(scored.values())))
    record("updating", f"updating the MuJoCo arm, {held_out} trajectories held out", rows)
    speed = {"surrogate, once (s)": once, "of this, twin runs (s)": simulation}
    for rg in ("RG, delay and offset", "RG, command space"):
        for name in ("pi_ls", "pi_bayes"):
            speed[f"{rg}: times faster than {name}"] = seconds[name] / seconds[rg]
            whole = seconds[name] / (once + seconds[rg])
            speed[f"{rg}, with its surrogate: times faster than {name}"] = whole
    record("updating_speed", "how many times faster", speed)


if __name__ == "__main__":
    with warnings.catch_warnings():
        # They name parameters that are not identified, see docs/correct.md.
        warnings.simplefilter("ignore", UserWarning)
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
