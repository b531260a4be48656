"""Sound files of every format, which the long tests damage or name in odd ways."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import mutation
import numpy as np
import pytest
from log_files import SPEEDS
from scipy.io import savemat

import retwin as rt
from retwin.deploy.bundle.bundle import Bundle
from retwin.deploy.bundle.guard import fit_guard
from retwin.nets.training import Training

BRIEF = Training(max_epochs=1, batch_size=32, learning_rate=1e-3)
STUDY = Path(__file__).parents[1] / "report" / "schema_1" / "arm.json"


@pytest.fixture(scope="session")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder per format, with a sound file of it and what its command needs besides."""
    root = tmp_path_factory.mktemp("samples")
    for name in mutation.NAMES:
        (root / name).mkdir()
    for name in ("case", "model", "npz", "csv", "bundle"):
        (root / name / "own_of_mutations.py").write_text(mutation.MODULE)
        (root / name / "case.toml").write_text(mutation.CASE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path, str(root / "case")])
        case = rt.cases.get(str(root / "case" / "case.toml"))
    made = rt.generate(case.twin, case, per_class=8, seed=5)
    real = made.replace(observed=made.observed + np.float32(0.02), emulated=True)
    rt.save(real[::4], root / "npz" / "a.npz")
    for name in ("diagnoser", "bundle", "onnx"):
        if name in mutation.NAMES:
            rt.save(real[::4], root / name / "real.npz")
    if "zarr" in mutation.NAMES:
        rt.save(real[::4], root / "zarr" / "a.zarr")
    for name in mutation.NAMES:
        if name.startswith("log-"):
            file = name.replace("log-", "a.")
            SPEEDS[file][0](root / name / file)
    tables = np.concatenate([made.nominal, made.observed], axis=-1).astype(float)[::4]
    cells = np.empty((2, 1, len(tables)), object)
    for i, table in enumerate(tables):
        cells[0, 0, i], cells[1, 0, i] = table, str(made.labels[4 * i])
        file = root / "csv" / "set" / str(made.labels[4 * i]) / f"{i}.csv"
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(file, table, delimiter=",", fmt="%.6g")
    savemat(root / "mat" / "a.mat", {"X_array": cells[0], "y_array": cells[1]})
    surrogate = rt.fit_surrogate(made, case.network, seed=0, training=case.training)
    residual = rt.fit_residual(surrogate, real, case.correction, case.density, seed=0)
    twin = rt.CorrectedTwin(surrogate, residual, case="reach")
    twin.save(root / "model" / "model")
    network = rt.CNN(channels=(4, 4))
    diagnoser = rt.fit_diagnoser(made, network, seed=0, classes=case.classes, training=BRIEF)
    diagnoser.save(root / "diagnoser" / "cnn")
    guard = fit_guard(twin, case, real, seed=0, count=300, training=BRIEF)
    bundle = Bundle.of(case, twin, guard, diagnoser, data=[real])
    bundle.save(root / "bundle" / "sealed")
    (root / "results" / "study").mkdir()
    shutil.copy(STUDY, root / "results" / "study" / "results.json")
    return root


@pytest.fixture(scope="session")
def exported(samples: Path) -> Path:
    """The same samples with the export of the bundle, which takes longer than all others."""
    from retwin.deploy.onnx.export import export_onnx

    export_onnx(Bundle.load(samples / "bundle" / "sealed"), samples / "onnx" / "sealed")
    return samples
