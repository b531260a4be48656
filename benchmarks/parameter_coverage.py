"""What 95 % intervals of parameters hold where the twin is right, and where it is broken.

Four emulated systems, one record of 1000 samples each: a heater, a servo, a tank with a valve, a
pendulum. Their records break the twin in turn: not at all (white noise); by coloured noise
(autoregressive, 0.95, three times as large); by a term that the twin lacks (radiation, dry friction
of the servo and of the pendulum, an outflow that grows with the level); by a sensor that clips a
third of the range. The truth of a broken twin is the estimate of `rt.identify` from 100 records
together. 300 records are identified for each; targets: intervals hold 0.90 to 0.98, and where the
twin is right they are hardly wider than those of independent errors.

With `dynamics`, the intervals are those of `fit_dynamics` with terms up to second degree. The terms
depend on the range of a record, and parameters on the terms: the truth of a broken twin is the
estimate of the same equations from 30 other records.

    python benchmarks/parameter_coverage.py [RECORDS] [identify | dynamics]
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from record import record
from scipy.signal import lfilter

import retwin as rt
from retwin.evaluation.identification.parameters import uncertainty_of
from retwin.twins import State, StateTwin
from retwin.update.dynamics import Dynamics, FittedDynamics, Library, fit_dynamics
from retwin.update.dynamics.estimation import Estimation, correlation_time
from retwin.update.dynamics.linearised import Point
from retwin.update.dynamics.unknowns import state_twin_of, unknowns_of
from retwin.update.identification import LeastSquares
from retwin.workers.pools import worker_pool

RECORDS, MANY, STEPS, RATE = 300, 100, 1000, 10.0
KINDS = ("right", "coloured noise", "missing term", "clipped")
LACKING = "lacking"
"""The parameter of the term that a twin lacks: 0 in the twin."""


def heater(x, u, p):
    return (p.gain * u.command - p.loss * x.heat - p.lacking * x.heat**2,)


def servo(x, u, p):
    dry = p.lacking * torch.tanh(x.speed / 0.02)
    return x.speed, p.stiffness * (u.command - x.angle) - p.damping * x.speed - dry


def tank(x, u, p):
    level = torch.clamp(x.level, min=1e-3)
    return (p.pump * u.command - p.outflow * torch.sqrt(level) - p.lacking * level,)


def pendulum(x, u, p):
    dry = p.lacking * torch.tanh(x.speed / 0.02)
    return x.speed, p.torque * u.command - p.gravity * torch.sin(
        x.angle
    ) - p.friction * x.speed - dry


def build(
    derivative: Callable, states: str, lacking: float, low: float, high: float, **true: float
) -> tuple[rt.ParametricTwin, dict[str, float], float, tuple[float, float]]:
    """A twin whose first state is measured, the true values, and the range of commands."""
    names = states.split()
    values = [
        rt.Parameter(name, "", value / 10, 10 * value, 1.3 * value) for name, value in true.items()
    ]
    twin = StateTwin(
        [State(name, "", 1.0 if name == "level" else 0.0) for name in names],
        lambda x, u: getattr(x, names[0]),
        rt.Channels(("command",), ("",)),
        rt.Channels((names[0],), ("",)),
        RATE,
        derivative=derivative,
        parameters=(*values, rt.Parameter(LACKING, "", 0.0, 10.0, 0.0)),
    )
    return twin.parametric(), true, lacking, (low, high)


SYSTEMS = {
    "heater": build(heater, "heat", 0.02, 0.0, 2.0, gain=0.3, loss=0.1),
    "servo": build(servo, "angle speed", 1.0, -1.0, 1.0, stiffness=20.0, damping=4.0),
    "tank": build(tank, "level", 0.02, 0.5, 1.5, pump=0.2, outflow=0.15),
    "pendulum": build(
        pendulum, "angle speed", 0.3, -1.0, 1.0, torque=4.0, gravity=9.0, friction=0.8
    ),
}


@cache
def limits(name: str) -> tuple[float, float]:
    """Ends of the sensor that clips: between them are two thirds of all samples."""
    outputs = records(name, "right", MANY, 20_000).observed
    return float(np.quantile(outputs, 1 / 6)), float(np.quantile(outputs, 5 / 6))


def records(name: str, kind: str, count: int, seed: int) -> rt.Trajectories:
    """Measured records of a system, all with other commands and noise."""
    twin, true, lacking, (low, high) = SYSTEMS[name]
    rng = np.random.default_rng([seed, *name.encode(), *kind.encode()])
    commands = rng.uniform(low, high, (count, STEPS // 25, 1)).repeat(25, axis=1)
    made = twin.with_values(true | {LACKING: lacking if kind == "missing term" else 0.0})
    made = made.simulate(commands, seed=seed)
    clean = made.observed.astype(float)
    noise = 0.03 * clean.std() * rng.normal(size=clean.shape)
    if kind == "coloured noise":
        noise = lfilter([3 * np.sqrt(1 - 0.95**2)], [1, -0.95], noise, axis=1)
    outputs = clean + noise
    if kind == "clipped":
        outputs = np.clip(outputs, *limits(name))
    return made.replace(observed=outputs)


def estimated(name: str, made: rt.Trajectories) -> tuple[NDArray, NDArray, NDArray]:
    """Estimates, and the half widths of intervals by blocks and by independent errors."""
    twin, true, *_ = SYSTEMS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        before = twin.holding(LACKING)
        found = rt.identify(before, made, LeastSquares(1), seed=0)
    shown = uncertainty_of(before, found).parameters
    ends = np.array([each.interval or (-np.inf, np.inf) for each in shown])
    white = 1.96 * np.asarray(found.identifiability.white)
    return np.array([found.values[each] for each in true]), np.diff(ends)[:, 0] / 2, white


def corrected(
    name: str, kind: str, made: rt.Trajectories, others: rt.Trajectories
) -> tuple[NDArray, NDArray, NDArray]:
    """Estimates beside a discrepancy, half widths of intervals, and the truth of its equations."""
    twin, true, *_ = SYSTEMS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = fit_dynamics(
            twin.holding(LACKING), made, Dynamics(Library(2, (), False), memory=False)
        )
    ends = np.array(list(found.intervals.values()))
    limit = np.array(list(true.values()))
    if kind not in ("right", "coloured noise"):
        limit = limit_of(found, twin.holding(LACKING), others)
    return np.array(list(found.parameters.values())), np.diff(ends)[:, 0] / 2, limit


def limit_of(found: FittedDynamics, before: rt.ParametricTwin, many: rt.Trajectories) -> NDArray:
    """The parameters of the same corrected equations from many records."""
    base, free, values = state_twin_of(before)
    own, equations = len(base.parameters), found.twin.equations
    more = equations.parameters[own:]
    unknowns = unknowns_of(base, free, values).with_coefficients(more)
    shared = [*found.parameters.values(), *found.twin.values[own : own + len(more)]]
    begun = Estimation(equations, many, unknowns, many.mask, np.ones(1))
    at = begun.linearised(Point(np.array(shared), np.zeros((len(many), 0))))
    variance = correlation_time(at.residual) * begun.power(at.residual)
    return replace(begun, variance=variance).minimised(at).point.shared[: len(free)]


def study_dynamics(name: str, kind: str, count: int) -> dict[str, float]:
    """Shares of intervals of `fit_dynamics` that hold, by parameter, and their median widths."""
    others, true = records(name, kind, 30, 10_000), SYSTEMS[name][1]
    found = [corrected(name, kind, records(name, kind, 1, seed), others) for seed in range(count)]
    values, half, limit = (np.array(each) for each in zip(*found, strict=True))
    inside, widths = np.mean(np.abs(values - limit) <= half, axis=0), np.median(half, axis=0)
    return dict(zip([f"{key} holds" for key in true], inside.tolist(), strict=True)) | {
        "half width, of the value": float(np.max(widths / list(true.values())))
    }


def study(name: str, kind: str, count: int) -> dict[str, float]:
    """Shares of intervals that hold, by parameter, and the median of their relative widths."""
    true = np.array(list(SYSTEMS[name][1].values()))
    limit = true
    if kind not in ("right", "coloured noise"):
        limit = estimated(name, records(name, kind, MANY, 10_000))[0]
    inside, ratios = [], []
    for seed in range(count):
        values, half, white = estimated(name, records(name, kind, 1, seed))
        inside.append(np.abs(values - limit) <= half)
        ratios.append(half / white)
    shares = dict(zip(SYSTEMS[name][1], np.mean(inside, axis=0).tolist(), strict=True))
    return {f"{key} holds": value for key, value in shares.items()} | {
        "width over that of independent errors": float(np.median(ratios)),
        "bias by the break, of the value": float(np.max(np.abs(limit / true - 1))),
    }


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else RECORDS
    dynamics = "dynamics" in sys.argv
    run, pairs = study_dynamics if dynamics else study, list(product(SYSTEMS, KINDS))
    with worker_pool(2) as pool:
        jobs = [pool.schedule(run, (*pair, count)) for pair in pairs]
        found = {pair: job.result() for pair, job in zip(pairs, jobs, strict=True)}
    rows = {
        f"{name}, {kind}": {
            "lowest share": min(v for k, v in each.items() if k.endswith("holds")),
            "mean share": float(np.mean([v for k, v in each.items() if k.endswith("holds")])),
            **{k: v for k, v in each.items() if not k.endswith("holds")},
        }
        for (name, kind), each in found.items()
    }
    for kind in KINDS:
        shares = [
            value
            for (_, own), each in found.items()
            for key, value in each.items()
            if own == kind and key.endswith("holds")
        ]
        rows[f"all, {kind}"] = {"lowest share": min(shares), "mean share": float(np.mean(shares))}
    key = "dynamics_coverage" if dynamics else "parameter_coverage"
    record(key, f"95 % intervals of {count} records each", rows)


if __name__ == "__main__":  # worker processes are spawned
    main()
