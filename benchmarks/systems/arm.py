"""The robot arm of the paper, ArmPi FPV: healthy trajectories of set A, in three folds.

From four motors' commands to the position of the gripper. Each trajectory is tested once, by
methods that are calibrated on the four of the other folds.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

import retwin as rt
from systems.system import System

FOLDS = 3


def arm(folder: Path, fold: int) -> System:
    case = rt.cases.armpi()
    assert case.recover is not None
    assert case.parametric is not None
    real = rt.load(folder / "armpi" / "real_a.mat", rate=case.twin.rate)
    real = case.recover(real[real.labels == "Healthy"], None)
    test = np.arange(len(real)) % FOLDS == fold
    return System(
        case.parametric,
        real[~test],
        {"arm": real[test]},
        "mm",
        1000.0,
        case=case,
    )


SYSTEMS = {f"arm_{fold + 1}": partial(arm, fold=fold) for fold in range(FOLDS)}
