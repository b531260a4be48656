"""The live monitor on the incubator: false alarms and delays, on records and emulated faults.

    python benchmarks/monitor_incubator.py FOLDER

FOLDER has the records of the incubator. The dynamics are fitted to 2020-09-18, and the monitor is
calibrated on that record and the first of December, at one false alarm a month. It then watches
the second one of December and that of January, in which the lid is opened twice. Times within ten
minutes of an opening count as faulty; the rest is healthy, with the exact upper 95 % bound of the
rate of false alarms (Garwood, Biometrika 28, 1936). Causes are found among a lid, a weak heater, a
biased and a drifting sensor, and a frozen one. The records were watched during development.

Beside it stand two-sided CUSUMs for the same run length, with the same pause after an alarm, on the
residuals of the corrected twin in free simulation, and on these after whitening by an
autoregression of order one. Mean, scale and pole are those of the calibration.

Emulated: machines of which each has parameters from the posterior of the corrected dynamics, with
their process noise, rounded to 1/16 K. Another monitor is calibrated on eight healthy ones; 10
machines per fault, which begins after 25 minutes, and 40 healthy ones. What a monitor does depends
on the eight machines that it is calibrated on: monitors of five other eights watch the same 40
healthy machines and 40 with an offset.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import record
from scipy.stats import chi2

import retwin as rt
from retwin.cases.columns import ColumnRecords
from retwin.cases.styrofoam_incubator.case import WARM_UP, incubator, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.monitor import Monitor, find_causes, fit_monitor, possible_causes
from retwin.twins import (
    ActuatorGain,
    ParameterShift,
    SensorBias,
    SensorDrift,
    Stuck,
)
from retwin.twins.faults.actuator_faults import Fault
from retwin.update import DynamicsTwin, OutsideTrainingWarning, fit_dynamics

FALSE_ALARMS = "1 per month"
CUSUM_K, CUSUM_H = 0.5, 12.5
"""Two-sided, for one false alarm in 876 600 independent Gaussian scores (Siegmund, 1985)."""
PAUSE = 60.0
"""Time in s after an alarm without another one."""
AFTER = 600.0
"""Time in s after an opening that does not count as healthy."""
QUANTUM = 1 / 16
"""Resolution of the sensors in K."""
SAMPLES = 1000
"""Samples of an emulated record: 50 minutes."""
ONSET = 1500.0
EMULATED: dict[str, Fault | None] = {
    "healthy": None,
    "dead heater": ActuatorGain(0, size=-1.0, onset=ONSET),
    "heater stuck": Stuck(0, onset=ONSET),
    "sensor offset 0.5 K": SensorBias(0, size=0.5, onset=ONSET),
    "sensor drift 0.2 K/min": SensorDrift(0, size=0.2 / 60, onset=ONSET),
    "lid": ParameterShift("g_box", size=6.0, onset=ONSET),
}
"""Faults and their sizes."""
SEED = 4000
"""Of machines that were not seen while the monitor was developed."""
HEALTHY_MACHINES, FAULTY_MACHINES, CALIBRATION_MACHINES = 40, 10, 8

Row = dict[str, float]


def main() -> None:
    warnings.simplefilter("ignore", OutsideTrainingWarning)
    folder = Path(sys.argv[1])
    calibration, test = measurements(warm_up=0)(folder)
    twin = fit_dynamics(INCUBATOR, calibration).twin
    monitor = fit_monitor(twin, rt.Trajectories.concatenate([calibration, test[[0]]]), FALSE_ALARMS)
    print(*monitor.promises.values())
    whole = whole_january(folder)
    opened, closed = openings(folder)
    rows = {
        "2020-12-22": watched(monitor, test[[1]], (), ()),
        "2021-01-22": watched(monitor, whole, opened, closed),
    }
    known = [residuals(twin, each) for each in (calibration, test[[0]])]
    for whitened, name in ((False, "CUSUM"), (True, "CUSUM after whitening")):
        for day, own, at in (
            ("2020-12-22", test[[1]], ((), ())),
            ("2021-01-22", whole, (opened, closed)),
        ):
            alarms = cusum(known, residuals(twin, own), whitened, twin.rate)
            rows[f"{name}, {day}"] = beside(alarms, own, *at)
    record("monitor incubator", "Incubator, records", rows)
    record("monitor emulated incubator", "Incubator, emulated", emulated(twin))
    record("monitor calibrations", "Incubator, emulated: calibrations", calibrations(twin))


def whole_january(folder: Path) -> rt.Trajectories:
    """The record of January beyond the first opening of the lid."""
    source = measurements(warm_up=0)
    assert isinstance(source, ColumnRecords)
    *_, january = source.test
    return replace(source, test=(replace(january, rows=None),))(folder)[1]


def openings(folder: Path) -> tuple[NDArray, NDArray]:
    """Times in s at which the lid is opened and closed, from the first sample of January."""
    first = np.genfromtxt(folder / "2021-01-22_lid.csv", delimiter=",", skip_header=1, max_rows=1)
    lines = (folder / "2021-01-22_lid_events.csv").read_text("utf-8").splitlines()[1:]
    events = [each.split(",", 1) for each in lines if each]
    times = {
        word: np.array([(int(t) - first[0]) / 1e9 for t, what in events if word in what])
        for word in ("Opened", "Closed")
    }
    return times["Opened"], times["Closed"]


def watched(
    monitor: Monitor, whole: rt.Trajectories, opened: Sequence[float], closed: Sequence[float]
) -> Row:
    """False alarms in healthy times, and delays, causes and onsets at openings."""
    found = monitor.watch(whole)
    causes = possible_causes(monitor.twin, incubator().alarm_causes)
    onsets, named = [], 0
    for start, end in zip(opened, closed, strict=True):
        first = [each for each in found.alarms if start <= each.time <= end][:1]
        for cause in find_causes(monitor.twin, whole, first, causes):
            named += cause.name == "lid"
            onsets.append(abs(cause.onset[0] - start) * whole.rate)
    return beside([each.sample for each in found.alarms], whole, opened, closed) | {
        "void": float(found.void[0, -1]),
        "named lid": float(named) if len(opened) else np.nan,
        "onset error in samples": float(max(onsets)) if onsets else np.nan,
    }


def residuals(twin: DynamicsTwin, whole: rt.Trajectories) -> NDArray:
    """Measured minus simulated outputs (T,) of a record after its warm-up; NaN before."""
    started = twin.started(whole.between(0.0, WARM_UP))
    made: NDArray = (whole.observed - started.simulate(whole.commands, seed=0).nominal)[0, :, 0]
    late = np.arange(whole.steps) / whole.rate >= WARM_UP
    return np.where(whole.mask[0, :, 0] & late, made, np.nan)


def cusum(known: list[NDArray], own: NDArray, whitened: bool, rate: float) -> list[int]:
    """Samples at which a two-sided CUSUM alarms; it begins anew after each alarm and its pause."""
    mean = np.nanmean(np.concatenate(known))
    pairs = np.concatenate([np.stack([each[:-1], each[1:]]) - mean for each in known], axis=1)
    pole = np.nanmean(pairs[0] * pairs[1]) / np.nanmean(pairs[0] ** 2) if whitened else 0.0

    def errors(residual: NDArray) -> NDArray:
        centred = residual - mean
        return centred - pole * np.concatenate([[np.nan], centred[:-1]]) if whitened else centred

    scale = np.nanstd(np.concatenate([errors(each) for each in known]))
    alarms, pause, sums = [], 0, np.zeros(2)
    for t, score in enumerate(np.nan_to_num(errors(own) / scale)):
        pause -= 1
        if pause > 0:
            continue
        sums = np.maximum(sums + np.array([score, -score]) - CUSUM_K, 0)
        if sums.max() >= CUSUM_H:
            alarms.append(t)
            pause, sums = round(PAUSE * rate), np.zeros(2)
    return alarms


def beside(
    alarms: list[int], whole: rt.Trajectories, opened: Sequence[float], closed: Sequence[float]
) -> Row:
    """False alarms in healthy times, and delays at openings."""
    time = np.arange(whole.steps) / whole.rate
    faulty = np.zeros(whole.steps, dtype=bool)
    for start, end in zip(opened, closed, strict=True):
        faulty |= (time >= start) & (time <= end + AFTER)
    hours = float((whole.mask[0, :, 0] & ~faulty).sum() / whole.rate / 3600)
    delays = [
        min((time[t] - start for t in alarms if start <= time[t] <= end), default=np.inf)
        for start, end in zip(opened, closed, strict=True)
    ]
    false = sum(not faulty[t] for t in alarms)
    return {
        "healthy hours": hours,
        "false alarms": float(false),
        "upper bound per hour": float(chi2.ppf(0.95, 2 * (false + 1)) / 2 / hours),
        "void": np.nan,
        "openings": float(len(delays)),
        "median delay in s": float(np.median(delays)) if delays else np.nan,
        "largest": float(max(delays)) if delays else np.nan,
        "named lid": np.nan,
        "onset error in samples": np.nan,
    }


def emulated(twin: DynamicsTwin) -> dict[str, Row]:
    """Shares of faults that are found, with their delays."""
    healthy = machines(twin, None, CALIBRATION_MACHINES, 0)
    monitor = fit_monitor(twin, healthy, FALSE_ALARMS)
    rows = {}
    for number, (name, fault) in enumerate(EMULATED.items()):
        count = HEALTHY_MACHINES if fault is None else FAULTY_MACHINES
        made = machines(twin, fault, count, 1 + number)
        alarms = monitor.watch(made).alarms
        before = {each.trajectory for each in alarms if fault is None or each.time < ONSET}
        first = {
            each.trajectory: each.time - ONSET
            for each in reversed(alarms)
            if fault is not None and each.time >= ONSET
        }
        rows[name] = {
            "machines": float(count),
            "false alarms": float(len(before)),
            "found": float(len(first)),
            "median delay in s": float(np.median([*first.values()])) if first else np.nan,
            "largest": float(max(first.values())) if first else np.nan,
        }
    return rows


def calibrations(twin: DynamicsTwin) -> dict[str, Row]:
    """False alarms and offsets found by monitors of other calibrations."""
    fault = EMULATED["sensor offset 0.5 K"]
    healthy, faulty = (machines(twin, each, HEALTHY_MACHINES, SEED) for each in (None, fault))
    rows = {}
    for number in range(1, 6):
        known = machines(twin, None, CALIBRATION_MACHINES, SEED + number)
        monitor = fit_monitor(twin, known, FALSE_ALARMS)
        late = [each for each in monitor.watch(faulty).alarms if each.time >= ONSET]
        rows[f"calibration {number}"] = {
            "machines": float(HEALTHY_MACHINES),
            "false alarms": float(len({each.trajectory for each in monitor.watch(healthy).alarms})),
            "offsets found": float(len({each.trajectory for each in late})),
            "kappa": monitor.slack[0].kappa,
            "shift": monitor.slack[0].shift,
        }
    return rows


def machines(twin: DynamicsTwin, fault: Fault | None, count: int, seed: int) -> rt.Trajectories:
    """Records of machines in closed loop with a thermostat, as far as commands show it."""
    rng = np.random.default_rng(seed)
    commands = np.zeros((count, SAMPLES, 2))
    commands[..., 1] = twin.domain.mean[-1]
    for row in commands:
        t = int(rng.integers(20))
        while t < SAMPLES:
            on, off = rng.integers(4, 12), rng.integers(60, 140)
            row[t : t + on, 0] = 1.0
            t += on + off
        row[int(ONSET * twin.rate), 0] = 1.0  # a heater that is stuck stays on
    made = twin.simulate(commands, faults=[fault] * count, seed=seed)
    return made.replace(observed=np.round(made.observed / QUANTUM) * QUANTUM)


if __name__ == "__main__":
    main()
