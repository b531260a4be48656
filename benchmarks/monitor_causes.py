"""Causes of injected faults: what an event of the incubator is called while they last and end.

    python benchmarks/monitor_causes.py FOLDER [REPEATS]

FOLDER has the four records of the incubator. The monitor is calibrated on the two earliest, and
faults are put into 2020-12-22: those of the sensor into its readings, a lid and a heater as what
they change in a simulation, added to the readings; in a second row another fault begins while the
first one lasts. Counted are the first causes of events that are not the fault, and the further ones
that are named: rightly, where they are the second fault, and wrongly. Of the first and of the last
cause of an event the probability of the fault is scored by its logarithm (log loss), and a cause is
sure and wrong that is not the fault and has more than 0.9.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from monitor_days import FALSE_ALARMS, whole
from numpy.typing import NDArray
from record import record

import retwin as rt
from retwin.cases.styrofoam_incubator.case import incubator, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.data.trajectories import HEALTHY
from retwin.monitor import find_causes, fit_monitor, possible_causes
from retwin.monitor.models.cause import PROBABLE
from retwin.update import OutsideTrainingWarning, fit_dynamics

LENGTHS = (60.0, 120.0, 400.0)
SIZES = {"lid": (5.0, 15.0), "heater": (-1.0, -0.4), "sensor bias": (1.5, 6.0)}
SIZES["sensor drift"] = (0.02, 0.08)
COUNTED = "events", "missed", "first wrong", "further right", "further wrong"
LOWEST, SURE = 1e-4, 0.9
"""Least probability that counts in a log loss, and that of a cause which is sure."""
AFTER = 60.0
"""Seconds after the end of a fault in which its event may begin."""


def main() -> None:
    warnings.simplefilter("ignore", OutsideTrainingWarning)
    repeats = int(sys.argv[2]) if len(sys.argv) > 2 else 4
    calibration, test = measurements(warm_up=0)(Path(sys.argv[1]))
    both = rt.Trajectories.concatenate([whole(calibration), whole(test[[0]])])
    day = whole(test[[1]])
    monitor = fit_monitor(fit_dynamics(INCUBATOR, both).twin, both, FALSE_ALARMS)
    causes = possible_causes(monitor.twin, incubator().alarm_causes)
    names = [name for name in causes if name != HEALTHY]
    own = dict(zip(monitor.twin.equations.names, monitor.twin.values.tolist(), strict=True))
    parameters = {name: value for name, value in own.items() if name in INCUBATOR.names}

    def effect(name: str, onset: float, length: float, rng: np.random.Generator) -> NDArray:
        """What a fault of a random size adds to the readings, (1, T, 1)."""
        times = np.arange(day.steps) / day.rate
        active = ((times >= onset) & (times < onset + length))[None, :, None]
        if name == "frozen sensor":
            start = day.observed[:, [round(onset * day.rate)]]
            return np.where(active, start - day.observed, 0.0)
        size = rng.uniform(*SIZES[name])
        if name.startswith("sensor"):
            ramp = times[None, :, None] - onset if name == "sensor drift" else 1.0
            return np.where(active, rng.choice([-1, 1]) * size * ramp, 0.0)
        fault = replace(causes[name], onset=onset, end=onset + length, size=size)
        runs = (
            INCUBATOR.simulate(day.commands, faults=[each], seed=0, parameters=parameters)
            for each in (fault, None)
        )
        faulty, healthy = (run.observed for run in runs)
        return np.asarray(faulty - healthy)

    def count(second: bool) -> dict[str, float]:
        """What the events of injected faults are called."""
        rng, counts = np.random.default_rng(0), dict.fromkeys(COUNTED, 0.0)
        scored: dict[str, list[tuple[float, bool]]] = {"first": [], "last": []}
        for name in names:
            for number in range(repeats):
                onset = rng.uniform(0.3, 0.7) * day.steps / day.rate
                length = float(rng.choice(LENGTHS))
                faults = [name]
                readings = day.observed + effect(name, onset, length, rng)
                if second:
                    others = [each for each in names if each not in (name, "sensor drift")]
                    faults.append(others[number % len(others)])
                    readings = readings + effect(faults[1], onset + 0.6 * length, 200.0, rng)
                watched = day.replace(observed=readings)
                alarms = monitor.watch(watched).alarms
                last = onset + length + AFTER
                event = [each for each in alarms if onset <= each.event / day.rate <= last]
                if not event:
                    counts["missed"] += 1
                    continue
                known = find_causes(monitor.twin, watched, alarms, causes)
                first, *further = [each for each in known if each.alarm.event == event[0].event]
                counts["events"] += 1
                counts["first wrong"] += first.name != name
                for which, cause in (("first", first), ("last", [first, *further][-1])):
                    loss = -np.log(max(cause.probabilities[name], LOWEST))
                    sure = cause.probability > SURE and cause.unknown < PROBABLE
                    scored[which].append((loss, sure and cause.name != name))
                for cause in further:
                    if not cause.same:
                        wrong = cause.name not in faults[1:]
                        counts["further wrong" if wrong else "further right"] += 1
        for which, each in scored.items():
            loss, wrong = zip(*each, strict=True)
            counts |= {f"{which}: log loss": float(np.mean(loss))}
            counts |= {f"{which}: sure and wrong": float(np.sum(wrong))}
        return counts

    rows = {"one fault": count(second=False), "two faults": count(second=True)}
    record("monitor causes", "Causes of injected faults", rows)


if __name__ == "__main__":
    main()
