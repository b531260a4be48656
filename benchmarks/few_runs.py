"""Scores of classifiers and of inversion that are calibrated on few healthy trajectories.

The data are one real set (set A, in `RETWIN_DATA`), in three folds of 54 trajectories; a fold has
four healthy calibration trajectories, of which every subset of one, two and four calibrates in
turn. `IBG + RG` trains the study's CNN on the corrected twin in command space, `inversion` needs no
training. All test trajectories of the fold are diagnosed: macro-F1 is that of all classes, recall
that of the healthy ones, each the mean over subsets and folds, with the lowest and the highest mean
of a fold.
"""

from __future__ import annotations

import itertools
import os
import warnings
from pathlib import Path

import numpy as np
import torch
from record import record
from rich.progress import track

import retwin as rt
from retwin.data.segments import Segments
from retwin.scores.classification import score

SIZES = (1, 2, 4)
FOLDS = 3


def main() -> None:
    folder = os.environ.get("RETWIN_DATA")
    if not folder:
        print("few_runs: set RETWIN_DATA to the folder of the public data")
        return
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", message="calibration: . trajectories to calibrate on")
    case, plan = rt.cases.armpi(), rt.StudyPlan()
    twin = rt.load(Path(folder) / "armpi" / "sim.mat", case=case)
    real = rt.load(Path(folder) / "armpi" / "real_a.mat", case=case)
    surrogate = rt.fit_surrogate(twin, case.network, seed=0, training=case.training)
    found: dict[tuple[str, int, int], list[tuple[float, float]]] = {}
    for fold, (calibration, test) in enumerate(real.folds(FOLDS, seed=0)):
        healthy, tested = real[calibration].with_label("Healthy"), real[test]
        truth = np.array([case.classes.index(label) for label in tested.labels])
        segments = Segments.from_commands(real[calibration].commands)
        onsets = np.where(segments.valid, segments.start / real.rate, np.nan)
        subsets = [
            list(each) for k in SIZES for each in itertools.combinations(range(len(healthy)), k)
        ]
        for seed, subset in enumerate(track(subsets, f"fold {fold + 1}")):
            used = healthy[subset]
            residual = rt.fit_residual(
                surrogate, used, case.correction, case.density, seed=seed, twin=case.twin
            )
            corrected = rt.CorrectedTwin(surrogate, residual)
            size = plan.generated(case)
            made = rt.generate(corrected, case, per_class=size, seed=seed, onsets=onsets)
            diagnosers = {
                "IBG + RG": rt.fit_diagnoser(
                    made,
                    plan.classifier_config,
                    training=plan.training,
                    seed=seed,
                    classes=case.classes,
                    rate=case.sensor_rate,
                ),
                "inversion": rt.fit_inversion(
                    surrogate, residual, used, case.faults, twin=case.twin
                ),
            }
            for name, diagnoser in diagnosers.items():
                scores = score(truth, diagnoser.predict_proba(tested), case.classes)
                found.setdefault((name, len(subset), fold), []).append(
                    (scores.macro_f1, scores.healthy_recall)
                )
    rows = {}
    for name, k in itertools.product(("IBG + RG", "inversion"), SIZES):
        folds = np.array([np.mean(found[name, k, fold], axis=0) for fold in range(FOLDS)])
        rows[f"{name}, {k} healthy"] = {
            f"{metric}, {of}": float(values)
            for column, metric in enumerate(("macro-F1", "recall"))
            for of, values in (
                ("mean", folds[:, column].mean()),
                ("lowest", folds[:, column].min()),
                ("highest", folds[:, column].max()),
            )
        }
    record("few_runs", "set A, every subset of the healthy calibration trajectories", rows)


if __name__ == "__main__":
    main()
