"""Time and memory of corrected dynamics fitted to many trajectories.

    python benchmarks/dynamics_scaling.py

An oscillator with a cubic spring, 200 samples per trajectory, is calibrated from its linear twin,
with starts that are known, or with two unknown starts of each trajectory. Each row is a process of
its own on one core. Seconds are processor time, which excludes other work of the machine.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time

import numpy as np
import torch
from record import peak_memory_gb, record

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update import fit_dynamics

SAMPLES = 200
ROWS = ((100, 2), (400, 2), (900, 0), (3600, 0))
"""Numbers of trajectories, and of unknown starts of each."""
TRUTH = {"stiffness": 30.0, "damping": 0.8, "cubic": 120.0}
NOISE = 1e-3


def main() -> None:
    if len(sys.argv) > 1:
        print(json.dumps(measured(*map(int, sys.argv[1:]))))
        return
    rows = {}
    for count, starts in ROWS:
        command = [sys.executable, __file__, str(count), str(starts)]
        made = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        rows[f"{count} trajectories, {starts} unknown starts"] = json.loads(made.stdout)
    record("dynamics_scaling", "Corrected dynamics from many trajectories", rows)


def measured(count: int, starts: int) -> dict[str, float]:
    """One calibration in this process."""
    torch.set_num_threads(1)
    twin = oscillator(starts)
    real = recorded(twin, count, starts)
    began = time.process_time()
    fitted = fit_dynamics(twin.parametric().holding("cubic"), real)
    return {
        "s": time.process_time() - began,
        "GB": peak_memory_gb(),
        "RMSE (mm)": 1000 * fitted.figures["rms_after"],
        "stiffness": fitted.parameters["stiffness"],
    }


def oscillator(starts: int) -> StateTwin:
    bounds = ((-0.5, 0.5), (-3.0, 3.0)) if starts else ((None, None), (None, None))
    return StateTwin(
        (State("position", "m", 0.0, *bounds[0]), State("velocity", "m/s", 0.0, *bounds[1])),
        lambda x, u: x.position,
        rt.Channels(("force",), ("N",)),
        rt.Channels(("position",), ("m",)),
        40.0,
        derivative=lambda x, u, p: (
            x.velocity,
            u.force - p.damping * x.velocity - p.stiffness * x.position - p.cubic * x.position**3,
        ),
        parameters=(
            Parameter("stiffness", "N/m", 10.0, 100.0, 40.0),
            Parameter("damping", "N s/m", 0.05, 5.0, 0.6),
            Parameter("cubic", "N/m^3", 0.0, 500.0, 0.0),
        ),
    )


def recorded(twin: StateTwin, count: int, starts: int) -> rt.Trajectories:
    """Noisy outputs of the oscillator, excited by filtered noise."""
    rng = np.random.default_rng(0)
    kernel = np.hanning(7) / np.sqrt(np.sum(np.hanning(7) ** 2))
    white = rng.normal(size=(count, SAMPLES))
    forces = 8 * np.apply_along_axis(np.convolve, 1, white, kernel, mode="same")[..., None]
    own = {
        "start_position": rng.uniform(-0.3, 0.3, count),
        "start_velocity": rng.uniform(-1, 1, count),
    }
    made = twin.simulate(forces, seed=0, parameters=TRUTH | (own if starts else {}))
    return made.replace(observed=made.observed + NOISE * rng.normal(size=made.observed.shape))


if __name__ == "__main__":
    main()
