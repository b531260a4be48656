"""One bundle of small networks for all its tests, and its export."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import retwin as rt
from retwin.cli import main
from retwin.deploy.bundle.bundle import Bundle
from retwin.deploy.bundle.guard import Guard, fit_guard
from retwin.deploy.onnx.export import export_onnx
from retwin.nets.training import Training

QUICK = Training(max_epochs=8, batch_size=32, learning_rate=3e-3, weight_decay=1e-2)


@pytest.fixture(scope="session")
def exportable(ibg: rt.Surrogate, case: rt.Case, emulated: rt.Trajectories) -> rt.CorrectedTwin:
    """A corrected twin with everything that can be exported: command space and a sensor."""
    rg = rt.fit_residual(ibg, emulated, case.correction, seed=0)
    return rt.CorrectedTwin(ibg, rg, case="armpi")


@pytest.fixture(scope="session")
def guard(exportable: rt.CorrectedTwin, case: rt.Case, emulated: rt.Trajectories) -> Guard:
    return fit_guard(exportable, case, emulated, seed=0, count=900, training=QUICK)


@pytest.fixture(scope="session")
def bundle(
    exportable: rt.CorrectedTwin, case: rt.Case, guard: Guard, emulated: rt.Trajectories
) -> Bundle:
    made = rt.generate(exportable, case, per_class=20, seed=5)
    small = rt.CNN(channels=(16, 32))
    cnn = rt.fit_diagnoser(made, small, seed=0, classes=case.classes, training=QUICK)
    return Bundle.of(case, exportable, guard, cnn, data=[emulated], notes={"seed": 0})


@pytest.fixture(scope="session")
def saved(bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundles") / "bundle"
    bundle.save(folder)
    return folder


@pytest.fixture(scope="session")
def exported(
    bundle: Bundle, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, float]]:
    folder = tmp_path_factory.mktemp("bundles") / "portable"
    return folder, export_onnx(bundle, folder)


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Run `retwin …` in this process; exit code, stdout, stderr."""

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["retwin", *map(str, words)])
        monkeypatch.setenv("COLUMNS", "200")
        with pytest.raises(SystemExit) as ended:
            main()
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out, printed.err

    return run
