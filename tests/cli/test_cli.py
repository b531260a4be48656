"""The command line: every step on files, and bad input in one line."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import retwin as rt
from retwin.evaluation.choice.fitting import JUDGED, UNSTABLE


@pytest.mark.slow
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
    assert "50 segments of 10 EMULATED trajectories" in out
    made = tmp_path / "made.npz"
    code, out, err = call(
        "generate", tmp_path / "model", "--per-class", 20, "--seed", 1, "--out", made
    )
    assert code == 0, err
    assert (out, "180 trajectories" in err) == ("", True)
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
    assert rows[0][1:] == ["diagnosis", "reason", *rt.cases.armpi().classes]
    assert len(rows) == 91
    assert "macro_f1" not in out, "no labels, no scores"
    words = ("diagnose", "predict", tmp_path / "cnn", files / "real.npz")
    assert "macro_f1" in call(*words)[1]
    printed = json.loads(call(*words, "--json")[1])
    assert printed.keys() == {"emulated", "remark", "trajectories", "scores"}
    assert (printed["emulated"], len(printed["trajectories"]), printed["scores"]["n"]) == (
        True,
        90,
        90,
    )
    first = printed["trajectories"][0]
    keys = {"id", "diagnosis", "reason", "probability", "probabilities", "label", "commands"}
    assert first.keys() == keys
    assert first["probability"] == max(first["probabilities"].values())
    assert list(first["probabilities"]) == list(rt.cases.armpi().classes)
    code, out, err = call(
        *("diagnose", "fit", files / "real.npz", "--from", tmp_path / "model"),
        *("--out", tmp_path / "physics"),
    )
    assert code == 0, err
    rt.save(rt.load(files / "real.npz")[[0, 10]], tmp_path / "two.npz")
    code, out, err = call("diagnose", "predict", tmp_path / "physics", tmp_path / "two.npz")
    assert code == 0, err
    assert out.count("Healthy") >= 2
    assert "macro_f1" in out
    assert "the bound of unknown comes from" in err
    two = rt.load(tmp_path / "two.npz")
    observed = two.observed.copy()
    observed[0], observed[1] = np.nan, observed[1, ::-1] + 0.3
    rt.save(two.replace(observed=observed, mask=None, labels=None), tmp_path / "lost.npz")
    words = ("diagnose", "predict", tmp_path / "physics", tmp_path / "lost.npz")
    code, out, err = call(*words, "--out", tmp_path / "lost.csv")
    assert code == 0, err
    with (tmp_path / "lost.csv").open() as sheet:
        rows = list(csv.DictReader(sheet))
    assert [row["diagnosis"] for row in rows] == ["unknown"] * 2
    assert rows[0]["reason"] == "nothing was measured"
    assert out.count("unknown") == 3, "the column of the probability, and two diagnoses"
    found = json.loads(call(*words, "--json")[1])["trajectories"]
    assert [each["diagnosis"] for each in found] == ["unknown"] * 2


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
SCORES = ("macro_f1", "balanced_accuracy", "auroc", "healthy_recall")
ERRORS = ("rmse", "nrmse", "crps", "nll", "coverage90")


def spoilt(value: float, column: int) -> np.ndarray:
    block = GOOD.copy()
    block[5, column] = value
    return block


@pytest.mark.parametrize(
    ("case", "words", "message"),
    [
        ("tanks", (), "No trajectory has a label and the case has no faults: all count as Healthy"),
        ("armpi", (), "expected at least one trajectory labelled 'Healthy', got labels none"),
        ("armpi", ("--calibrate-on", "all"), "got labels none; label the trajectories"),
    ],
)
def test_trajectories_without_labels_are_healthy_only_where_there_are_no_faults(
    call, case: str, words: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    system = rt.cases.get(case)
    made = rt.generate(system.twin, system, per_class=3, seed=0)
    rt.save(made.replace(labels=None), tmp_path / "real.npz")
    code, _, err = call(
        *("fit", case, "--real", tmp_path / "real.npz", *words),
        # Labels are checked before twin data are read, which are not there.
        *("--twin-data", tmp_path / "none.npz", "--out", tmp_path / "model"),
    )
    assert code == 2
    assert message in err
    assert ("none.npz" in err) == (case == "tanks")


@pytest.mark.parametrize(
    ("cells", "labels", "key", "message"),
    [
        ([GOOD], ["Healthy"], "X_other", "X_array"),
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
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "expected" in errors[0]
    assert "got" in errors[0]
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == [bad], "nothing half-written"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fit", "armpi", "--twin-data", "no.mat", "--real", "no.mat", "--out", "m"), "no.mat"),
        (("fit", "unheard", "--twin-data", "x", "--real", "x", "--out", "m"), "case 'unheard'"),
        (("generate", "nowhere", "--out", "x.npz"), "nowhere, where there is none; check"),
        (("generate", "nowhere", "--out", "x.txt"), "ends in .npz or .zarr"),
        (("study", "armpi", "--sources", "dt,magic", "--out", "s"), "'magic'"),
        (("study", "armpi", "--real", "no.mat", "--out", "s"), "no.mat"),
        (("study", "armpi", "--test", "no.mat", "--out", "s"), "calibration and test"),
        (("report", "nowhere"), "results.json"),
    ],
)
def test_bad_arguments_end_with_one_line_and_code_2(
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


@pytest.mark.slow
def test_a_case_of_ones_own_with_classes(call, own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, out, err = call("twin", "info", "reach.toml")
    assert (code, "first" in out, "reach" in out) == (0, True, True), err
    words = ("twin", "simulate", "reach.toml", "--n", 6, "--fault", "all", "--out", "sim.npz")
    assert call(*words)[0] == 0
    assert rt.load("sim.npz").known_labels == {"Healthy", "stuck"}
    words = ("fit", "reach.toml", "--real", "real.npz", "--simulations", 40, "--out", "model")
    code, out, err = call(*words)
    assert code == 0, err
    assert "36 segments of 12 EMULATED trajectories" in out
    assert "→ a delay and an offset per segment" in out
    alone = (*words[:-1], "alone", "--no-compare", "--correction", "command_space", "--json")
    code, out, err = call(*alone)
    assert code == 0, err
    found = json.loads(out)
    assert (found["chosen"], found["parts"]) == ("segments", [])
    assert found["remarks"][0].startswith("No comparison was made: ")
    assert Path("alone/report.html").stat().st_size > 1000
    (own / "elsewhere").mkdir()
    monkeypatch.chdir(own / "elsewhere")
    code, out, err = call("generate", "../model", "--per-class", 10, "--out", "made.npz")
    assert code == 0, err
    assert rt.load("made.npz").known_labels == {"Healthy", "stuck"}
    code, out, err = call(
        "diagnose", "fit", "made.npz", "--case", "../reach.toml", "--out", "cnn"
    )  # fmt: skip
    assert code == 0, err
    code, out, err = call("diagnose", "predict", "cnn", "../real.npz", "--case", "../reach.toml")
    assert code == 0, err
    assert "macro_f1" in out


@pytest.mark.slow
def test_a_case_of_ones_own_without_classes(call, own: Path) -> None:
    words = ("fit", "tank.toml", "--real", "record.csv", "--simulations", 60, "--out", "model")
    words += ("--correction", "additive", "--no-yardstick")
    code, out, err = call(*words)
    assert code == 0, err
    assert "→ a residual of each output sample" in out
    assert "Residual model: 100 samples" in out
    assert "residual_level" in out
    assert "90 % band covers" in " ".join(out.split())
    code, out, err = call("--quiet", *words, "--json")
    printed = json.loads(out)
    assert (code, err) == (0, "")
    assert (printed["saved"], printed["chosen"]) == ("model", "output")
    assert {"none", "output"} <= {each["name"] for each in printed["candidates"]}
    assert {"rmse_level", "nrmse_level"} <= printed["surrogate"].keys()
    assert printed["residual"].keys() == {"emulated", "reason", "figures"}
    assert call("generate", "model", "--per-class", 3, "--out", "made.npz")[0] == 0
    made = rt.load("made.npz")
    assert (made.steps, made.outputs.names, len(made)) == (100, ("level",), 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("reach.toml", "--real", "real.npz", "--folds", "2", "--sources", "dt,ibg_rg"),
        ("tank.toml", "--data", "record.csv", "--sources", "twin,pi_ls,ibg_rg"),
    ],
)
def test_a_study_of_a_case_of_ones_own(call, own: Path, words: tuple) -> None:
    words = ("study", *words, "--runs", 1, "--per-class", 12, "--processes", 1, "--out", "study")
    code, out, err = call(*words)
    assert code == 0, err
    assert "Updated twin (outputs)" in out
    printed_again = json.loads(call(*words, "--json")[1])
    assert printed_again.keys() == {
        *("title", "emulated", "classifier", "runs", "test_trajectories"),
        *("sources", "comparisons", "uses", "report"),
    }
    for source in printed_again["sources"].values():
        assert source.keys() in ({"title", *SCORES}, {"title", *ERRORS})
    assert all(
        each.keys()
        == {
            *("a", "b", "metric", "mean_diff", "bootstrap_ci95"),
            *("p_verdict", "no_verdict", "outcome"),
        }
        for each in printed_again["comparisons"]
    )
    page = own / "study" / "report.html"
    assert page.stat().st_size > 1000
    page.unlink()
    assert call("report", "study")[0] == 0
    assert page.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "Missing option '--real'"),
        (("--real", "gone.csv"), "--real: expected an existing file or folder, got gone.csv"),
        (("--real", "record.csv", "--refine"), "--refine: expected a density of one z"),
        (("--real", "record.csv", "--density", "flow"), "density: expected SequenceMixture, for"),
        (("--real", "record.csv", "--network", "gru"), "network: expected one of mlp, lstm"),
        (("--real", "record.csv", "--simulations", "3"), "at least 10 trajectories"),
    ],
)
def test_what_a_fit_cannot_be_is_one_line(call, own: Path, words: tuple, message: str) -> None:
    code, _, err = call("fit", "tank.toml", *words, "--out", "model")
    assert code == 2
    assert message in err
    assert sum(line.startswith("error:") for line in err.splitlines()) == 1
    assert not (own / "model").exists()


def test_one_way_from_a_table_to_trajectories(call, own: Path) -> None:
    """By what a case states of its records, or by the names of the channels of a twin."""
    code, _, err = call("fit", "reach.toml", "--real", "record.csv", "--out", "model")
    assert code == 2
    assert "record.csv: expected a column for every command, first, second" in err
    (facts,) = json.loads(call("data", "info", "record.csv", "--case", "tank.toml", "--json")[1])
    assert facts["trajectories"] == 2, "calibration and test"
    whole = np.loadtxt("record.csv", delimiter=",", skiprows=1)
    np.savetxt("a.csv", whole[:, ::2], delimiter=",", header="valve,level", comments="")
    names = ("--case", "own_module:filled", "--inputs", "valve", "--outputs", "level")
    code, _, err = call("data", "info", "a.csv", *names)
    assert code == 2
    assert "--rate" in err, "rows without times"
    timed = np.column_stack([np.arange(100) / 4, whole[:, ::2]])
    np.savetxt("b.csv", timed, delimiter=",", header="time,valve,level", comments="")
    code, out, err = call("data", "info", "b.csv", *names, "--json")
    assert code == 0, err
    assert json.loads(out)[0]["rate"] == 4
    free = ("--free", "gain=0.05:0.2", "--out", "identified")
    code, out, err = call("identify", "own_module:filled", "b.csv", *names[2:], *free, "--json")
    assert code == 0, err


def test_a_built_in_twin_has_its_own_case(call, tmp_path: Path) -> None:
    code, _, err = call("twin", "simulate", "tanks", "--n", 2, "--out", tmp_path / "made.npz")
    assert code == 0, err
    assert rt.load(tmp_path / "made.npz").steps == rt.cases.tanks().sampler.steps


def test_a_model_without_free_simulation_says_so_where_it_is_simulated(
    watched: Path, call, tmp_path: Path
) -> None:
    said, model = f"{UNSTABLE} {JUDGED.format(130.0)}", tmp_path / "model"
    shutil.copytree(watched / "model", model)
    (model / "choice.json").write_text(json.dumps({"remarks": [said, "Another one."]}))
    real = watched / "healthy.npz"
    for how, shown in (((), True), (("--horizon", "5s"), False)):
        code, printed, err = call("evaluate", model, "--real", real, *how)
        assert code == 0, err
        assert (said in " ".join(printed.split())) is shown
    bands = ("--bands", "--out", tmp_path / "bands.csv")
    code, _, err = call("generate", model, "--commands", real, *bands)
    assert (code, said in err) == (0, True), err
