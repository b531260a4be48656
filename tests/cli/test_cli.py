"""The command line: every step on files, and bad input in one line."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import retwin as rt
from retwin.cli import main


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Run `retwin …` in this process; exit code, stdout, stderr."""

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["retwin", *map(str, words)])
        monkeypatch.setenv("COLUMNS", "200")
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return int(ended.value.code or 0), said.out, said.err

    return run


@pytest.fixture(scope="module")
def files(
    twin_set: rt.Trajectories,
    emulated: rt.Trajectories,
    updated: rt.CorrectedTwin,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    folder = tmp_path_factory.mktemp("files")
    rt.save(twin_set, folder / "twin.npz")
    rt.save(emulated, folder / "real.npz")
    updated.save(folder / "model")
    return folder


def test_help_names_every_command(call) -> None:
    code, out, _ = call("--help")
    assert code == 0
    for name in ("demo", "data", "fit", "generate", "diagnose", "study", "report"):
        assert name in out
    code, out, _ = call("study", "--help")
    assert "Example:" in out
    assert call("--version")[1].strip() == f"retwin {rt.__version__}"


def test_the_steps_one_by_one(call, files: Path, tmp_path: Path) -> None:
    code, out, err = call(
        "fit",
        "armpi",
        "--twin-data",
        files / "twin.npz",
        "--real",
        files / "real.npz",
        "--out",
        tmp_path / "model",
    )
    assert code == 0, err
    assert "Surrogate on held-out twin trajectories" in out
    assert "50 movements of 10 EMULATED trajectories" in out
    made = tmp_path / "made.npz"
    code, out, err = call(
        "generate", tmp_path / "model", "--per-class", 20, "--seed", 1, "--out", made
    )
    assert code == 0, err
    assert "180 trajectories" in out
    code, out, err = call("diagnose", "fit", made, "--case", "armpi", "--out", tmp_path / "cnn")
    assert code == 0, err
    assert "Accuracy on the held-out fifth" in out
    rt.save(rt.load(files / "real.npz").replace(labels=None), tmp_path / "unlabelled.npz")
    code, out, err = call(
        "diagnose",
        "predict",
        tmp_path / "cnn",
        tmp_path / "unlabelled.npz",
        "--out",
        tmp_path / "p.csv",
    )
    assert code == 0, err
    with (tmp_path / "p.csv").open() as sheet:
        rows = list(csv.reader(sheet))
    assert rows[0][1:] == list(rt.cases.armpi().classes)
    assert len(rows) == 91
    assert "macro_f1" not in out, "no labels, no scores"
    assert "macro_f1" in call("diagnose", "predict", tmp_path / "cnn", files / "real.npz")[1]
    code, out, err = call(
        "diagnose", "invert", tmp_path / "model", files / "real.npz", "--out", tmp_path / "physics"
    )
    assert code == 0, err
    rt.save(rt.load(files / "real.npz")[[0, 10]], tmp_path / "two.npz")
    code, out, err = call("diagnose", "predict", tmp_path / "physics", tmp_path / "two.npz")
    assert code == 0, err
    assert out.count("Healthy") >= 2
    assert "macro_f1" in out


def test_same_seed_same_file(call, files: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        call("generate", files / "model", "--per-class", 2, "--out", tmp_path / f"{name}.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def mat(path: Path, cells: list[np.ndarray], labels: list[str], key: str = "X_test_array") -> Path:
    x, y = np.empty((1, len(cells)), object), np.empty((1, len(cells)), object)
    for i, (cell, label) in enumerate(zip(cells, labels, strict=True)):
        x[0, i], y[0, i] = cell, label
    savemat(path, {key: x, key.replace("X", "y"): y})
    return path


GOOD = np.zeros((1000, 6))


def spoilt(value: float, column: int) -> np.ndarray:
    block = GOOD.copy()
    block[5, column] = value
    return block


@pytest.mark.parametrize(
    ("cells", "labels", "key", "message"),
    [
        ([GOOD], ["Healthy"], "X_strange", "X_array"),
        ([np.zeros((1000, 5))], ["Healthy"], "X_test_array", "expected"),
        ([spoilt(np.nan, 0)], ["Healthy"], "X_test_array", "got nan in sample 5"),
        ([spoilt(np.inf, 4)], ["Healthy"], "X_test_array", "infinite"),
        ([GOOD], ["Motor_9_Broken"], "X_test_array", "Motor_9_Broken"),
    ],
    ids=["wrong keys", "wrong shape", "NaN nominal", "infinite observed", "unknown class"],
)
def test_bad_files_end_with_one_line_and_code_2(
    call, files: Path, tmp_path: Path, cells: list, labels: list, key: str, message: str
) -> None:
    bad = mat(tmp_path / "bad.mat", cells, labels, key)
    out = tmp_path / "model"
    code, _, err = call(
        "fit", "armpi", "--twin-data", files / "twin.npz", "--real", bad, "--out", out
    )
    assert code == 2
    assert message in err
    told = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(told) == 1
    assert "expected" in told[0]
    assert "got" in told[0]
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == [bad], "nothing half-written"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fit", "armpi", "--twin-data", "no.mat", "--real", "no.mat", "--out", "m"), "no.mat"),
        (("fit", "unheard", "--twin-data", "x", "--real", "x", "--out", "m"), "case 'unheard'"),
        (("generate", "nowhere", "--out", "x.npz"), "expected a corrected model"),
        (("generate", "nowhere", "--out", "x.txt"), "ends in .npz or .zarr"),
        (("study", "armpi", "--sources", "dt,magic", "--out", "s"), "'magic'"),
        (("study", "armpi", "--real", "no.mat", "--out", "s"), "no.mat"),
        (("study", "armpi", "--test", "no.mat", "--out", "s"), "calibration and test"),
        (("report", "nowhere"), "results.json"),
    ],
)
def test_bad_words_end_with_one_line_and_code_2(
    call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: tuple, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = call(*words)
    assert code == 2
    assert message in err
    assert sum(line.startswith("error:") for line in err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_no_healthy_trajectory_is_refused(call, files: Path, tmp_path: Path) -> None:
    faulty = rt.load(files / "real.npz").with_label("Motor_1_Stuck")
    rt.save(faulty, tmp_path / "faulty.npz")
    code, _, err = call(
        "fit",
        "armpi",
        "--twin-data",
        files / "twin.npz",
        "--real",
        tmp_path / "faulty.npz",
        "--out",
        tmp_path / "model",
    )
    assert code == 2
    assert "at least one trajectory labelled 'Healthy'" in err
    assert not (tmp_path / "model").exists()


def test_demo_with_a_wrong_folder_is_refused(
    call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("RETWIN_DATA", str(tmp_path))
    code, _, err = call("demo", "--out", tmp_path / "demo")
    assert code == 2
    assert "RETWIN_DATA: expected a folder with armpi/real_a.mat" in err
