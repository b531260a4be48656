"""Time of corrected dynamics on two emulated systems: a fit with many terms, and a diagnosis.

    python benchmarks/dynamics_speed.py

A heat exchanger of six states, three commands and two outputs, three records of 1000 s at 1 Hz,
whose twin has other powers of the flows and no losses: `fit_dynamics` with the default library,
which has 296 terms at most, and unknown starts. A motor with friction, 24 records of 500 samples,
four each of six classes: `fit_inversion` after a fit to six healthy ones. Seconds are processor
time of one thread, the C compiler's included, with nothing compiled before.
"""

from __future__ import annotations

import os
import tempfile
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from record import record

import retwin as rt
from retwin.twins import (
    ActuatorGain,
    Parameter,
    ParameterShift,
    SensorBias,
    SensorFreeze,
    State,
    StateTwin,
    draw_faults,
    faulty_commands,
)
from retwin.twins.faults.system_faults import measured_with
from retwin.update import fit_dynamics

SEEDS, KNOWN, EACH = (0, 1), 6, 4
OPEN = {"onset": (1.0, 4.0)}
FAULTS: dict[str, rt.Fault | None] = {
    "Healthy": None,
    "friction": ParameterShift("friction", size=(0.002, 0.02), **OPEN),
    "resistance": ParameterShift("resistance", size=(0.2, 2.0), **OPEN),
    "biased speed": SensorBias(0, size=(1.0, 6.0), **OPEN),
    "frozen current": SensorFreeze(1, **OPEN),
    "weak supply": ActuatorGain(0, size=(-0.4, -0.1), **OPEN),
}


def main() -> None:
    torch.set_num_threads(1)
    columns = {}
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        for seed in SEEDS:
            columns[f"seed {seed}"] = fitted(seed) | diagnosed(seed)
    rows = {
        what: {name: each[what] for name, each in columns.items()} for what in columns["seed 0"]
    }
    record("dynamics_speed", "Time of corrected dynamics", rows)


def processor_time() -> float:
    """Seconds of this process and of the compilers that it has run."""
    now = os.times()
    return now.user + now.system + now.children_user + now.children_system


def fitted(seed: int) -> dict[str, float]:
    """A fit to records of the heat exchanger."""
    made = exchanger_records(seed)
    began = processor_time()
    found = fit_dynamics(exchanger(1.0, (0.05, 0.05, 0.05), 0.0), made)
    return {
        "fit of the heat exchanger (s)": processor_time() - began,
        "its held-out error (K)": found.figures["held_out"],
        "its held-out error at edges (K)": found.figures["held_out_edges"],
        "its terms": float(len(found.terms)),
        **{f"its parameter {name} (1/s)": value for name, value in found.parameters.items()},
    }


def diagnosed(seed: int) -> dict[str, float]:
    """A diagnosis of records of the motor."""
    made = motor_records(seed)
    found = fit_dynamics(motor(0.0, (0.01, 0.01, 1.0, 0.1)), made[:KNOWN])
    diagnoser = rt.fit_inversion(found.twin, None, None, FAULTS)
    began = processor_time()
    probabilities = diagnoser.diagnose(made[KNOWN:]).probabilities
    best = np.array(diagnoser.classes)[probabilities.argmax(axis=1)]
    return {
        "diagnosis of 24 records of the motor (s)": processor_time() - began,
        "share that is right": float(np.mean(best == made.labels[KNOWN:])),
    }


def exchanger(power: float, start: tuple[float, float, float], loss: float) -> StateTwin:
    """Two streams in opposite directions with two cells each, and the walls between them."""

    def derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        hot, cold = p.hot * u.hot_flow**power, p.cold * u.cold_flow**power
        return (
            u.hot_flow / 20 * (u.hot_inlet - x.hot1) - hot * (x.hot1 - x.wall1),
            u.hot_flow / 20 * (x.hot1 - x.hot2) - hot * (x.hot2 - x.wall2),
            u.cold_flow / 25 * (15.0 - x.cold1) + cold * (x.wall2 - x.cold1),
            u.cold_flow / 25 * (x.cold1 - x.cold2) + cold * (x.wall1 - x.cold2),
            p.wall * (x.hot1 - 2 * x.wall1 + x.cold2) - loss * (x.wall1 - 20.0),
            p.wall * (x.hot2 - 2 * x.wall2 + x.cold1) - loss * (x.wall2 - 20.0),
        )

    states = ("hot1", "hot2", "cold1", "cold2", "wall1", "wall2")
    values = zip(("hot", "cold", "wall"), start, strict=True)
    return StateTwin(
        tuple(State(name, "degC", 30.0, low=5.0, high=90.0) for name in states),
        lambda x, u: (x.hot2, x.cold2),
        rt.Channels(("hot_flow", "cold_flow", "hot_inlet"), ("l/s", "l/s", "degC")),
        rt.Channels(("hot_outlet", "cold_outlet"), ("degC", "degC")),
        1.0,
        derivative=derivative,
        parameters=tuple(Parameter(name, "1/s", 1e-3, 1.0, start=value) for name, value in values),
    )


