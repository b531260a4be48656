"""The live monitor on the emulated robot arm: false alarms, and trajectories to each alarm.

The twin is calibrated on 12 healthy trajectories and the monitor on 54 others, at one false alarm
in 1000 trajectories. It then watches healthy machines, and machines with a fault from their first
trajectory on: a motor that sticks at 0.49 s, as in the published data, or at any sample of the
first four fifths, after which it may have nothing left to do; and a motor whose bias is twice the
standard deviation of the offsets of a healthy one. Motor 4 turns the gripper, of which the measured
position shows least.

Inverting a trajectory under all causes takes seconds, and there are up to 800. With a folder as the
argument, everything that is done is kept there, so that an interrupted run continues. Machines are
shared among as many processes as there are cores.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from record import record
from scipy.stats import beta

import retwin as rt
from retwin.diagnosis import fit_inversion
from retwin.monitor import TrajectoryMonitor, TrajectoryState, fit_trajectory_monitor
from retwin.serialisation.files import write_atomically
from retwin.twins.faults.actuator_faults import ActuatorBias, Fault, Stuck

FITTED, CALIBRATED, HEALTHY = 12, 54, 300
MACHINES, TRAJECTORIES = 10, 10
PART = 10
"""Healthy trajectories after which the state is kept."""
ARL = "1000 trajectories"
TWICE = 2 * 3.4
"""Twice the standard deviation of the emulator's offsets, in command units."""


@dataclass(frozen=True)
class Watched:
    """What is watched for a row of the table: machines of so many trajectories with a fault."""

    name: str
    fault: Fault
    causes: frozenset[str]
    trajectories: int


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else temporary)
        fit(folder / "monitor")
        print(loaded(folder).promise, flush=True)
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(mp_context=context) as pool:
            all_healthy = pool.submit(healthy, folder)
            machines = {
                each.name: [pool.submit(one, each, i, folder) for i in range(MACHINES)]
                for each in watched()
            }
            rows = {
                each.name: row(each, [made.result() for made in machines[each.name]])
                for each in watched()
            }
            rows = {"healthy": all_healthy.result()} | rows
    record("monitor arm", "Emulated arm, one false alarm in 1000 trajectories", rows)


def watched() -> Iterator[Watched]:
    """What is watched besides the healthy machine."""
    for motor in range(4):
        sticks = frozenset({f"Motor_{motor + 1}_Stuck", f"Motor_{motor + 1}_Stuck_later"})
        for when, onset in (("at 0.49 s", 0.49), ("at any time", (0.49, 8.0))):
            yield Watched(f"motor {motor + 1} sticks {when}", Stuck(motor, onset), sticks, 1)
    for motor in range(4):
        bias = f"Motor_{motor + 1}_Steady_state_error"
        yield Watched(
            f"motor {motor + 1}, bias of 2 standard deviations",
            ActuatorBias(motor, (TWICE - 0.1, TWICE + 0.1)),
            frozenset({bias, f"{bias}_small"}),
            TRAJECTORIES,
        )


def fit(folder: Path) -> None:
    """Fit the monitor, once."""
    if folder.exists():
        return
    case = rt.cases.armpi()
    ibg = rt.fit_surrogate(rt.generate(case.twin, case, per_class=40, seed=0), seed=0)
    labelled = made(case, FITTED, 1).replace(labels=np.repeat("Healthy", FITTED))
    rg = rt.fit_residual(ibg, labelled, case.correction, seed=0)
    diagnoser = fit_inversion(ibg, rg, labelled, case.faults)
    calibration = made(case, CALIBRATED, 2)
    fit_trajectory_monitor(diagnoser, calibration, ARL, causes=case.causes).save(folder)


@cache
def loaded(folder: Path) -> TrajectoryMonitor:
    """The monitor, once per process."""
    return TrajectoryMonitor.load(folder / "monitor")


def made(case: rt.Case, count: int, seed: int, fault: Fault | None = None) -> rt.Trajectories:
    """Trajectories of the emulated arm."""
    commands = case.sampler.sample(count, rng=np.random.default_rng(seed))
    assert case.emulator is not None
    return case.emulator.simulate(commands, faults=[fault] * count, seed=seed)


def healthy(folder: Path) -> dict[str, float]:
    """One healthy machine over all its trajectories, part by part."""
    given, alarms, void = made(rt.cases.armpi(), HEALTHY, 3), 0, False
    state, largest = loaded(folder).start(), 0.0
    for first in range(0, HEALTHY, PART):
        kept = folder / "healthy" / f"{first}.npz"
        if not kept.exists():
            state, seen = loaded(folder).watch(given[first : first + PART], state)
            about = {"alarms": len(seen.alarms), "void": seen.void[-1]}
            keep(kept, {**state.arrays(), **about, "largest": seen.evidence.max()})
        with np.load(kept) as arrays:
            state = TrajectoryState.of_arrays(arrays)
            alarms, void = alarms + int(arrays["alarms"]), bool(arrays["void"])
            largest = max(largest, float(arrays["largest"]))
    return {
        "trajectories": float(HEALTHY),
        "false alarms": float(alarms),
        "upper bound per trajectory": float(beta.ppf(0.95, alarms + 1, HEALTHY - alarms)),
        "largest evidence": largest,
        "void": float(void),
    }


def one(given: Watched, machine: int, folder: Path) -> dict[str, Any]:
    """The first alarm of one machine, see `first_alarm`."""
    kept = folder / given.name / f"{machine}.json"
    if not kept.exists():
        work = made(rt.cases.armpi(), given.trajectories, 100 + machine, given.fault)
        keep(kept, first_alarm(loaded(folder), work))
    alarm: dict[str, Any] = json.loads(kept.read_text("utf-8"))
    return alarm


def row(given: Watched, alarms: list[dict[str, Any]]) -> dict[str, float]:
    """How many of the machines have an alarm, and when."""
    found = [each for each in alarms if each["number"] is not None]
    numbers = [each["number"] + 1 for each in found]
    return {
        "machines": float(MACHINES),
        "found": float(len(found)),
        "named": float(sum(each["name"] in given.causes for each in found)),
        "median trajectories": float(np.median(numbers)) if numbers else np.nan,
        "most trajectories": float(max(numbers)) if numbers else np.nan,
    }


def first_alarm(monitor: TrajectoryMonitor, given: rt.Trajectories) -> dict[str, Any]:
    """The first alarm of a machine, with the evidence until then; later ones do not count."""
    state, evidence = monitor.start(), []
    for number in range(len(given)):
        state, seen = monitor.watch(given[[number]], state)
        evidence.append(float(seen.evidence[0]))
        if seen.alarms:
            return {"number": number, "name": seen.alarms[0].name, "evidence": evidence}
    return {"number": None, "name": None, "evidence": evidence}


def keep(path: Path, what: dict[str, Any]) -> None:
    """Write arrays or JSON, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as part:
        if path.suffix == ".npz":
            with part.open("wb") as file:
                np.savez(file, **what)
        else:
            part.write_text(json.dumps(what), encoding="utf-8")


if __name__ == "__main__":
    main()
