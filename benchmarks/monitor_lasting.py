"""Causes of a lasting fault: how long its event takes to explain, and what it is called.

    python benchmarks/monitor_lasting.py [REPEATS]

Two emulated machines at 20 Hz, a tank and a motor, whose outflow and friction are not those of
their twins. A fault begins after 20 s and lasts to the end of the record, 40 s later. Each machine
is watched by a monitor that promises one false alarm a month, and any change may be the cause.
Counted are alarms after the onset, how often the first event is called by another name, and whether
its first and last names are right; the time of causes is that of a processor, over that of the
fault.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np
import torch
from record import record

import retwin as rt
from retwin.monitor import find_causes, fit_monitor, possible_causes
from retwin.twins import ActuatorGain, Parameter, ParameterShift, SensorBias, State, StateTwin
from retwin.twins.faults.actuator_faults import Fault
from retwin.update import fit_dynamics

RATE, SECONDS, ONSET = 20.0, 60.0, 20.0
NOISE = 0.01
COUNTED = "alarms", "changes", "first right", "last right"
SAME = {"torque changed": ("current: another effect",)}
"""Names of the same change of the machine."""

TANK = StateTwin(
    (State("level", "m", 0.5, 0.0, 3.0),),
    lambda x, u: x.level,
    rt.Channels(("pump",), ("V",)),
    rt.Channels(("level",), ("m",)),
    RATE,
    derivative=lambda x, u, p: (0.5 * u.pump - p.drain * x.level,),
    parameters=(Parameter("drain", "1/s", 0.05, 3.0, 0.5),),
)
MOTOR = StateTwin(
    (State("angle", "rad", 0.0, -50.0, 50.0), State("speed", "rad/s", 0.0, -20.0, 20.0)),
    lambda x, u: (x.angle, x.speed),
    rt.Channels(("current",), ("A",)),
    rt.Channels(("angle", "speed"), ("rad", "rad/s")),
    RATE,
    derivative=lambda x, u, p: (x.speed, p.torque * u.current - p.friction * x.speed),
    parameters=(
        Parameter("torque", "rad/s^2/A", 0.1, 10.0, 2.0),
        Parameter("friction", "1/s", 0.05, 5.0, 1.0),
    ),
)
REAL_TANK = replace(
    TANK,
    derivative=lambda x, u, p: (
        0.5 * u.pump - p.drain * torch.sqrt(torch.clamp(x.level, min=1e-6)),
    ),
)
REAL_MOTOR = replace(
    MOTOR,
    derivative=lambda x, u, p: (
        x.speed,
        p.torque * u.current - p.friction * x.speed - 0.2 * torch.tanh(x.speed / 0.05),
    ),
)
MACHINES: dict[str, tuple[StateTwin, StateTwin, tuple[float, float], dict[str, Fault]]] = {
    "tank": (
        TANK,
        REAL_TANK,
        (0.2, 2.0),
        {
            "drain changed": ParameterShift("drain", size=0.3),
            "pump: another effect": ActuatorGain(0, size=-0.3),
            "level: sensor offset": SensorBias(0, size=0.2),
        },
    ),
    "motor": (
        MOTOR,
        REAL_MOTOR,
        (-1.0, 1.0),
        {
            "torque changed": ParameterShift("torque", size=-0.8),
            "friction changed": ParameterShift("friction", size=0.7),
            "speed: sensor offset": SensorBias(1, size=0.4),
        },
    ),
}


def recorded(name: str, seed: int, fault: Fault | None = None) -> rt.Trajectories:
    """A record of a machine, whose parameters differ somewhat from its twin's."""
    _, twin, ends, _ = MACHINES[name]
    rng = np.random.default_rng(seed)
    levels = rng.uniform(*ends, size=(1, round(SECONDS), 1))
    commands = np.repeat(levels, round(RATE), axis=1)
    own = {each.name: 1.1 * each.start for each in twin.parameters}
    made = twin.simulate(commands, faults=[fault], seed=0, parameters=own)
    return made.replace(observed=made.observed + NOISE * rng.normal(size=made.observed.shape))


def main() -> None:
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    rows = {}
    for name, (twin, _, _, faults) in MACHINES.items():
        corrected = fit_dynamics(twin, recorded(name, 0)).twin
        healthy = rt.Trajectories.concatenate([recorded(name, i) for i in (1, 2, 3)])
        monitor = fit_monitor(corrected, healthy, "1 per month")
        causes = possible_causes(monitor.twin)
        for key, fault in faults.items():
            own = dict.fromkeys(COUNTED, 0.0)
            delays, spent = [], 0.0
            for i in range(repeats):
                day = recorded(name, 10 + i, replace(fault, onset=ONSET))
                alarms = [each for each in monitor.watch(day).alarms if each.time >= ONSET]
                if not alarms:
                    continue
                began = time.process_time()
                found = find_causes(monitor.twin, day, alarms, causes)
                spent += time.process_time() - began
                opened = [e for e in found if e.alarm.event == alarms[0].event and not e.same]
                delays.append(alarms[0].time - ONSET)
                own["alarms"] += len(alarms)
                own["changes"] += len(opened) - 1
                own["first right"] += opened[0].name in (key, *SAME.get(key, ()))
                own["last right"] += opened[-1].name in (key, *SAME.get(key, ()))
            own["delay in s"] = float(np.median(delays)) if delays else np.nan
            own["time of causes"] = spent / (repeats * (SECONDS - ONSET))
            rows[f"{name}: {key}"] = own
    record("monitor lasting", "Causes of lasting faults", rows)


if __name__ == "__main__":
    main()