def exchanger_records(seed: int, count: int = 3, samples: int = 1000) -> rt.Trajectories:
    """Records of a real heat exchanger, with process and measurement noise."""
    real, rng = exchanger(0.8, (0.06, 0.045, 0.06), 0.004), np.random.default_rng(seed)

    def held(low: float, high: float, period: int) -> NDArray:
        levels = rng.uniform(low, high, size=(count, -(-samples // period)))
        return np.repeat(levels, period, axis=1)[:, :samples]

    commands = np.stack([held(0.3, 1.5, 60), held(0.3, 1.5, 80), held(50, 80, 150)], axis=2)
    starts = {f"start_{each.name}": rng.uniform(25, 35, count) for each in real.states}
    kicks = 0.02 * rng.normal(size=(count, samples, len(real.states)))
    outputs = real.steps().run(commands, real.values(starts, count), kicks)[0]
    return measured(
        real, commands, outputs + 0.1 * rng.normal(size=outputs.shape), ["Healthy"] * count
    )


def motor(friction: float, start: tuple[float, float, float, float]) -> StateTwin:
    """A motor with viscous friction and with dry friction of that torque in N m."""

    def derivative(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
        dry = friction * torch.tanh(x.speed / 2)
        torque = p.constant * x.current - p.friction * x.speed - dry
        voltage = u.voltage - p.resistance * x.current - p.constant * x.speed
        return torque / p.inertia, voltage / 0.02

    names = ("inertia", "friction", "resistance", "constant")
    units, ends = (
        ("kg m^2", "N m s", "ohm", "V s"),
        ((1e-3, 0.1), (-0.1, 0.1), (0.1, 10), (0.01, 1)),
    )
    values = zip(names, units, ends, start, strict=True)
    return StateTwin(
        (State("speed", "rad/s", 0.0), State("current", "A", 0.0)),
        lambda x, u: (x.speed, x.current),
        rt.Channels(("voltage",), ("V",)),
        rt.Channels(("speed", "current"), ("rad/s", "A")),
        100.0,
        derivative=derivative,
        parameters=tuple(Parameter(n, unit, *own, start=v) for n, unit, own, v in values),
        substeps=2,
    )


def motor_records(seed: int, samples: int = 500) -> rt.Trajectories:
    """Records of a real motor, healthy ones first."""
    real, rng = motor(0.03, (0.012, 0.008, 1.2, 0.11)), np.random.default_rng(seed)
    labels = ["Healthy"] * KNOWN + [name for name in FAULTS for _ in range(EACH)]
    count = len(labels)
    commands = np.repeat(rng.uniform(-8, 8, size=(count, 10)), samples // 10, axis=1)[..., None]
    segments = rt.Segments.from_commands(commands)
    faults = draw_faults([FAULTS[name] for name in labels], segments, seed, rate=real.rate)
    kicks = np.array([0.05, 0.005]) * rng.normal(size=(count, samples, 2))
    effective = faulty_commands(commands, faults, segments, rate=real.rate)
    changes = real.changes(faults, samples)
    outputs = real.steps().run(effective, real.values({}, count), kicks, changes)[0]
    outputs = outputs + np.array([0.3, 0.03]) * rng.normal(size=outputs.shape)
    return measured(real, commands, measured_with(outputs, faults, real.rate), labels)


def measured(
    real: StateTwin, commands: NDArray, outputs: NDArray, labels: list[str]
) -> rt.Trajectories:
    """Emulated records."""
    return rt.Trajectories(
        commands=commands,
        nominal=np.zeros_like(outputs),
        observed=outputs,
        labels=np.array(labels),
        rate=real.rate,
        inputs=real.inputs,
        outputs=real.outputs,
        emulated=True,
    )


if __name__ == "__main__":
    main()
