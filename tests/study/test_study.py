"""A small study of the emulated robot from end to end: its results, and that it resumes."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small
from small import PLAN, small_case

import retwin as rt
from retwin.scores.classification import METRICS
from retwin.study import _check_free, possible_sources
from retwin.study.files import Files, Job, Roles
from retwin.study.trial import SEES, Trial
from retwin.study.work import Work

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def case() -> rt.Case:
    """In place of the arm's default case; of the same scope, since sets of the session need it."""
    return small_case()


@pytest.fixture(scope="module")
def finished(case: rt.Case, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("study") / "whole"
    results = rt.run_study(case, PLAN, rt.StudyData(), out, processes=2)
    return json.loads(results.to_json()), out


def comparable(out: Path) -> dict[str, Any]:
    """The contents of results.json without what depends on time and machine."""
    results = json.loads((out / "results.json").read_text("utf-8"))
    for name in ("timing", "provenance"):
        del results[name]
    for source in results["sources"].values():
        for cost in ("update_s", "generate_s", "train_s", "predict_s"):
            del source[cost]
    return results


def test_results_follow_the_schema(finished: tuple[dict, Path], case: rt.Case) -> None:
    _, out = finished
    results = json.loads((out / "results.json").read_text("utf-8"))
    assert results["schema"] == 1
    assert results["emulated"] is True
    assert results["published"] == {}, "the paper's figures are compared with real data alone"
    assert results["classes"] == list(case.classes)
    assert list(results["sources"]) == ["dt", "ibg", "ibg_rg"]
    assert results["data"]["test"]["n"] == 90
    for source in results["sources"].values():
        for metric in METRICS:
            assert len(source[metric]) == 2
        assert np.array(source["predictions"]).shape == (2, 90)
        table = np.array(source["confusion"])
        assert table.sum() == 180
        assert (table.sum(axis=1) == 20).all(), "rows are true"
        assert source["fault_protocol_known"] is True
    pairs = {(row["a"], row["b"]) for row in results["comparisons"]}
    assert pairs == {("ibg", "dt"), ("ibg_rg", "dt"), ("ibg_rg", "ibg")}
    for row in results["comparisons"]:
        low, high = row["bootstrap_ci95"]
        assert low <= row["mean_diff"] + 1e-9
        assert row["mean_diff"] - 1e-9 <= high
        assert (row["p_verdict"], row["no_verdict"]) == (None, "few runs"), "two runs"
        assert 0 < row["p_bootstrap"] <= 1
    found = results["fidelity"]["ibg_rg"]
    assert (found["trajectories"], found["movements"]) == (8, 40), "four of each fold"
    shown = [results["data"]["test"]["ids"].index(name) for name in results["portrait"]["ids"]]
    assert shown == sorted(shown)
    labels = [results["data"]["test"]["labels"][place] for place in shown]
    assert {label: labels.count(label) for label in case.classes} == dict.fromkeys(case.classes, 8)
    assert found["rivals"] == ["mean_only", "single_gaussian"]
    assert found["widening"] > 0
    for name in ("energy", "crps/x", "crps_below/mean_only", "coverage90", "pit", "auroc"):
        low, high = found["figures"][name]["interval"]
        assert low <= high
    for name in ("delay", "offset_x", "noise_z"):
        assert 0 <= found["figures"][f"ks/{name}"]["value"] <= 1


def test_figures_agree_with_the_predictions(finished: tuple[dict, Path]) -> None:
    results, out = finished
    labels = results["data"]["test"]["labels"]
    truth = np.array([results["classes"].index(label) for label in labels])
    with np.load(out / "arrays.npz", allow_pickle=False) as arrays:
        for name, source in results["sources"].items():
            probabilities = arrays[f"probabilities/{name}"]
            assert probabilities.shape == (2, 90, 9)
            predicted = probabilities.argmax(axis=2)
            np.testing.assert_array_equal(predicted, source["predictions"])
            assert source["accuracy"] == pytest.approx((predicted == truth).mean(axis=1).tolist())
        assert arrays["z/ibg_rg/observed"].shape[1] == 7
        assert len(arrays["portrait/bands"]) == len(arrays["pose/updated"]) == 72
        assert arrays["pit/ibg_rg"].shape == (3, 20)
        assert arrays["bands/ibg_rg/quantiles"].shape == (2, 5, 100, 3)
        healthy = {
            i
            for i, label in zip(results["data"]["test"]["ids"], labels, strict=True)
            if label == "Healthy"
        }
        assert set(arrays["bands/ibg_rg/ids"].tolist()) <= healthy


def test_calling_again_does_nothing_new(finished: tuple[dict, Path], case: rt.Case) -> None:
    _, out = finished
    before = comparable(out)
    stamps = {p: p.stat().st_mtime_ns for p in (out / "work").rglob("*") if p.is_file()}
    rt.run_study(case, PLAN, rt.StudyData(), out, processes=2)
    assert comparable(out) == before
    assert {p: p.stat().st_mtime_ns for p in (out / "work").rglob("*") if p.is_file()} == stamps


@pytest.mark.parametrize(
    "sign_of_progress",
    ["work/run-0/surrogate", pytest.param("work/run-0/fold-0/dt.npz", marks=pytest.mark.long)],
)
def test_killed_and_called_again_it_ends_the_same(
    finished: tuple[dict, Path], tmp_path: Path, sign_of_progress: str
) -> None:
    out = tmp_path / "killed"
    call = [sys.executable, small.__file__, str(out)]
    process = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 240
    while not (out / sign_of_progress).exists() and time.monotonic() < deadline:
        assert process.poll() is None, "ended before it could be killed"
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert not (out / "results.json").exists()
    subprocess.run(call, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    assert comparable(out) == comparable(finished[1])
    with np.load(out / "arrays.npz") as made, np.load(finished[1] / "arrays.npz") as expected:
        assert set(made) == set(expected)
        for name in made:
            np.testing.assert_array_equal(made[name], expected[name])
    assert not list(out.rglob(".*")), "no temporary file is left"


def test_another_study_in_the_same_folder_is_refused(
    finished: tuple[dict, Path], case: rt.Case, tmp_path: Path
) -> None:
    with pytest.raises(rt.InputError, match="another plan or other data"):
        rt.run_study(case, rt.StudyPlan(seed=4), rt.StudyData(), finished[1])
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(rt.InputError, match="holds other files"):
        rt.run_study(case, PLAN, rt.StudyData(), tmp_path)


def test_a_study_of_another_version_is_not_resumed(tmp_path: Path) -> None:
    (tmp_path / "study.json").write_text('{"retwin": "0.0.9", "plan": {}}', encoding="utf-8")
    with pytest.raises(rt.InputError, match=r"begun by another version of retwin 0\.0\.9"):
        _check_free(tmp_path, {"plan": {}, "case": "a"})


def test_calibration_and_test_sets_keep_their_roles(
    emulated: rt.Trajectories, twin_set: rt.Trajectories, case: rt.Case, tmp_path: Path
) -> None:
    calibration, test = emulated.split(0.4, seed=0)
    for name, part in (("c", calibration), ("t", test), ("twin", twin_set)):
        rt.save(part, tmp_path / f"{name}.npz")
    plan = rt.StudyPlan(sources=("dt", "ibg_rg"), runs=1, per_class=8, ablations=False)
    data = rt.StudyData(tmp_path / "twin.npz", tmp_path / "c.npz", tmp_path / "t.npz")
    results = rt.run_study(case, plan, data, tmp_path / "out", processes=2)
    assert results.data.test.ids == test.ids.tolist()
    healthy = calibration.with_label("Healthy")
    assert results.data.calibration.n == len(calibration)
    assert results.data.calibration.used == healthy.ids.tolist()
    assert results.data.twin.n == 108
    fidelity = results.fidelity["ibg_rg"]
    assert (fidelity.rivals, fidelity.widening) == ([], None), "without ablations"
    row = next(r for r in results.comparisons if r.metric == "macro_f1")
    assert row.p is None, "one run has no Welch test"


def test_folds_test_everything_once_and_never_what_they_calibrate_on(
    emulated: rt.Trajectories,
) -> None:
    roles = Roles.of(emulated.folds(3, seed=0))
    assert sorted(roles.tested) == list(range(90))
    for calibration, test in roles.folds:
        assert not set(calibration) & set(test)
        assert (emulated.labels[list(test)] == "Healthy").sum() in (3, 4)


def test_seeds_differ_by_run_fold_and_stage_and_not_by_the_sources_chosen(case: rt.Case) -> None:
    one, other = PLAN, rt.StudyPlan(sources=("dt",), seed=3)
    keys = [("generate", r, f) for r in range(3) for f in range(3)] + [("surrogate", 0, 0)]
    seeds = [one.seed_of(*key) for key in keys]
    assert len(set(seeds)) == len(seeds)
    assert seeds == [other.seed_of(*key) for key in keys]
    work = Work(Path("x"), case, rt.StudyPlan(sources=("dt",)), Roles.of([((0,), (1,))]))
    assert work.graph() == {Job("diagnosis", run, 0, "dt"): () for run in range(5)}
    assert work.files.path(Job("diagnosis", 0, 0, "dt")).name == "dt.npz"


REAL = {
    "timing": lambda trial: trial.onsets,
    "healthy": lambda trial: trial.healthy,
    "unlabelled": lambda trial: trial.unlabelled,
    "test outputs": lambda trial: trial.test_outputs,
    "labelled": lambda trial: trial.labelled,
}


@pytest.mark.parametrize("sees", SEES)
def test_a_source_has_access_to_the_real_data_that_it_declares_alone(
    sees: str, finished: tuple[dict, Path], case: rt.Case
) -> None:
    files = Files(finished[1] / "work")
    real = files.real_data()
    fold = (tuple(range(0, 90, 2)), tuple(range(1, 90, 2)))
    trial = Trial(files, case, PLAN, fold, Job("diagnosis", 0, 0, "a source"), sees)
    for what, read in REAL.items():
        if what not in SEES[sees]:
            if what == "timing":
                assert read(trial) is None
            else:
                with pytest.raises(PermissionError, match=f"declares '{sees}' and asks for {what}"):
                    read(trial)
    if sees == "labelled":
        assert trial.labelled.ids.tolist() == real.ids[::2].tolist()
        assert set(trial.healthy.labels.tolist()) == {"Healthy"}
    if sees in ("unlabelled", "transductive"):
        found = trial.unlabelled if sees == "unlabelled" else trial.test_outputs
        assert found.ids.tolist() == real.ids[int(sees == "transductive") :: 2].tolist()
        assert set(found.labels.tolist()) == {""}
    assert set(trial.tested().labels.tolist()) == {""}, "predictions use no labels"


def test_fewer_trajectories_are_a_part_of_the_more(
    finished: tuple[dict, Path], case: rt.Case
) -> None:
    files, fold = Files(finished[1] / "work"), (tuple(range(45)), tuple(range(45, 90)))
    kept = [
        set(
            Trial(
                files, case, PLAN, fold, Job("residual", 0, 0, "output", count), "healthy"
            ).healthy.ids
        )
        for count in (1, 2, 4)
    ]
    assert [len(each) for each in kept] == [1, 2, 4]
    assert kept[0] < kept[1] < kept[2]


def test_a_study_grows(finished: tuple[dict, Path], case: rt.Case, tmp_path: Path) -> None:
    """More sources and a learning curve are added to what is there; nothing is made again."""
    out = tmp_path / "grown"
    shutil.copytree(finished[1], out)
    kept = {p: p.stat().st_mtime_ns for p in (out / "work").rglob("*") if p.is_file()}
    sources = ("dt", "dt_noise")
    plan = replace(PLAN, runs=1, sources=sources, learning_curve=True)
    results = rt.run_study(case, plan, rt.StudyData(), out, processes=2)
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert list(results.sources) == list(sources)
    first = finished[0]["sources"]["dt"]
    assert results.sources["dt"].predictions == first["predictions"][:1]
    assert results.sources["dt"].generate_s is None
    curve = [(row.source, row.healthy) for row in results.learning_curve or []]
    assert curve == [("dt_noise", count) for count in (1, 2, 4, 5)]
    assert rt.write_report(out).stat().st_size < 10_000_000


def test_a_study_that_cannot_be_is_refused_at_once(case: rt.Case, tmp_path: Path) -> None:
    fixed = replace(case, parametric=None)
    for sources, system, classifier, message in (
        (("dt", "pi_ls"), fixed, None, "declares the free parameters of its twin"),
        (("dann",), case, "rocket", "a classifier that is a network"),
    ):
        plan = rt.StudyPlan(sources=sources, classifier=classifier)
        with pytest.raises(rt.InputError, match=message):
            rt.run_study(system, plan, rt.StudyData(), tmp_path / "out")
    for processes in (0, -1, 1.5, float("nan")):
        with pytest.raises(rt.InputError, match="processes: expected a whole number of at least 1"):
            rt.run_study(case, PLAN, rt.StudyData(), tmp_path / "out", processes=processes)
    assert not (tmp_path / "out").exists()
    assert "pi_ls" not in possible_sources(fixed, rt.StudyPlan())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sources": ("dt", "magic")}, "sources: expected one of dt, twin, randomised"),
        ({"sources": ()}, "at least one source"),
        ({"preset": "slow"}, "preset: expected one of quick, paper"),
        ({"classifier": "svm"}, "classifier: expected one of cnn, lstm, rocket"),
        ({"runs": 0}, "runs: expected a whole number from 1 to 1000, got 0"),
        ({"runs": 1.5}, "runs: expected a whole number from 1 to 1000, got 1.5"),
        ({"runs": float("nan")}, "runs: expected a whole number from 1 to 1000, got nan"),
        ({"per_class": 0}, "per_class: expected a whole number from 1 to 10000000"),
        ({"emulated_healthy": 0}, "emulated_healthy: expected a whole number from 1"),
        ({"calibrated": 0}, "calibrated: expected a whole number of at least 1"),
        ({"simulated": 0}, "simulated: expected a whole number of at least 1"),
        ({"overlaid": 0}, "overlaid: expected a whole number of at least 1"),
        ({"folds": 1}, "folds: expected a whole number of at least 2"),
        ({"seed": -1}, "seed: expected a whole number of at least 0"),
        ({"calibrate_on": "some"}, "calibrate_on: expected one of healthy, all"),
        ({"encoder_noise": -1.0}, "encoder_noise: expected a finite number of at least 0"),
        ({"encoder_noise": float("nan")}, "encoder_noise: expected a finite number .* got nan"),
        ({"encoder_noise": float("inf")}, "encoder_noise: expected a finite number .* got inf"),
        ({"rate": 0.0}, "rate: expected a positive number of Hz, got 0.0"),
        ({"rate": float("nan")}, "rate: expected a positive number of Hz, got nan"),
        ({"rate": float("inf")}, "rate: expected a positive number of Hz, got inf"),
    ],
)
def test_bad_plans_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(rt.InputError, match=message):
        rt.StudyPlan(**changes)


