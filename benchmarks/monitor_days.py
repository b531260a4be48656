"""A monitor on another day: each record of the incubator left out in turn, and emulated days.

    python benchmarks/monitor_days.py FOLDER [STREAMS]

FOLDER has the four records of the incubator. For each of them the dynamics are fitted to the others
(the days that a user has), the monitor is calibrated on these at one false alarm a month, and the
record is replayed. Times from the opening of a lid until ten minutes after its closing count as
faulty; the rest is healthy. Beside the false events stand the exact upper 95 % bound of their rate
(Garwood, Biometrika 28, 1936), and what the monitor itself found when it left out each record of
its calibration. "one day" fits the dynamics to the longest of the other days alone.

Emulated: a tank whose level is measured, which breaks the models in use: noise is Student's t with
three degrees of freedom, has an autocorrelation of 0.95 and is three times as large while the pump
is strong; the outflow of each day differs by 5 %, and its sensor by 0.02 m. The promise is one
false alarm in 1000 samples; STREAMS days of 2000 samples are watched. And a stage in closed loop,
with a disturbance, friction and a spring that hardens, which its twin lacks: for one false alarm a
month, four monitors are each calibrated on four records of 40 s, and watch STREAMS others.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
from monitor_incubator import AFTER, openings, whole_january
from numpy.typing import NDArray
from record import record
from scipy.signal import lfilter
from scipy.stats import chi2

import retwin as rt
from retwin.cases.styrofoam_incubator.case import incubator, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.monitor import Monitor, find_causes, fit_monitor, possible_causes
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, Library, OutsideTrainingWarning, fit_dynamics

FALSE_ALARMS = "1 per month"
DAYS = ("2020-09-18", "2020-12-21", "2020-12-22", "2021-01-22")
ARL, SAMPLES = 1000.0, 2000

Row = dict[str, float]


def main() -> None:
    warnings.simplefilter("ignore", OutsideTrainingWarning)
    folder = Path(sys.argv[1])
    calibration, test = measurements(warm_up=0)(folder)
    days = [whole(each) for each in (calibration, *(test[[i]] for i in range(3)))]
    rows = {}
    for number, day in enumerate(DAYS):
        others = [each for i, each in enumerate(days) if i != number]
        both = rt.Trajectories.concatenate(others)
        longest = max(others, key=lambda each: each.steps)
        lids = openings(folder) if number == 3 else (np.zeros(0), np.zeros(0))
        seen = whole_january(folder) if number == 3 else days[number]
        for name, known in ((day, both), (f"{day}, one day", longest)):
            monitor = fit_monitor(fit_dynamics(INCUBATOR, known).twin, both, FALSE_ALARMS)
            rows[name] = watched(monitor, seen, *lids)
            print(name, rows[name], flush=True)
    record("monitor days", "Incubator, each record left out", rows)
    streams = int(sys.argv[2]) if len(sys.argv) > 2 else 200
    record("monitor emulated days", "Emulated days", emulated(streams))


def whole(day: rt.Trajectories) -> rt.Trajectories:
    """A record without what it was filled up with."""
    last = int(np.flatnonzero(day.mask[0].any(axis=1))[-1]) + 1
    return day.between(0.0, last / day.rate)


def watched(monitor: Monitor, day: rt.Trajectories, opened: NDArray, closed: NDArray) -> Row:
    """Events in healthy times, lids, and time in which nothing is promised."""
    found = monitor.watch(day)
    time = np.arange(day.steps) / day.rate
    faulty = np.zeros(day.steps, dtype=bool)
    for start, end in zip(opened, closed, strict=True):
        faulty |= (time >= start) & (time <= end + AFTER)
    healthy = day.mask[0, :, 0] & ~faulty
    hours = float(healthy.sum() / day.rate / 3600)
    false = [each for each in found.events if not faulty[each.sample]]
    promised = [each for each in false if each.promised]
    causes = possible_causes(monitor.twin, incubator().alarm_causes)
    known = find_causes(monitor.twin, day, found.alarms, causes)
    delays, named = [], 0
    for start, end in zip(opened, closed, strict=True):
        own = [each for each in known if start <= each.alarm.time <= end]
        delays.append(min((each.alarm.time - start for each in own), default=np.inf))
        named += any(each.name == "lid" for each in own[:1])
    return {
        "healthy hours": hours,
        "events": float(len(found.events)),
        "false": float(len(promised)),
        "bound per hour": float(chi2.ppf(0.95, 2 * (len(promised) + 1)) / 2 / hours),
        "false remarks": float(len(false) - len(promised)),
        "lids": float(len(delays)),
        "found": float(np.isfinite(delays).sum()) if delays else np.nan,
        "named": float(named) if delays else np.nan,
        "largest delay in s": float(max(delays)) if delays else np.nan,
        "void hours": float((found.void[0] & healthy).sum() / day.rate / 3600),
        "off in free simulation": float(len(monitor.find_free_errors(day))),
        "tried events": float(sum(monitor.tried.events.values())),
        "tried hours": sum(monitor.tried.samples.values()) / day.rate / 3600,
    }


TANK = StateTwin(
    (State("level", "m", 0.5, 0.0, 3.0),),
    lambda x, u: x.level,
    rt.Channels(("pump",), ("V",)),
    rt.Channels(("level",), ("m",)),
    1.0,
    derivative=lambda x, u, p: (0.1 * u.pump - p.drain * x.level,),
    parameters=(Parameter("drain", "1/s", 0.01, 1.0, 0.1),),
)


def tanks(count: int, seed: int, samples: int = SAMPLES) -> rt.Trajectories:
    """Days of the emulated tank."""
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.0, 2.0, size=(count, samples // 25, 1)), 25, axis=1)
    parts = []
    for i in range(count):
        drain = 0.13 * (1 + 0.05 * rng.normal())
        made = TANK.simulate(pump[[i]], seed=0, parameters={"drain": drain})
        noise = rng.standard_t(3, size=made.observed.shape) * 0.003 * (1 + 2 * (pump[[i]] > 1))
        disturbed = made.observed + lfilter([1.0], [1.0, -0.95], noise, axis=1)
        parts.append(made.replace(observed=disturbed + 0.02 * rng.normal()))
    joined = rt.Trajectories.concatenate(parts)
    return rt.Trajectories(
        **{**vars(joined), "ids": np.array([f"{seed}-{i}" for i in range(count)])}
    )


STAGE = StateTwin(
    (State("position", "m", 0.0), State("speed", "m/s", 0.0)),
    lambda x, u: x.position,
    rt.Channels(("force",), ("N",)),
    rt.Channels(("position",), ("m",)),
    20.0,
    derivative=lambda x, u, p: (x.speed, p.gain * u.force - 2.0 * x.speed - p.spring * x.position),
    parameters=(
        Parameter("gain", "1/kg", 1.0, 100.0, 20.0),
        Parameter("spring", "1/s2", 1.0, 20.0, 5.0),
    ),
)


def stages(count: int, seed: int, samples: int = 800) -> rt.Trajectories:
    """Records of the emulated stage, whose controller follows levels that change every 2.5 s."""
    rng = np.random.default_rng(seed)
    wanted = np.repeat(rng.uniform(-5.0, 5.0, size=(count, samples // 50)), 50, axis=1)
    position, speed, integral, disturbance = np.zeros((4, count))
    force, measured = np.empty((2, count, samples))
    for t in range(samples):
        measured[:, t] = position + 0.02 * rng.normal(size=count)
        error = wanted[:, t] - measured[:, t]
        integral += 0.05 * error
        force[:, t] = np.clip(0.5 * error + 0.3 * integral - 0.05 * speed, -10, 10)
        disturbance = 0.98 * disturbance + 0.08 * rng.normal(size=count)
        for _ in range(10):
            lost = np.tanh(5 * speed) + 0.02 * position**3
            pull = 20 * (force[:, t] + disturbance) - 2 * speed - 5 * position - lost
            speed = speed + 0.005 * pull
            position = position + 0.005 * speed
    made = STAGE.simulate(force[..., None], seed=0)
    return made.replace(observed=measured[..., None])


def emulated(streams: int) -> dict[str, Row]:
    """False events of emulated machines, and offsets of their sensors that are found."""
    twin = fit_dynamics(TANK, tanks(1, 0), Dynamics(Library(0, (), False))).twin
    deviation = 0.003 * np.sqrt(3) / np.sqrt(1 - 0.95**2)
    rows = {"tank": counted(fit_monitor(twin, tanks(4, 1), ARL), tanks(streams, 2), 5 * deviation)}
    twin = fit_dynamics(STAGE, stages(4, 0)).twin
    for seed in range(1, 5):
        monitor = fit_monitor(twin, stages(4, seed), FALSE_ALARMS)
        rows[f"stage, {seed}"] = counted(monitor, stages(streams, 5), 0.8)
    return rows


def counted(monitor: Monitor, healthy: rt.Trajectories, offset: float) -> Row:
    """False events, and offsets in the second half of the records that are found after them."""
    found = monitor.watch(healthy)
    events, void = sum(each.promised for each in found.events), int(found.void[:, -1].sum())
    free = [monitor.find_free_errors(healthy[[i]]) for i in range(len(healthy))]
    onset = healthy.steps // 2
    late = (np.arange(healthy.steps) >= onset)[None, :, None]
    offset = monitor.watch(healthy.replace(observed=healthy.observed + offset * late))
    first: dict[str, float] = {}
    for each in offset.alarms:
        if each.sample >= onset:
            first.setdefault(each.trajectory, each.sample - onset)
    samples = float(found.score.size - np.isnan(found.score).sum())
    return {
        "streams": float(len(healthy)),
        "events": float(events),
        "promised": samples / monitor.run_length,
        "upper bound": float(chi2.ppf(0.975, 2 * (events + 1)) / 2),
        "lower bound": float(chi2.ppf(0.025, 2 * events) / 2) if events else 0.0,
        "void": float(void),
        "off in free simulation": float(sum(map(bool, free))),
        "offsets found": float(len(first)),
        "median delay": float(np.median([*first.values()])) if first else np.nan,
    }


if __name__ == "__main__":
    main()
