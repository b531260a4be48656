"""Agreement of the built-in twins of the arm with the published one, and their speed.

Agreement is with the recorded Simscape twin (needs RETWIN_DATA; only the servos' stiffness, damping
and delay are fitted). Targets for the MuJoCo arm: healthy paths within 0.5 mm RMS per axis over 400
trajectories, steady parts with a biased actuator within 1.0 mm RMS, steady parts with a stuck joint
within 2.0 mm RMS. Speed is that of 3600 trajectories of 10 s at several integration steps, compared
with the kinematics in closed form.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import record

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, ArmPiTwin

STEPS = (0.001, 0.002, 0.005, 0.01)
SETTLED = 50
"""Samples at the end of a segment that are its steady part."""


def steady_parts(trajectories: rt.Trajectories) -> NDArray:
    """Sample numbers (n, M, SETTLED) of the steady part of every segment."""
    stop = rt.Segments.from_commands(trajectories.commands).stop.astype(int)
    return stop[..., None] - 1 - np.arange(SETTLED)


def biases(published: rt.Trajectories, actuator: int) -> NDArray:
    """The bias (n, M) of one motor, in units, that explains the end of each segment."""
    each, at = np.arange(len(published))[:, None], steady_parts(published)[:, :, 0]
    reference = published.commands[each, at].astype(float)
    measured = published.observed[each, at]
    bias = np.zeros(at.shape)
    for _ in range(30):
        trial = reference.copy()
        trial[..., actuator] += bias
        jacobian = KINEMATIC.arm.jacobian(KINEMATIC.angles(trial))[..., actuator] * KINEMATIC.scale
        residual = measured - KINEMATIC.position(trial)
        bias += (jacobian * residual).sum(axis=-1) / ((jacobian**2).sum(axis=-1) + 1e-12)
        bias = np.clip(bias, -60, 60)
    return bias


def rms_mm(difference: NDArray, axis: tuple[int, ...] | None = None) -> NDArray:
    """RMS of every axis; with `axis` None, of the distance."""
    square = np.square(difference, dtype=float)
    return 1e3 * np.sqrt(square.sum(axis=-1).mean() if axis is None else square.mean(axis=axis))


def agreement(published: rt.Trajectories, twin: rt.Twin) -> dict[str, float]:
    healthy = published.with_label("Healthy")
    made = twin.simulate(healthy.commands, seed=0)
    axes = rms_mm(made.observed - healthy.observed, (0, 1))
    rows = {f"healthy paths, {name} (mm RMS)": v for name, v in zip("xyz", axes, strict=True)}
    for kind in ("Steady_state_error", "Stuck"):
        differences = []
        for actuator in range(4):
            those = published.with_label(f"Motor_{actuator + 1}_{kind}")
            if kind == "Stuck":
                faults: list[rt.Fault | None] = [rt.Stuck(actuator)] * len(those)
            else:
                found = biases(those, actuator)
                faults = [rt.ActuatorBias(actuator, bias=tuple(b)) for b in found.tolist()]
            made = twin.simulate(those.commands, faults=faults, seed=0)
            each, at = np.arange(len(those))[:, None, None], steady_parts(those)
            differences.append(made.observed[each, at] - those.observed[each, at])
        every = np.concatenate(differences)
        rows[f"{kind}, steady parts, distance (mm RMS)"] = float(rms_mm(every))
        rows[f"{kind}, steady parts, worst axis (mm RMS)"] = float(rms_mm(every, (0, 1, 2)).max())
    return rows


def speed(twin: rt.Twin, commands: NDArray, threads: int) -> dict[str, float]:
    started = time.perf_counter()
    twin.simulate(commands, seed=0)
    took = time.perf_counter() - started
    seconds = commands.shape[1] / twin.rate
    return {
        "seconds": took,
        "trajectories per s": len(commands) / took,
        "threads": threads,
        "multiple of real time": len(commands) * seconds / took,
    }


def main() -> None:
    case = rt.cases.armpi()
    commands = case.sampler.sample(3600, rng=np.random.default_rng(0))
    rows = {"closed-form kinematics with servo lag": speed(KINEMATIC, commands, 1)}
    cores = os.cpu_count() or 1
    for step in STEPS:
        rows[f"MuJoCo, step {1e3 * step:g} ms"] = speed(ArmPiTwin(step=step), commands, cores)
    record("twins_speed", "3600 trajectories of 10 s at 100 Hz", rows)
    folder = os.environ.get("RETWIN_DATA")
    if not folder:
        print("twins: set RETWIN_DATA to the folder of the public data for the agreement")
        return
    published = rt.load(Path(folder) / "armpi" / "sim.mat", case=case)
    columns = {"MuJoCo": agreement(published, ArmPiTwin())}
    columns["closed form"] = agreement(published, KINEMATIC)
    record(
        "twins",
        "difference from the published twin",
        {what: {name: rows[what] for name, rows in columns.items()} for what in columns["MuJoCo"]},
    )


if __name__ == "__main__":
    main()
