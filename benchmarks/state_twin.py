"""Time of simulations by a `StateTwin`: an oscillator with a cubic spring, 40 000 samples.

Targets, on one core: one record 0.1 s, an ensemble of 100 records 5 s. The table also shows the
record with its derivatives by all parameters and starts, the record in torch (a tenth of it,
scaled), and what is spent once per process on tracing and compiling.

The same oscillator with one step per sample and a held input, when the compiled step was chosen
(two cores, one of them busy, 2026-11-22), in s:

| | once | one record | with sensitivities: 7, CasADi 5 | 100 records | installed |
|---|---|---|---|---|---|
| own C99, gcc | 0.03–0.3 | 0.002 | 0.008 | 0.46 | – |
| CasADi 3.8.2, mapaccum of SX | 0.08 | 0.025 | 0.051 | 3.8 | 277 MB |
| CasADi with its own use of gcc | 0.3 | 0.022 | | | 277 MB |
| numba 0.68, written by hand | 1.1 | 0.001 | | | 208 MB |
| the same in plain Python | – | 0.06 | | | – |
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from record import record

import retwin as rt
from retwin.compiler import compiled
from retwin.twins import Parameter, State, StateTwin

SAMPLES = 40_000
RATE = 610.35
PARAMETERS = {"stiffness": 1.9e5, "damping": 50.0, "cubic": 1e5, "gain": 1.9e5}


def derivative(x, u, p):
    spring = p.stiffness * x.position + p.cubic * x.position**3
    return x.velocity, p.gain * u.force - p.damping * x.velocity - spring


def output(x, u):
    return x.position


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """The shortest time of a few."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def main() -> None:
    torch.set_num_threads(1)
    twin = StateTwin(
        [State("position", "V"), State("velocity", "V/s")],
        output,
        rt.Channels(("force",), ("V",)),
        rt.Channels(("position",), ("V",)),
        RATE,
        derivative=derivative,
        parameters=[Parameter(name, "1", 0.0, 1e6, start) for name, start in PARAMETERS.items()],
        interpolation="spline",
        substeps=2,
    )
    rows = {"trace, once, s": seconds(lambda: twin.model.source, 1)}
    rows["compile, once, s"] = seconds(lambda: compiled(twin.model.source), 1)
    commands = np.random.default_rng(0).normal(0, 0.05, (100, SAMPLES, 1))
    one = commands[:1]
    rows["one record, s"] = seconds(lambda: twin.hidden(one))
    rows["one record, checked, as Trajectories, s"] = seconds(lambda: twin.simulate(one, seed=0))
    rows["one record with 6 sensitivities, s"] = seconds(lambda: twin.sensitivities(one))
    rows["100 records, s"] = seconds(lambda: twin.hidden(commands), 1)
    tenth = torch.as_tensor(one[:, : SAMPLES // 10])
    rows["one record in torch, s"] = 10 * seconds(lambda: twin(tenth), 1)
    record("state_twin", "StateTwin, 40 000 samples of two Runge-Kutta steps", rows)


if __name__ == "__main__":
    main()
