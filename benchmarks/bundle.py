"""Size, latency and accuracy of a bundle, and the detection rate of its guard.

The bundle has a corrected twin of the arm in command space, a CNN and a guard. They are calibrated
on the healthy trajectories of a calibration part and tested on the other ones: of the emulated
robot, and with RETWIN_DATA of set A, in 3 folds with disjoint calibration and test parts. Each test
trajectory is corrupted in several ways, of which the guard's energy learns from two only: outputs
of another trajectory and random walks. Targets: graphs within 1e-5 of torch, a diagnosis in 5 ms
(p99, one core), 5 MB, AUROC of 0.95 on shuffled, scaled and foreign trajectories, at most 5 % false
flags. Latency is measured as wall-clock time, which includes the machine's other work, and as
processor time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from record import record
from sklearn.metrics import roc_auc_score

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC
from retwin.deploy.bundle.bundle import Bundle
from retwin.deploy.bundle.guard import Guard, fit_guard
from retwin.deploy.bundle.verdicts import OUTSIDE, Prediction
from retwin.deploy.onnx.export import export_onnx
from retwin.deploy.onnx.portable import Portable

CALLS = 500
FOLDS = 3
Corruption = Callable[[rt.Trajectories, np.random.Generator], np.ndarray]


def main() -> None:
    torch.set_num_threads(1)
    case = rt.cases.armpi()
    ibg = rt.fit_surrogate(rt.generate(case.twin, case, per_class=40, seed=0), seed=0)
    emulated = rt.generate(case.emulator, case, per_class=12, seed=61)
    sets = {"emulated": emulated}
    if "RETWIN_DATA" in os.environ:
        sets["set A"] = rt.load(Path(os.environ["RETWIN_DATA"], "armpi", "real_a.mat"), case=case)
    columns = {}
    for name, real in sets.items():
        guarded = []
        for fold, (calibration, test) in enumerate(real.folds(FOLDS, seed=0)):
            rg = rt.fit_residual(ibg, real[calibration], case.correction, seed=fold)
            twin = rt.CorrectedTwin(ibg, rg, case=case.name)
            guard = fit_guard(twin, case, real[calibration], seed=fold)
            guarded.append((guard, real[test]))
        columns[name] = flags(ibg, guarded)
    record("bundle_guard", "the guard, per kind of trajectory", transposed(columns))
    cnn = rt.fit_diagnoser(
        rt.generate(twin, case, per_class=40, seed=1), seed=0, classes=case.classes
    )
    bundle = Bundle.of(case, twin, guard, cnn, data=[emulated])
    record("bundle", "a bundle: size, exactness and speed", portability(bundle, emulated))


def transposed(columns: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """The same figures with a row per figure and a column per set."""
    rows = next(iter(columns.values()))
    return {row: {name: each[row] for name, each in columns.items()} for row in rows}


def flags(ibg: rt.Surrogate, guarded: list[tuple[Guard, rt.Trajectories]]) -> dict[str, float]:
    """False flags on the test parts; AUROC and share of flags for each kind of corruption."""
    good = [guard.assess(ibg, test) for guard, test in guarded]
    clean = np.concatenate([each.max_score for each in good])
    rows = {
        "trajectories": float(len(clean)),
        "false flags": float((clean > 1).mean()),
        "false flags, outside": float((clean > OUTSIDE).mean()),
    }
    for name, corrupt in KINDS.items():
        rng = np.random.default_rng(0)
        corrupted = [
            guard.assess(ibg, test.replace(observed=corrupt(test, rng).astype(np.float32)))
            for guard, test in guarded
        ]
        scores = np.concatenate([each.max_score for each in corrupted])
        truth = np.repeat([0, 1], [len(clean), len(scores)])
        rows[f"AUROC, {name}"] = float(roc_auc_score(truth, np.concatenate([clean, scores])))
        rows[f"flagged, {name}"] = float((scores > 1).mean())
    return rows


def portability(bundle: Bundle, trajectories: rt.Trajectories) -> dict[str, float]:
    """Size on disk, difference of every graph from torch, and time of one diagnosis."""
    with TemporaryDirectory() as scratch:
        whole, onnx = Path(scratch, "bundle"), Path(scratch, "onnx")
        bundle.save(whole)
        started = time.perf_counter()
        parity = export_onnx(bundle, onnx)
        rows = {"export (s)": time.perf_counter() - started}
        for name, folder in (("bundle", whole), ("export", onnx)):
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
            rows[f"{name} (MB)"] = size / 1e6
        rows |= {f"{name}: difference from torch": value for name, value in parity.items()}
        started = time.perf_counter()
        portable = Portable.load(onnx)
        rows["load the export (s)"] = time.perf_counter() - started
        for name, predict in (("onnxruntime", portable.predict), ("torch", bundle.predict)):
            rows |= {f"{name}: {what}": ms for what, ms in latency(predict, trajectories).items()}
    return rows


def latency(
    predict: Callable[[rt.Trajectories], Prediction], trajectories: rt.Trajectories
) -> dict[str, float]:
    """Milliseconds of one diagnosis with its verdict, one trajectory at a time."""
    ones = [trajectories[i : i + 1] for i in range(len(trajectories))]
    for one in ones[:20]:
        predict(one)
    taken = np.empty((CALLS, 2))
    for i in range(CALLS):
        begin = np.array([time.perf_counter(), time.process_time()])
        predict(ones[i % len(ones)])
        taken[i] = np.array([time.perf_counter(), time.process_time()]) - begin
    return {
        f"{clock}, p{share} (ms)": float(np.percentile(1e3 * taken[:, column], share))
        for column, clock in enumerate(("wall clock", "processor"))
        for share in (50, 99)
    }


def interpolated(samples: np.ndarray, steps: int) -> np.ndarray:
    """Sensor samples (n, R, d), linearly interpolated to a record (n, steps, d)."""
    place = np.linspace(0, samples.shape[1] - 1, steps)
    below = np.minimum(place.astype(int), samples.shape[1] - 2)
    share = (place - below)[:, None]
    return (1 - share) * samples[:, below] + share * samples[:, below + 1]


def in_time(real: rt.Trajectories, rng: np.random.Generator) -> np.ndarray:
    samples = real.observed[:, ::10]
    return interpolated(rng.permuted(samples, axis=1), real.steps)


def in_blocks(real: rt.Trajectories, rng: np.random.Generator) -> np.ndarray:
    blocks = np.split(real.observed[:, ::10], 5, axis=1)
    return interpolated(np.concatenate([blocks[i] for i in (2, 4, 1, 0, 3)], axis=1), real.steps)


def walking(real: rt.Trajectories, rng: np.random.Generator) -> np.ndarray:
    samples = real.observed[:, ::10]
    walk = rng.normal(size=samples.shape).cumsum(axis=1)
    walk *= samples.std(axis=(0, 1)) / walk.std(axis=(0, 1))
    return interpolated(samples.mean(axis=(0, 1)) + walk, real.steps)


def swinging(real: rt.Trajectories, rng: np.random.Generator) -> np.ndarray:
    shape = len(real), 1, real.observed.shape[2]
    time = np.arange(real.steps)[None, :, None] / real.rate
    swing = np.sin(2 * np.pi * (rng.uniform(0.2, 1.0, shape) * time + rng.uniform(0, 1, shape)))
    return real.observed.mean(axis=(0, 1)) + swing * real.observed.std(axis=(0, 1))


def other_arm(real: rt.Trajectories, rng: np.random.Generator) -> np.ndarray:
    """Outputs of an arm with links that are a fifth longer, for the same commands."""
    links = tuple(1.2 * link for link in KINEMATIC.arm.links)
    arm = replace(KINEMATIC, arm=replace(KINEMATIC.arm, links=links))
    return arm.position(real.commands.astype(np.float64))


KINDS: dict[str, Corruption] = {
    "shuffled: samples": in_time,
    "shuffled: blocks of 2 s": in_blocks,
    "shuffled: outputs of another trajectory": lambda real, _: np.roll(real.observed, 1, axis=0),
    "shuffled: channels": lambda real, _: np.roll(real.observed, 1, axis=2),
    "reversed": lambda real, _: real.observed[:, ::-1],
    **{
        f"scaled by {factor}": lambda real, _, factor=factor: factor * real.observed
        for factor in (0.5, 0.8, 0.9, 1.1, 1.25, 2.0)
    },
    "foreign: random walk": walking,
    "foreign: sines": swinging,
    "foreign: longer links": other_arm,
    "mirrored": lambda real, _: real.observed * np.array([-1, 1, 1]),
    "at rest": lambda real, _: np.broadcast_to(real.observed[:, :1], real.observed.shape),
}


if __name__ == "__main__":
    main()