def test_contradicting_data_are_refused(tmp_path: Path) -> None:
    with pytest.raises(rt.InputError, match="either calibration and test, or real alone"):
        rt.StudyData(calibration=tmp_path)
    with pytest.raises(rt.InputError, match="either calibration and test, or real alone"):
        rt.StudyData(calibration=tmp_path, test=tmp_path, real=tmp_path)


def test_bad_data_leave_nothing_behind(
    emulated: rt.Trajectories, case: rt.Case, tmp_path: Path
) -> None:
    faulty = emulated[emulated.labels != "Healthy"]
    rt.save(faulty, tmp_path / "faulty.npz")
    data = rt.StudyData(real=tmp_path / "faulty.npz")
    with pytest.raises(rt.InputError, match="labelled 'Healthy' in every calibration part"):
        rt.run_study(case, PLAN, data, tmp_path / "out")
    other = emulated.replace(labels=np.array(["Other"] * 90))
    rt.save(other, tmp_path / "other.npz")
    with pytest.raises(rt.InputError, match="Other"):
        rt.run_study(case, PLAN, rt.StudyData(real=tmp_path / "other.npz"), tmp_path / "out")
    with pytest.raises(rt.InputError, match="at least 10 trajectories of the twin"):
        rt.run_study(case, rt.StudyPlan(per_class=1), rt.StudyData(), tmp_path / "out")
    healthy = rt.generate(case.twin, replace(case, faults={"Healthy": None}), per_class=12, seed=0)
    rt.save(healthy, tmp_path / "healthy.npz")
    data = rt.StudyData(twin=tmp_path / "healthy.npz")
    with pytest.raises(
        rt.InputError, match="every class, from which dt would learn them, got none of Motor"
    ):
        rt.run_study(case, rt.StudyPlan(sources=("dt", "inversion")), data, tmp_path / "out")
    noisy = rt.StudyPlan(encoder_noise=1.0)
    with pytest.raises(rt.InputError, match="does not state how encoder noise"):
        rt.run_study(case.with_random_onset(), noisy, rt.StudyData(), tmp_path / "out")
    assert not (tmp_path / "out").exists()
