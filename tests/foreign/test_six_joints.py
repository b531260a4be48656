"""An arm of six joints at 25 Hz, from its MJCF to diagnoses, through the command line alone."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import six_joints
from terminal import retwin

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the user: case, calibration runs, labelled test runs."""
    made = tmp_path_factory.mktemp("six")
    six_joints.write_case(made)
    six_joints.write_runs(made / "calibration", {"Healthy": 6}, 1)
    six_joints.write_runs(made / "test", {"Healthy": 5} | dict.fromkeys(six_joints.FAULTS, 1), 100)
    return made


@pytest.fixture(scope="module")
def model(folder: Path) -> Path:
    """A corrected twin that was calibrated on the healthy runs, and the diagnoser from it."""
    retwin(folder, "twin simulate six.toml --n 300 --fault all --out simulated.npz")
    words = "--real calibration --twin-data simulated.npz --out model --json"
    (folder / "fit.json").write_text(retwin(folder, f"fit six.toml {words}").out)
    retwin(folder, "diagnose fit calibration --from model --out physics")
    return folder / "model"


def test_names_of_joints_and_sites_are_outputs(folder: Path) -> None:
    found = retwin(folder, "twin info six.toml --json").json
    assert [each["name"] for each in found["inputs"]] == list(six_joints.JOINTS)
    assert {each["unit"] for each in found["inputs"]} == {"rad"}
    names = ["joint:elbow", *(f"site:tool_{axis}" for axis in "xyz")]
    assert [each["name"] for each in found["outputs"]] == names
    assert [each["unit"] for each in found["outputs"]] == ["rad", "m", "m", "m"]


def test_runs_are_described_and_split(folder: Path) -> None:
    (facts,) = retwin(folder, "data info test --case six.toml --json").json
    assert facts["per_class"] == {"Healthy": 5} | dict.fromkeys(six_joints.FAULTS, 1)
    assert (facts["samples"], facts["rate"], facts["missing"]) == (200, 25, 0)
    retwin(folder, "data convert calibration first.npz --case six.toml --split 0.5")
    found = retwin(folder, "data info first.npz first-rest.npz --json").json
    assert [each["trajectories"] for each in found] == [3, 3]


def test_the_surrogate_is_good_where_the_arm_works(folder: Path, model: Path) -> None:
    found = json.loads((folder / "fit.json").read_text())
    errors = [each for name, each in found["surrogate"].items() if name.startswith("nrmse_")]
    assert len(errors) == 4
    assert max(errors) < 0.03
    assert found["residual"]["figures"]["delays_at_bound"] == 0
    assert found["residual"]["figures"]["movements"] == 6 * six_joints.SEGMENTS


def test_generated_runs_are_finite_and_balanced(folder: Path, model: Path) -> None:
    retwin(folder, "generate model --per-class 3 --out made.npz")
    (facts,) = retwin(folder, "data info made.npz --json").json
    assert facts["per_class"] == dict.fromkeys(["Healthy", *six_joints.FAULTS], 3)
    with np.load(folder / "made.npz") as made:
        assert np.isfinite(made["observed"]).all()


def test_faults_are_found(folder: Path, model: Path) -> None:
    found = retwin(folder, "diagnose predict physics test --case six.toml --json").json
    assert found["scores"]["macro_f1"] >= 0.9
    assert found["scores"]["healthy_recall"] == 1
    assert not found["emulated"]


def test_what_the_bundle_was_not_made_for(folder: Path, model: Path) -> None:
    """Rows that are outside keep their place: a verdict, and no probability."""
    six_joints.write_runs(folder / "odd", {"Healthy": 3}, 50)
    sentinel, nothing = (folder / "odd" / "Healthy" / f"Healthy-{i}.csv" for i in range(2))
    for file, rows, value in ((sentinel, 40, 3.4e38), (nothing, slice(None), np.nan)):
        table = np.loadtxt(file, delimiter=",")
        table[rows, -4:] = value
        np.savetxt(file, table, delimiter=",", fmt="%.7g")
    retwin(folder, "diagnose fit simulated.npz --case six.toml --rate 25 --out cnn")
    retwin(folder, "bundle save model calibration --diagnoser cnn --out sealed")
    words = "diagnose predict sealed odd --case six.toml --out odd.csv --json"
    found = retwin(folder, words).json["trajectories"]
    with (folder / "odd.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["trajectory"] for row in rows] == [each["id"] for each in found]
    assert [each["guard"] == "outside" for each in found] == [True, True, False]
    classes = ["Healthy", *six_joints.FAULTS]
    for each, row in zip(found, rows, strict=True):
        assert row["guard"] == each["guard"]
        assert row["reason"] == each["reason"]
        values = [each["probability"], *each["probabilities"].values()]
        if each["guard"] == "outside":
            assert each["reason"]
            assert each["diagnosis"] == "unknown"
            assert values == [None] * (1 + len(classes))
            assert [row[name] for name in classes] == [""] * len(classes)
        else:
            assert each["diagnosis"] in classes
            assert sum(float(row[name]) for name in classes) == pytest.approx(1)


def test_a_study_with_bands_that_cover(folder: Path, model: Path) -> None:
    words = "--calibration calibration --test test --twin-data simulated.npz --out study --json"
    plan = "--sources dt,ibg_rg --runs 1 --per-class 4 --processes 1"
    found = retwin(folder, f"study six.toml {words} {plan}").json
    assert set(found["sources"]) == {"dt", "ibg_rg"}
    results = json.loads((folder / "study" / "results.json").read_text())
    figures = results["fidelity"]["ibg_rg"]["figures"]
    assert 0.7 < figures["coverage90"]["value"] <= 1
    # The mean alone, without the distribution, is worse.
    assert figures["crps_below/mean_only"]["interval"][0] > 0
    assert all(row["outcome"] == "" for row in found["comparisons"])
    retwin(folder, "report study")
    assert (folder / "study" / "report.html").stat().st_size > 10_000
