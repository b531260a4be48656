"""Simulation error of the Silverbox's twins, each identified on realisations 1 to 9.

    python benchmarks/silverbox.py SNLS80mV.csv

The table shows RMSE in mV on the arrow and on realisation 10, without the first 50 samples, and the
seconds of the identification: of the linear twin, of one with a cubic spring, and of one with a
quadratic term and feedthrough too; for each way in which the input may pass between samples.
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import replace

import numpy as np
from record import record

import retwin as rt
from retwin.cases.silver_box.twin import SILVERBOX
from retwin.update.identification import LeastSquares, identify

MODELS = {
    "linear": ("square", "cubic", "feedthrough"),
    "cubic": ("square", "feedthrough"),
    "cubic, square, feedthrough": (),
}


def main() -> None:
    case = rt.cases.get("silverbox")
    assert case.records is not None
    calibration, test = case.records(sys.argv[1])
    method = LeastSquares(starts=1, loss="linear")
    rows = {}
    for interpolation in ("hold", "linear", "spline"):
        twin = replace(SILVERBOX, interpolation=interpolation)
        for name, held in MODELS.items():
            began = time.perf_counter()
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="not identified")
                free = twin.parametric().holding(*held)
                found = identify(free, calibration, seed=0, method=method).twin
            seconds = time.perf_counter() - began
            error = found.simulate(test.commands, seed=0).observed - test.observed
            error = np.where(test.mask, error, np.nan)
            tenth, arrow = 1000 * np.sqrt(np.nanmean(error**2, axis=(1, 2)))
            row = {"arrow, mV": arrow, "realisation 10, mV": tenth, "s": seconds}
            rows[f"input {interpolation}: {name}"] = row
    record("silverbox", "Silverbox, simulation", rows)


if __name__ == "__main__":
    main()
