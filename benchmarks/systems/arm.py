"""The robot arm of the paper, ArmPi FPV: healthy trajectories of set A, in three folds.

From four motors' commands to the position of the gripper. Each trajectory is tested once, by
methods that are calibrated on the four of the other folds.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC
from systems.system import System

FOLDS = 3


class Kinematics:
    """The arm's forward kinematics in torch: what corrections per segment need of a twin."""

    memoryless = True
    inputs, outputs, rate = KINEMATIC.inputs, KINEMATIC.outputs, KINEMATIC.rate
    fitted = None

    def __call__(self, commands: torch.Tensor) -> torch.Tensor:
        """Positions (n, T, 3) for commands (n, T, 4)."""
        angles = (commands - KINEMATIC.centre) * KINEMATIC.scale
        links = torch.tensor(KINEMATIC.arm.links, dtype=commands.dtype)
        yaw, pitch = angles[..., 0], angles[..., 1:].cumsum(dim=-1)
        radius, height = pitch.sin() @ links, pitch.cos() @ links + KINEMATIC.arm.base
        return torch.stack([yaw.sin() * radius, -yaw.cos() * radius, height], dim=-1)

    def predict(self, commands: NDArray, progress: object = None) -> NDArray:
        """The same for arrays."""
        return KINEMATIC.position(np.asarray(commands, np.float64)).astype(np.float32)


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
        corrections={"delay/offset": case.output_correction, "command space": case.correction},
        surrogate=Kinematics(),
    )


SYSTEMS = {f"arm_{fold + 1}": partial(arm, fold=fold) for fold in range(FOLDS)}
