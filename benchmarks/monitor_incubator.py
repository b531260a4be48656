"""The live monitor on the incubator: false alarms and delays, on records and emulated faults.

    python benchmarks/monitor_incubator.py FOLDER

FOLDER has the records of the incubator. The dynamics are fitted to 2020-09-18, and the monitor is
calibrated on that record and the first of December, at one false alarm a month. It then watches
the second one of December and that of January, in which the lid is opened twice. Times within ten
minutes of an opening count as faulty; the rest is healthy, with the exact upper 95 % bound of the
rate of false alarms (Garwood, Biometrika 28, 1936). Causes are found among a lid, a weak heater, a
biased and a drifting sensor, and a frozen one. The records were watched during development.

Emulated: machines of which each has parameters from the posterior of the corrected dynamics, with
their process noise, rounded to 1/16 K. Another monitor is calibrated on eight healthy ones; 10
machines per fault, which begins after 25 minutes, and 40 healthy ones.
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
from retwin.cases.styrofoam_incubator.case import incubator, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.monitor import Monitor, find_causes, fit_monitor, possible_causes
from retwin.twins import (
    ActuatorGain,
    ParameterShift,
    SensorBias,
    SensorDrift,
    Stuck,
)
from retwin.twins.faults import Fault
from retwin.update import DynamicsTwin, OutsideTrainingWarning, fit_dynamics

FALSE_ALARMS = "1 per month"
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
    record("monitor incubator", "Incubator, records", rows)
    record("monitor emulated incubator", "Incubator, emulated", emulated(twin))


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
    time = np.arange(whole.steps) / whole.rate
    faulty = np.zeros(whole.steps, dtype=bool)
    for start, end in zip(opened, closed, strict=True):
        faulty |= (time >= start) & (time <= end + AFTER)
    hours = float((whole.mask[0, :, 0] & ~faulty).sum() / whole.rate / 3600)
    false = sum(not faulty[each.sample] for each in found.alarms)
    causes = possible_causes(monitor.twin, incubator().alarm_causes)
    delays, onsets, named = [], [], 0
    for start, end in zip(opened, closed, strict=True):
        first = [each for each in found.alarms if start <= each.time <= end]
        if not first:
            delays.append(np.inf)
            continue
        delays.append(first[0].time - start)
        (cause,) = find_causes(monitor.twin, whole, first[:1], causes)
        named += cause.name == "lid"
        onsets.append(abs(cause.onset[0] - start) * whole.rate)
    return {
        "healthy hours": hours,
        "false alarms": float(false),
        "upper bound per hour": float(chi2.ppf(0.95, 2 * (false + 1)) / 2 / hours),
        "void": float(found.void[0, -1]),
        "openings": float(len(delays)),
        "median delay in s": float(np.median(delays)) if delays else np.nan,
        "largest": float(max(delays)) if delays else np.nan,
        "named lid": float(named) if delays else np.nan,
        "onset error in samples": float(max(onsets)) if onsets else np.nan,
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
