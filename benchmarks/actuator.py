"""Time per step of the exported actuators of 4096 robots with four joints, in TorchScript.

Target: at most 1 ms on two cores. One thread is enough: run it with OMP_NUM_THREADS=1. The twin is
that of the emulated arm, with its delays, offsets and missed segments; in each step every robot
gets new commands.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from record import record

import retwin as rt

ENVIRONMENTS = 4096
STEPS = 500


def exported(folder: Path) -> rt.deploy.ExportedActuator:
    case = rt.cases.armpi()
    simulated = rt.generate(case.twin, case, per_class=10, seed=0)
    commands = case.sampler.sample(10, rng=np.random.default_rng(1))
    real = case.emulator.simulate(commands, seed=1)
    surrogate = rt.fit_surrogate(simulated, seed=0)
    twin = rt.CorrectedTwin(surrogate, rt.fit_residual(surrogate, real, case.correction, seed=0))
    return rt.export_actuator(twin, folder, commands=commands, seed=0, onnx=False)


def ms_per_step(file: Path) -> np.ndarray:
    module = torch.jit.load(file)
    generator = torch.Generator().manual_seed(0)
    size = (ENVIRONMENTS, 4)
    rows = torch.randint(module.draws(), (ENVIRONMENTS,), generator=generator)
    sent = [1000 * torch.rand(size, generator=generator) for _ in range(16)]
    times = []
    with torch.inference_mode():
        module.start(sent[0], rows)
        for k in range(50 + STEPS):
            started = time.perf_counter()
            module(sent[k % 16], torch.rand(size, generator=generator))
            times.append(1000 * (time.perf_counter() - started))
    return np.array(times[50:])


def main() -> None:
    warnings.simplefilter("ignore", DeprecationWarning)  # TorchScript, which the tools read
    with tempfile.TemporaryDirectory() as folder:
        made = exported(Path(folder, "actuator"))
        times = ms_per_step(made.folder / "actuator.pt")
    median, high = np.quantile(times, [0.5, 0.95])
    rows = {"TorchScript": {"median (ms)": float(median), "95 % below (ms)": float(high)}}
    record("actuator", f"a step of {ENVIRONMENTS} robots with 4 joints, ms", rows)


if __name__ == "__main__":
    main()
