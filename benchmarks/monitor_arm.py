"""The live monitor on the emulated robot arm: false alarms, and trajectories to each alarm.

The twin is calibrated on 12 healthy trajectories and the monitor on 54 others, at one false alarm
in 1000 trajectories. It then watches healthy machines, and machines with a fault from their first
trajectory on: a motor that sticks at 0.49 s, as in the published data, or at any sample of the
first four fifths, after which it may have nothing left to do; and a motor whose bias is twice the
standard deviation of the offsets of a healthy one. Motor 4 turns the gripper, of which the measured
position shows least.
"""

from __future__ import annotations

import numpy as np
from record import record
from scipy.stats import beta

import retwin as rt
from retwin.diagnosis import fit_inversion
from retwin.monitor import TrajectoryMonitor, fit_trajectory_monitor
from retwin.twins.faults import ActuatorBias, Fault, Stuck

FITTED, CALIBRATED, HEALTHY = 12, 54, 300
MACHINES, TRAJECTORIES = 10, 10
ARL = "1000 trajectories"
TWICE = 2 * 3.4
"""Twice the standard deviation of the emulator's offsets, in command units."""


def main() -> None:
    case = rt.cases.armpi()
    ibg = rt.fit_surrogate(rt.generate(case.twin, case, per_class=40, seed=0), seed=0)
    healthy = made(case, FITTED, 1).replace(labels=np.repeat("Healthy", FITTED))
    rg = rt.fit_residual(ibg, healthy, case.correction, seed=0)
    diagnoser = fit_inversion(ibg, rg, healthy, case.faults)
    monitor = fit_trajectory_monitor(diagnoser, made(case, CALIBRATED, 2), ARL, causes=case.causes)
    print(monitor.promise)
    watched = monitor.watch(made(case, HEALTHY, 3))[1]
    false = len(watched.alarms)
    rows: dict[str, dict[str, float]] = {
        "healthy": {
            "trajectories": float(HEALTHY),
            "false alarms": float(false),
            "upper bound per trajectory": float(beta.ppf(0.95, false + 1, HEALTHY - false)),
            "void": float(watched.void[-1]),
        }
    }
    for motor in range(4):
        for when, onset in (("at 0.49 s", 0.49), ("at any time", (0.49, 8.0))):
            sticks = Stuck(motor, onset)
            name = f"motor {motor + 1} sticks {when}"
            rows[name] = found(monitor, case, sticks, STICKS[motor], 1)
    for motor in range(4):
        biased = ActuatorBias(motor, (TWICE - 0.1, TWICE + 0.1))
        name = f"motor {motor + 1}, bias of 2 standard deviations"
        rows[name] = found(monitor, case, biased, BIASED[motor], TRAJECTORIES)
    record("monitor arm", "Emulated arm, one false alarm in 1000 trajectories", rows)


STICKS = [{f"Motor_{i}_Stuck", f"Motor_{i}_Stuck_later"} for i in range(1, 5)]
BIASED = [
    {f"Motor_{i}_Steady_state_error", f"Motor_{i}_Steady_state_error_small"} for i in range(1, 5)
]
"""Names of the right causes."""


def made(case: rt.Case, count: int, seed: int, fault: Fault | None = None) -> rt.Trajectories:
    """Trajectories of the emulated arm."""
    commands = case.sampler.sample(count, rng=np.random.default_rng(seed))
    assert case.emulator is not None
    return case.emulator.simulate(commands, faults=[fault] * count, seed=seed)


def found(
    monitor: TrajectoryMonitor, case: rt.Case, fault: Fault, names: set[str], within: int
) -> dict[str, float]:
    """How many of the machines have an alarm within so many trajectories, and when."""
    numbers, named = [], 0
    for machine in range(MACHINES):
        alarms = monitor.watch(made(case, within, 100 + machine, fault))[1].alarms
        if alarms:
            numbers.append(alarms[0].number + 1)
            named += alarms[0].name in names
    return {
        "machines": float(MACHINES),
        "found": float(len(numbers)),
        "named": float(named),
        "median trajectories": float(np.median(numbers)) if numbers else np.nan,
        "most trajectories": float(max(numbers)) if numbers else np.nan,
    }


if __name__ == "__main__":
    main()
