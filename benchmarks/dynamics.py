"""Corrected dynamics of three benchmarks, each calibrated on its calibration records alone.

    python benchmarks/dynamics.py FOLDER

FOLDER has silverbox/SNLS80mV.csv, cascaded_tanks/dataBenchmark.csv and incubator/*.csv. Each test
record is simulated from its commands alone; the incubator's after a warm-up of 120 s, in which
the starts are inferred. The table shows the RMSE of the fitted twin without and with a discrepancy,
the share of samples in 90 % bands with its interval by block bootstrap, their mean width, the share
in the 90 % intervals one step ahead, the seconds of the calibration, and the errors of what is held
out in calibration, in time and at the edges of the domain, by which forms are chosen. Errors are in
mV (tanks and Silverbox) and mK. Rows with "network" have that form alone.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import record

import retwin as rt
from retwin.cases.silver_box.twin import SILVERBOX
from retwin.cases.styrofoam_incubator.case import WARM_UP, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.scores.distributions import quantiles
from retwin.update import (
    Dynamics,
    FittedDynamics,
    OutsideTrainingWarning,
    TanhNetwork,
    fit_dynamics,
)
from retwin.update.dynamics.estimation import correlation_time

DRAWS = 200
BLOCK = 5
"""Length of a bootstrap block in correlation times of the hits."""
RESAMPLES = 1000
LINEAR = SILVERBOX.parametric().holding("square", "cubic", "feedthrough")

FORMS = {"": Dynamics(), ", network": Dynamics(library=None, network=TanhNetwork())}

Row = dict[str, float]


def main() -> None:
    warnings.simplefilter("ignore", OutsideTrainingWarning)
    folder = Path(sys.argv[1])
    rows: dict[str, Row] = {}
    for case, file, twin in (
        ("silverbox", "silverbox/SNLS80mV.csv", LINEAR),
        ("tanks", "cascaded_tanks/dataBenchmark.csv", None),
        ("tanks_overflow", "cascaded_tanks/dataBenchmark.csv", None),
    ):
        system = rt.cases.get(case)
        assert system.records is not None
        calibration, test = system.records(folder / file)
        for form, settings in FORMS.items():
            fitted = fit_dynamics(twin or system.twin, calibration, settings)
            for i in range(len(test)):
                rows[f"{case}, {test.ids[i]}{form}"] = free(fitted, test[[i]])
    for form, settings in FORMS.items():
        rows |= {f"{name}{form}": row for name, row in incubator(folder / "incubator", settings)}
    record("dynamics", "Corrected dynamics, test records", rows)


def free(fitted: FittedDynamics, test: rt.Trajectories) -> Row:
    """A record simulated from its commands alone."""
    mask = test.mask[0, :, 0]
    made = fitted.twin.simulate(np.repeat(test.commands, DRAWS, axis=0), seed=0)
    low, high = quantiles(made.observed[:, :, 0], [0.05, 0.95])
    inside = (low <= test.observed[0, :, 0]) & (test.observed[0, :, 0] <= high)
    error = (made.nominal[0] - test.observed[0])[mask]
    share, *interval = covered(inside[mask])
    return {
        "twin": 1000 * fitted.figures["rms_before"],
        "RMSE": 1000 * rms(error),
        "in band": share,
        "from": interval[0],
        "to": interval[1],
        "width": 1000 * float(np.mean((high - low)[mask])),
        "one step": float(fitted.twin.predictive(test).coverage()[0]),
        "s": fitted.seconds,
        "held out": 1000 * fitted.figures["held_out"],
        "at edges": 1000 * fitted.figures["held_out_edges"],
    }


def incubator(folder: Path, settings: Dynamics) -> Iterator[tuple[str, Row]]:
    calibration, test = measurements(warm_up=0)(folder)
    fitted = fit_dynamics(INCUBATOR, calibration, settings)
    for i, name in enumerate(("2020-12-21", "2020-12-22", "2021-01-22 up to the lid")):
        whole = test[[i]]
        warm = np.arange(whole.steps) < round(WARM_UP * whole.rate)
        twin = replace(fitted, twin=fitted.twin.started(whole.between(0, WARM_UP)))
        scored = whole.replace(mask=whole.mask & ~warm[None, :, None])
        yield (
            f"incubator, {name}",
            free(twin, scored) | {"one step": float(fitted.twin.predictive(whole).coverage()[0])},
        )


def covered(inside: NDArray) -> tuple[float, float, float]:
    """A share and its 95 % interval by the circular block bootstrap."""
    centred = (inside - inside.mean())[None, :, None]
    length = min(len(inside), max(1, round(BLOCK * correlation_time(centred))))
    rng = np.random.default_rng(0)
    starts = rng.integers(len(inside), size=(RESAMPLES, -(-len(inside) // length)))
    places = (starts[..., None] + np.arange(length)) % len(inside)
    means = inside[places].mean(axis=(1, 2))
    low, high = np.quantile(means, [0.025, 0.975])
    return float(inside.mean()), float(low), float(high)


def rms(error: NDArray) -> float:
    return float(np.sqrt(np.mean(error**2)))


if __name__ == "__main__":
    main()
