"""How often inversion calls nonsense "unknown", calibrated on one and two healthy trajectories.

The data are one real set (set A, in `RETWIN_DATA`), in three folds; inversion is calibrated on the
first one and two healthy trajectories of each. The outputs of the test trajectories are replaced by
what is no measurement of this machine for these commands; "measured" are the outputs as they are,
which should not be called so. A share is of all test trajectories of the three folds, the lowest
and highest those of a fold.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from record import record

import retwin as rt
from retwin.data.trajectories import UNKNOWN

SIZES = 1, 2
FOLDS = 3


def main() -> None:
    folder = os.environ.get("RETWIN_DATA")
    if not folder:
        print("nonsense: set RETWIN_DATA to the folder of the public data")
        return
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    case = rt.cases.armpi()
    twin = rt.load(Path(folder) / "armpi" / "sim.mat", case=case)
    real = rt.load(Path(folder) / "armpi" / "real_a.mat", case=case)
    surrogate = rt.fit_surrogate(twin, case.network, seed=0, training=case.training)
    rows = {}
    for size in SIZES:
        flagged: dict[str, list[float]] = {}
        for calibration, test in real.folds(FOLDS, seed=0):
            healthy, tested = real[calibration].with_label("Healthy")[:size], real[test]
            residual = rt.fit_residual(
                surrogate, healthy, case.correction, case.density, seed=0, twin=case.twin
            )
            inversion = rt.fit_inversion(surrogate, residual, healthy, case.faults, twin=case.twin)
            for name, outputs in nonsense(tested.observed.astype(float)).items():
                replaced = tested.replace(observed=outputs.astype(tested.observed.dtype))
                labels = inversion.diagnose(replaced).labels
                flagged.setdefault(name, []).append(float(np.mean(labels == UNKNOWN)))
        for name, shares in flagged.items():
            rows[f"{size} healthy, {name}"] = {
                "unknown": float(np.mean(shares)),
                "lowest": min(shares),
                "highest": max(shares),
            }
    record("nonsense", "set A, three folds: outputs that are no measurements", rows)


def nonsense(outputs: NDArray) -> dict[str, NDArray]:
    """Outputs (n, T, 3) as they are, and what is made of them."""
    rng, (_, steps, _) = np.random.default_rng(0), outputs.shape
    first = np.repeat(outputs[:, :1], steps, axis=1)
    frozen = outputs.copy()
    frozen[:, steps // 4 :] = outputs[:, [steps // 4]]
    spread = outputs.std(axis=(0, 1))
    noise = rng.normal(size=outputs.shape)
    ramp = np.linspace(0, 1, steps)[None, :, None]
    return {
        "measured": outputs,
        "zeros": np.zeros_like(outputs),
        "constant": first,
        "constant with noise": first + 1e-3 * spread * noise,
        "frozen at a quarter": frozen,
        "another record": np.roll(outputs, 7, axis=0),
        "noise": outputs.mean(axis=(0, 1)) + spread * noise,
        "reversed in time": outputs[:, ::-1],
        "ten times as large": 10 * outputs,
        "mirrored": outputs * np.array([1, -1, 1]),
        "x and y exchanged": outputs[..., [1, 0, 2]],
        "x and z exchanged": outputs[..., [2, 1, 0]],
        "rotated by 20 degrees": rotated(outputs, np.deg2rad(20)),
        "drifting by a standard deviation": outputs + ramp * spread,
    }


def rotated(outputs: NDArray, angle: float) -> NDArray:
    """Outputs (n, T, 3) in a frame that is rotated about z."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(outputs @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]))


if __name__ == "__main__":
    main()
