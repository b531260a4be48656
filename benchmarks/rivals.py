"""Black-box models of three benchmarks, each fitted to its calibration records alone.

    python benchmarks/rivals.py FOLDER [SYSTEM ...]

FOLDER has silverbox/SNLS80mV.csv, cascaded_tanks/dataBenchmark.csv and incubator/*.csv. SYSTEM is
silverbox, tanks or incubator; by default all. Each test record is simulated from its commands
alone; the incubator's after a warm-up of 120 s, in which the starts are inferred. The table shows
the RMSE, the share of samples in 90 % bands with its interval by block bootstrap, their mean
width, the CRPS, and the seconds of the fit. Errors are in mV (tanks and Silverbox) and mK. The
network is fitted with three seeds, of which the table has the median by each column.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scoringrules
from dynamics import DRAWS, covered, rms
from record import record

import retwin as rt
from retwin.cases.styrofoam_incubator.case import WARM_UP, measurements
from retwin.update import DynamicsTwin, OutsideTrainingWarning, fit_black_box

FILES = {
    "silverbox": "silverbox/SNLS80mV.csv",
    "tanks": "cascaded_tanks/dataBenchmark.csv",
    "incubator": "incubator",
}
SEEDS = {"arx": 1, "narx": 1, "neural_ss": 3, "lstm": 1}

Row = dict[str, float]


def main() -> None:
    warnings.simplefilter("ignore", OutsideTrainingWarning)
    folder, systems = Path(sys.argv[1]), sys.argv[2:] or list(FILES)
    rows: dict[str, Row] = {}
    for system in systems:
        for kind, seeds in SEEDS.items():
            made = [dict(scored(system, kind, folder / FILES[system], i)) for i in range(seeds)]
            for name in made[0]:
                rows[name] = {
                    column: float(np.median([each[name][column] for each in made]))
                    for column in made[0][name]
                }
                print(name, rows[name], flush=True)
    suffix = f" {' '.join(systems)}" if len(systems) < len(FILES) else ""
    record(f"rivals{suffix}", "Black-box models, test records", rows)


def scored(system: str, kind: str, file: Path, seed: int) -> Iterator[tuple[str, Row]]:
    """The figures of each test record."""
    warm = system == "incubator"
    records = measurements(warm_up=0) if warm else rt.cases.get(system).records
    assert records is not None
    calibration, test = records(file)
    fitted = fit_black_box(calibration, kind, seed=seed)
    for i in range(len(test)):
        one, twin = test[[i]], fitted.twin
        if warm:
            if isinstance(twin, DynamicsTwin):  # an LSTM has no start that could be inferred
                twin = twin.started(one.between(0, WARM_UP))
            later = np.arange(one.steps) >= round(WARM_UP * one.rate)
            one = one.replace(mask=one.mask & later[None, :, None])
        row = free(twin, one) | {"order": fitted.figures.get("order", np.nan), "s": fitted.seconds}
        yield f"{system} {one.ids[0]}, {kind}", row


def free(twin: rt.Twin, test: rt.Trajectories) -> Row:
    """A record simulated from its commands alone."""
    mask, real = test.mask[0, :, 0], test.observed[0, :, 0]
    made = twin.simulate(np.repeat(test.commands, DRAWS, axis=0), seed=0)
    drawn = made.observed[:, mask, 0]
    low, high = np.quantile(drawn, [0.05, 0.95], axis=0)
    share, *interval = covered((low <= real[mask]) & (real[mask] <= high))
    return {
        "RMSE": 1000 * rms(drawn.mean(axis=0) - real[mask]),
        "in band": share,
        "from": interval[0],
        "to": interval[1],
        "width": 1000 * float(np.mean(high - low)),
        "CRPS": 1000 * float(np.mean(scoringrules.crps_ensemble(real[mask], drawn.T))),
    }


if __name__ == "__main__":
    main()
