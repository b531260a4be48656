"""The demonstration of the monitor: emulated incubators that stream, of which some become faulty.

Nothing here is measured. The machines are the case's own equations with other parameters, a
disturbance and a sensor that rounds, so that the twin must be fitted to them as to a real machine.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from retwin.cases import get
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.data.trajectories import Trajectories
from retwin.monitor.live.explanations import Explanations
from retwin.monitor.live.gate import Gate
from retwin.monitor.live.live import Live
from retwin.monitor.models.fitting import fit_monitor
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.store.samples import SECOND, Samples, Trajectory
from retwin.monitor.store.store import Store
from retwin.monitor.versions.registry import Registry
from retwin.twins.commands.samplers import HoldSampler
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import ActuatorGain, ParameterShift, SensorBias, TimedFault
from retwin.update import Dynamics, Library, fit_dynamics

CASE = "incubator"
SPEED = 60.0
"""How much faster than the clock the machines run, while their time is behind it."""
PARAMETERS = {
    "c_air": 520.0,
    "g_box": 0.75,
    "c_heater": 35.0,
    "g_heater": 0.9,
    "start_heater": 40.0,
}
"""Of the emulated machines; those of the twin differ by up to a sixth."""
PAUSE, SHADOW = 0.1, 15.0
"""Seconds between two batches of samples, and until a second version of the twin is fitted."""
MACHINES: Mapping[str, tuple[str, TimedFault | None]] = {
    "incubator 1": ("healthy", None),
    "incubator 2": ("the lid is open", ParameterShift("g_box", size=5.0, onset=2400.0, end=3300.0)),
    "incubator 3": ("the sensor is offset", SensorBias(0, size=1.5, onset=9000.0, end=9900.0)),
    "incubator 4": ("the heater is weak", ActuatorGain(0, size=-0.7, onset=15600.0, end=16500.0)),
}
"""The machines: what each is, and its fault with its times in s."""
HOURS = (1.0, 6.0)
"""Hours of the healthy record to which each version of the twin is fitted."""


def announced() -> list[str]:
    """What will be seen, and when, line by line."""
    made = [
        f"Emulated incubators run {SPEED:.0f} times as fast as real ones; once the page is there:"
    ]
    for name, (text, fault) in MACHINES.items():
        if fault is not None:
            begin, end = np.array([fault.onset, fault.end], dtype=float) / SPEED
            text += f" from {begin:.0f} to {end:.0f} s"
        made.append(f"  {name}: {text}")
    return made


def emulated(
    duration: float, seed: int, faults: Sequence[Fault | None] = (None,), heater: float = 0.25
) -> Trajectories:
    """Records of emulated machines, one for each fault, or None for a healthy one.

    Parameters
    ----------
    duration : float
        Their duration in s.
    seed : int
        Seed of commands and noise.
    faults : sequence of Fault or None
        Of each machine.
    heater : float
        The largest share of the heater's power; that of the faulty machines keeps the air below
        60 degrees.

    """
    rng = np.random.default_rng(seed)
    holds = (30.0, 600.0)
    sampler = HoldSampler((0.0, 20.0), (heater, 22.0), INCUBATOR.rate, duration, holds)
    commands = sampler.sample(len(faults), rng=rng)
    # At first the heater is on as far as it ever is, then off: the record has the whole range.
    seconds = np.arange(commands.shape[1]) / INCUBATOR.rate
    commands[:, seconds < 600, 0] = heater
    commands[:, seconds < 300, 0] = 0.0
    commands[:, :, 1] = 21 + np.sin(2 * np.pi * seconds / 3600)  # the room
    made = INCUBATOR.simulate(commands, faults=faults, seed=seed, parameters=PARAMETERS)
    noise = rng.normal(0.0, 0.02, made.observed.shape)
    disturbed = made.observed + lfilter([1.0], [1.0, -0.95], noise, axis=1)
    return made.replace(observed=np.round(16 * disturbed) / 16)


def fitted(hours: float, seed: int) -> Monitor:
    """A monitor whose twin is fitted to a healthy record of so many hours."""
    # A larger range than later, so that no command leaves that of the calibration; and few terms,
    # whose equations are compiled in a second.
    wide, terms = 0.3, Dynamics(Library(1, (), friction=False), memory=False, folds=4)
    corrected = fit_dynamics(INCUBATOR, emulated(3600 * hours, seed, heater=wide), terms).twin
    healthy = emulated(3600.0, seed + 1, (None,) * 3, heater=wide)
    return fit_monitor(corrected, healthy, "1 per month")


@contextmanager
def demonstration(folder: Path) -> Iterator[tuple[Live, Gate, Explanations]]:
    """The live monitor of the emulated machines, which stream while the block runs.

    Parameters
    ----------
    folder : Path
        Where the store is made.

    """
    with Store(folder / "store") as store, ExitStack() as ended:
        registry = Registry(store, CASE)
        fitted(HOURS[0], 0).save(folder / "first")
        version = registry.propose(folder / "first", f"fitted to {HOURS[0]:g} h").number
        registry.promote(version)
        live = Live(store)
        for name in MACHINES:
            live.add(name, CASE)
        explanations = ended.enter_context(Explanations(live, lambda twin: get(CASE).alarm_causes))
        gate = ended.enter_context(Gate(live))
        stop = threading.Event()
        for run in (lambda: _stream(gate, stop), lambda: _shadow(registry, folder, stop)):
            thread = threading.Thread(target=run)
            thread.start()
            ended.callback(thread.join)
        ended.callback(stop.set)
        yield live, gate, explanations


def _stream(gate: Gate, stop: threading.Event, *, duration: float = 86_400.0) -> None:
    """Send the samples of all machines when they are due.

    Parameters
    ----------
    duration : float, default 86_400.0
        Time in s by which the streams begin in the past, so that they are never ahead of the clock;
        they last for a day more.

    """
    record = emulated(2 * duration, 1, [fault for _, fault in MACHINES.values()])
    values = np.concatenate([record.commands, record.observed], axis=2)
    began, begin, sent = time.monotonic(), time.time() - duration, 0
    times = Trajectory("", int(begin * SECOND), values[0]).samples(record.rate).times
    while sent < record.steps and not stop.wait(PAUSE):
        due = min(SPEED * (time.monotonic() - began), time.time() - begin)
        new = slice(sent, int(due * record.rate) + 1)
        sending = [
            gate.send(Samples(name, times[new], values[place, new]))
            for place, name in enumerate(MACHINES)
            if new.stop > sent
        ]
        for each in sending:
            each.result()
        sent = max(sent, new.stop)


def _shadow(registry: Registry, folder: Path, stop: threading.Event) -> None:
    """Propose a version that is fitted to a longer record, and let it predict in the shadow."""
    if not stop.wait(SHADOW):
        fitted(HOURS[1], 10).save(folder / "second")
        registry.shadow(registry.propose(folder / "second", f"fitted to {HOURS[1]:g} h").number)
