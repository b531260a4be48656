"""Free simulation of the incubator by its twin, identified on the record of 2020-09-18.

    python benchmarks/incubator.py FOLDER

Both temperatures at the first sample of a test record are inferred from its first 120 s, with the
four parameters held. From there on the record is simulated from its commands alone. The table shows
the RMSE and the mean error in K after these 120 s, of the simulation minus the measurement, and the
inferred temperature of the heater in degrees.
"""

from __future__ import annotations

import sys
import warnings

import numpy as np
from record import record

from retwin.cases.styrofoam_incubator.case import WARM_UP, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.update.identification import LeastSquares, identify

METHOD = LeastSquares(loss="linear")


def main() -> None:
    warnings.filterwarnings("ignore", message="not identified")
    calibration, test = measurements(warm_up=0)(sys.argv[1])
    found = identify(INCUBATOR.parametric(), calibration, seed=0, method=METHOD)
    print(found.values)
    print(f"RMSE {found.figures['rms_after']:.3g} K in {found.seconds:.1f} s; {found.reason}")
    physics = found.twin.holding(*(each.name for each in INCUBATOR.parameters))
    rows = {}
    for index, name in enumerate(("2020-12-21", "2020-12-22", "2021-01-22 up to the lid")):
        whole = test[[index]]
        warm = identify(physics, whole.between(0, WARM_UP), seed=0, method=METHOD)
        error = warm.twin.simulate(whole.commands, seed=0).observed - whole.observed
        error = np.where(whole.mask, error, np.nan)[:, round(WARM_UP * whole.rate) :]
        rows[name] = {
            "RMSE, K": float(np.sqrt(np.nanmean(error**2))),
            "mean error, K": float(np.nanmean(error)),
            "heater, degC": warm.values["start_heater"],
        }
    record("incubator", "Incubator, free simulation", rows)


if __name__ == "__main__":
    main()
