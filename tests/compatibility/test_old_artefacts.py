"""Files that the development version wrote open, and what they hold answers as it did then.

`make.py` made the files with the former code.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import retwin as rt
from retwin.data.io.zarr_folder import read_header
from retwin.deploy.bundle.bundle import Bundle
from retwin.deploy.simulations import SimulationPlan, simulate_to
from retwin.serialisation.files import sha256
from retwin.twins.samplers import RampSampler
from retwin.update.identification import PosteriorTwin

FILES = Path(__file__).parent / "v0_1_development"
ERROR = 1e-5
"""Greatest difference, in m or as probability. Where the files were made it is below 1e-9."""


@pytest.fixture(scope="module")
def then() -> Mapping[str, NDArray]:
    with np.load(FILES / "outputs.npz", allow_pickle=False) as file:
        return dict(file)


@pytest.fixture(scope="module")
def case() -> Iterator[rt.Case]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path])
        yield rt.cases.get(str(FILES / "case.toml"))
    sys.modules.pop("plant_of_case", None)


@pytest.fixture(scope="module")
def measured() -> rt.Trajectories:
    return rt.load(FILES / "set.npz")


def plan(case: rt.Case) -> SimulationPlan:
    """The plan of `simulated.zarr`."""
    return SimulationPlan(case.twin, case.sampler, seed=5, n=4, faults=case.faults, chunk=4)


def test_a_case_has_its_former_settings(case: rt.Case) -> None:
    correction = rt.Chain(
        rt.CommandSpace(delay_range=(0, 0.1), max_samples=40, identified_below=0.5),
        rt.SampledSensor(period=0.1),
    )
    assert case.correction == correction
    assert case.training == rt.Training(max_epochs=20, batch_size=256, learning_rate=0.01)
    brief = rt.Training(max_epochs=20, batch_size=32, learning_rate=0.01)
    assert case.density == rt.Mixture(components=2, hidden=(8,), training=brief)
    assert case.sampler == RampSampler((-1, -1), (1, 1), 50, 4, 3, ramp_durations=(0.2, 0.3))
    assert case.faults["v_stuck"] == rt.Stuck(1, 1.4)
    assert case.faults["u_biased"] == rt.ActuatorBias(0, (0.3, 0.6))


def test_an_onset_in_samples_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A case cannot tell them from seconds, so that one beyond the end names the unit."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    shutil.copy(FILES / "plant_of_case.py", tmp_path / "plant_in_samples.py")
    text = (FILES / "case.toml").read_text("utf-8").replace("onset = 1.4", "onset = 70")
    text = text.replace("plant_of_case", "plant_in_samples")
    (tmp_path / "case.toml").write_text(text, encoding="utf-8")
    with pytest.raises(rt.InputError) as refusal:
        rt.cases.get(str(tmp_path / "case.toml"))
    assert str(refusal.value) == (
        f"{tmp_path / 'case.toml'}: onset: expected a time in s within the trajectory, which lasts "
        "4 s, got 70 s; give an earlier one, in seconds and not in samples"
    )


def test_sets_open(case: rt.Case, measured: rt.Trajectories) -> None:
    assert len(measured) == 18
    assert measured.known_labels == set(case.classes)
    np.testing.assert_array_equal(rt.load(FILES / "set.zarr").observed, measured.observed[:2])
    made = rt.load(FILES / "simulated.zarr", case=case)
    again = case.twin.simulate(made.commands, seed=0)
    np.testing.assert_allclose(made.nominal, again.nominal, atol=ERROR)


@pytest.mark.parametrize("name", ["surrogate", "lstm", "tcn", "statespace"])
def test_a_surrogate_predicts_the_same(name: str, then: Mapping[str, NDArray]) -> None:
    outputs = rt.Surrogate.load(FILES / name).predict(then["commands"])
    np.testing.assert_allclose(outputs, then[name], atol=ERROR)


@pytest.mark.parametrize("name", ["delay_offset", "command_space", "flow", "sequence"])
def test_a_corrected_twin_simulates_the_same(name: str, then: Mapping[str, NDArray]) -> None:
    twin = rt.CorrectedTwin.load(FILES / name)
    outputs = twin.simulate(then["commands"], seed=5).observed
    np.testing.assert_allclose(outputs, then[f"{name}/random"], atol=ERROR)
    mean = rt.CorrectedTwin(twin.surrogate, twin.residual, case=twin.case, random=False)
    outputs = mean.simulate(then["commands"], seed=5).observed
    np.testing.assert_allclose(outputs, then[f"{name}/mean"], atol=ERROR)


@pytest.mark.parametrize(
    "name", ["cnn", "lstm_classifier", "inversion", pytest.param("rocket", marks=pytest.mark.slow)]
)
def test_a_diagnoser_gives_the_same_probabilities(
    name: str, then: Mapping[str, NDArray], measured: rt.Trajectories
) -> None:
    if name == "rocket":
        pytest.importorskip("sktime")
    diagnoser = rt.load_diagnoser(FILES / name)
    assert list(diagnoser.classes) == list(then[f"{name}/classes"])
    np.testing.assert_allclose(diagnoser.predict_proba(measured), then[name], atol=ERROR)


def test_a_posterior_twin_simulates_the_same(case: rt.Case, then: Mapping[str, NDArray]) -> None:
    assert case.parametric is not None
    twin = PosteriorTwin.load(FILES / "posterior", case.parametric)
    outputs = twin.simulate(then["commands"], seed=5).observed
    np.testing.assert_allclose(outputs, then["posterior"], atol=ERROR)


def test_a_bundle_predicts_and_generates_the_same(
    case: rt.Case, then: Mapping[str, NDArray], measured: rt.Trajectories
) -> None:
    bundle = Bundle.load(FILES / "bundle")
    assert bundle.facts.faults == dict(case.faults)
    assert bundle.facts.sampler == case.sampler
    probabilities = bundle.predict(measured).probabilities
    np.testing.assert_allclose(probabilities, then["bundle"], atol=ERROR)
    outputs = bundle.generate(per_class=1, seed=3).observed
    np.testing.assert_allclose(outputs, then["bundle/generated"], atol=ERROR)


def test_a_finished_study_has_a_report(tmp_path: Path) -> None:
    shutil.copytree(FILES / "study", tmp_path / "study")
    page = rt.write_report(tmp_path / "study")
    assert "Updated twin (outputs)" in page.read_text("utf-8")


@pytest.mark.parametrize("version", ["", "0.0.9"])
def test_a_study_is_not_resumed(version: str, case: rt.Case, tmp_path: Path) -> None:
    """The development version wrote no version into study.json."""
    out = tmp_path / "study"
    shutil.copytree(FILES / "study", out)
    if version:
        found = json.loads((out / "study.json").read_text("utf-8"))
        text = json.dumps({"retwin": version, **found})
        (out / "study.json").write_text(text, encoding="utf-8")
    before = sha256(out)
    settings = rt.StudyPlan(sources=("dt", "ibg_rg"), runs=1, per_class=6, folds=2, seed=3)
    with pytest.raises(rt.InputError) as refusal:
        rt.run_study(case, settings, rt.StudyData(real=FILES / "set.npz"), out, processes=1)
    assert str(refusal.value) == (
        "out: expected a new folder, or the folder of the same study, "
        f"got {out}, which holds a study begun by another version of retwin"
        f"{version and ' '}{version}; give a new folder, or finish the study with that version"
    )
    assert sha256(out) == before


@pytest.mark.parametrize("finished", [True, False])
def test_a_simulation_is_not_resumed(finished: bool, case: rt.Case, tmp_path: Path) -> None:
    folder = tmp_path / ("a.zarr" if finished else "a.zarr.part")
    if finished:
        shutil.copytree(FILES / "simulated.zarr", folder)
    else:
        folder.mkdir()
        text = json.dumps(read_header(FILES / "simulated.zarr")["plan"])
        (folder / "plan.json").write_text(text, encoding="utf-8")
    before = sha256(folder)
    with pytest.raises(rt.InputError) as refusal:
        simulate_to(tmp_path / "a.zarr", plan(case), workers=1)
    assert str(refusal.value) == (
        f"plan: expected the plan that {folder} was begun with, "
        "got one begun by another version of retwin; "
        "give another name, remove that folder, or finish it with that version"
    )
    assert sha256(folder) == before
