"""The search for the noise of corrected dynamics, compared with simplices alone.

    python benchmarks/noise.py FOLDER

FOLDER has cascaded_tanks/dataBenchmark.csv and incubator/*.csv. `drive` is an emulated motor that a
twin without dry friction is fitted to, of two outputs. Of each search, with constant process noise
and then with a part in proportion to the change: calls of the filter, seconds of processor time,
the gain of the log likelihood over that of simplices, and whether the part in proportion is taken.
"Simplices" is the same search without derivatives: eight descents by Nelder and Mead from the best
of 16 points per dimension, and three from the best of these. Target: no loss beyond 0.1, in less
time.
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from record import record

import retwin as rt
from retwin.cases.styrofoam_incubator.case import measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.twins import Parameter, State, StateTwin
from retwin.update import fit_dynamics
from retwin.update.dynamics.filter.noise_search import Search, SearchSettings, Visited

WAYS = {
    "simplices": SearchSettings(climbs=(), points=16, rough=-np.inf, simplex=(1, 0.3)),
    "scoring": SearchSettings(),
}
"""Settings of the searches: simplices alone, and the default."""
FRICTION = 0.15
"""Dry friction of the emulated motor in N m."""


def motor(friction: float) -> StateTwin:
    """A direct-current motor on a load."""
    return StateTwin(
        (State("speed", "rad/s", 0.0), State("current", "A", 0.0)),
        lambda x, u: (x.speed, x.current),
        rt.Channels(("voltage",), ("V",)),
        rt.Channels(("speed", "current"), ("rad/s", "A")),
        50.0,
        derivative=lambda x, u, p: (
            (0.4 * x.current - 0.03 * x.speed - friction * torch.tanh(x.speed / 0.3)) / p.inertia,
            (u.voltage - p.resistance * x.current - 0.4 * x.speed) / 0.3,
        ),
        parameters=(
            Parameter("inertia", "kg m^2", 0.005, 0.1, 0.035),
            Parameter("resistance", "Ohm", 0.5, 5.0, 2.6),
        ),
    )


def drive() -> tuple[StateTwin, rt.Trajectories]:
    """The twin, and six emulated trajectories of 12 s."""
    rng = np.random.default_rng(0)
    voltage = np.repeat(rng.uniform(-12, 12, size=(6, 12, 1)), 50, axis=1)
    made = motor(FRICTION).simulate(voltage, seed=0)
    noise = np.array([0.2, 0.06]) * rng.normal(size=made.observed.shape)
    return motor(0.0), made.replace(observed=made.observed + noise)


def searches(twin: StateTwin, calibration: rt.Trajectories) -> list[tuple[Search, bool, Visited]]:
    """The searches of a fit, whether noise is in proportion, and what they visited."""
    found = []
    whole = Search.visit

    def kept(self: Search, constant: np.ndarray | None = None) -> Visited:
        made = whole(self, constant)
        found.append((self, constant is not None, made))
        return made

    Search.visit = kept  # type: ignore[method-assign]
    try:
        fit_dynamics(twin, calibration)
    finally:
        Search.visit = whole  # type: ignore[method-assign]
    return found


def measured(
    made: list[tuple[Search, bool, Visited]], settings: SearchSettings
) -> list[tuple[float, ...]]:
    """Calls, seconds, log likelihood, and whether the second search is decided for."""
    rows, before = [], None
    for search, proportional, _ in made:
        started = time.process_time()
        found = replace(search, settings=settings).visit(
            before.best if proportional and before else None
        )
        seconds = time.process_time() - started
        decided = float(found.decided(before)) if before else np.nan
        rows.append((len(found.points), seconds, float(found.scores.sum(axis=1).max()), decided))
        before = found
    return rows


def main() -> None:
    warnings.simplefilter("ignore")
    folder = Path(sys.argv[1])
    tanks = rt.cases.get("tanks_overflow")
    assert tanks.records is not None
    systems = {
        "tanks": (tanks.twin, tanks.records(folder / "cascaded_tanks/dataBenchmark.csv")[0]),
        "incubator": (INCUBATOR, measurements(warm_up=0)(folder / "incubator")[0]),
        "drive (emulated)": drive(),
    }
    table: dict[str, dict[str, float]] = {}
    for name, (twin, calibration) in systems.items():
        made = searches(twin, calibration)
        runs = {how: measured(made, each) for how, each in WAYS.items()}
        for place, (_, proportional, _) in enumerate(made):
            base = runs["simplices"][place][2]
            for how, rows in runs.items():
                calls, seconds, found, taken = rows[place]
                table[f"{name}, {'proportional' if proportional else 'constant'}, {how}"] = {
                    "calls": calls,
                    "s": seconds,
                    "gain": found - base,
                    "taken": taken,
                }
    record("noise", "search for the noise of corrected dynamics", table)


if __name__ == "__main__":
    main()
