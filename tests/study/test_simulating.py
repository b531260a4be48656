"""A study of a case without classes: twins simulate test records, nothing is diagnosed."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.cases.case import Case
from retwin.cli import _run
from retwin.nets.networks import LSTM
from retwin.nets.training import Training
from retwin.report import write_report
from retwin.study import possible_sources
from retwin.study.files import Roles
from retwin.study.pool import run_jobs
from retwin.study.progress import Stages
from retwin.study.work import Work
from retwin.twins.function import FunctionTwin
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin
from retwin.update.corrections import Additive
from retwin.update.residual import SequenceMixture

STEPS, RATE = 120, 2.0
INPUTS, OUTPUTS = rt.Channels(("valve",), ("%",)), rt.Channels(("level",), ("m",))
SHORT = Training(max_epochs=8, batch_size=8, learning_rate=1e-2)
LONGER = Training(max_epochs=40, batch_size=4, learning_rate=2e-2)


def lag(commands: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """A first-order lag of 5 s."""
    share = 1 - np.exp(-1 / (5 * RATE))
    out, now = np.empty_like(commands), np.zeros_like(commands[:, 0])
    for sample in range(commands.shape[1]):
        now = now + share * (gain * commands[:, sample] - now)
        out[:, sample] = now
    return out


@dataclass(frozen=True)
class Lag:
    """The same with its gain to be set; satisfies TakesParameters."""

    gain: float = 1.0
    inputs = INPUTS
    outputs = OUTPUTS
    rate = RATE

    def simulate(self, commands, *, faults=None, seed, progress=None, parameters=None):
        gain = np.broadcast_to((parameters or {}).get("gain", self.gain), len(commands))
        twin = FunctionTwin(lag, self.inputs, self.outputs, self.rate)
        made = twin.simulate(commands * gain[:, None, None], faults=faults, seed=seed)
        return made.replace(commands=commands)


@dataclass(frozen=True)
class Steps:
    """Commands that are constant for ten samples each."""

    steps: int = STEPS
    rate = RATE

    def sample(self, count, *, rng, onsets=None):
        return np.repeat(rng.uniform(0, 1, (count, self.steps // 10, 1)), 10, axis=1)


def plant() -> Case:
    """A lag whose real gain is 1.3 and whose twin has 1."""
    twin = Lag()
    return Case(
        name="plant",
        title="A plant",
        faults={"Healthy": None},
        twin=twin,
        emulator=None,
        sampler=Steps(),
        correction=Additive(),
        output_correction=Additive(),
        sensor_rate=RATE,
        parametric=ParametricTwin(twin, (Parameter("gain", "1", 0.5, 2.0, 1.0),)),
        network=LSTM(8),
        training=SHORT,
        density=SequenceMixture(members=2, network=LSTM(8), training=LONGER, window=60, burn_in=10),
    )


def measured(count: int, seed: int) -> rt.Trajectories:
    rng = np.random.default_rng(seed)
    commands = Steps().sample(count, rng=rng)
    nominal = Lag().simulate(commands, seed=0).nominal
    noise = rng.normal(scale=0.02, size=nominal.shape)
    return rt.Trajectories(
        commands=commands,
        nominal=nominal,
        observed=lag(commands, gain=1.3) + noise,
        rate=RATE,
        ids=np.array([f"record {i}" for i in range(count)]),
        inputs=INPUTS,
        outputs=OUTPUTS,
    )


def in_two(path: Path) -> tuple[rt.Trajectories, rt.Trajectories]:
    both = rt.load(path)
    return both[:4], both[4:]


PLAN = rt.StudyPlan(
    sources=("twin", "ibg", "pi_ls", "mean_corrected", "ibg_rg", "pi_ls_rg", "fit"),
    runs=1,
    per_class=40,
    folds=2,
    seed=1,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of six records in two folds."""
    out = tmp_path_factory.mktemp("plant")
    rt.save(measured(6, seed=5), out / "real.npz")
    study = out / "study"
    rt.run_study(plant(), PLAN, rt.StudyData(real=out / "real.npz"), study, processes=1)
    return study


@pytest.mark.slow
def test_results_hold_simulations_instead_of_diagnoses(folder: Path) -> None:
    results = json.loads((folder / "results.json").read_text("utf-8"))
    assert results["classes"] == []
    assert results["classifier"] == ""
    sources = results["sources"]
    for source in sources.values():
        assert "macro_f1" not in source
        assert len(source["rmse"]) == 1
        low, high = source["intervals"]["rmse"]
        assert low <= np.mean(source["rmse"]) <= high
    assert sources["twin"]["coverage90"] == [None], "a deterministic twin has no bands"
    # The gain explains all but the noise; the residual model has to learn it.
    assert np.mean(sources["pi_ls"]["rmse"]) == pytest.approx(0.02, abs=0.004)
    assert np.mean(sources["fit"]["rmse"]) == pytest.approx(0.02, abs=0.004)
    assert 0.8 <= np.mean(sources["fit"]["coverage90"]) <= 0.98
    assert np.mean(sources["ibg_rg"]["rmse"]) < 0.7 * np.mean(sources["ibg"]["rmse"])
    assert np.mean(sources["ibg_rg"]["coverage90"]) > 0.6
    assert sources["twin"]["twin_runs"] == 0
    assert not any("satisfied" in note for each in sources.values() for note in each["notes"])
    assert sources["pi_ls_rg"]["twin_runs"] > sources["pi_ls"]["twin_runs"] > 0
    assert {row["metric"] for row in results["comparisons"]} == {"rmse", "nrmse", "crps"}
    pair = [row for row in results["comparisons"] if (row["a"], row["b"]) == ("pi_ls", "twin")]
    assert all(row["bootstrap_ci95"][1] < 0 for row in pair)
    assert results["fidelity"]["ibg_rg"]["trajectories"] == 6


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    from distributed import LocalCluster

    data = rt.StudyData(real=folder.parent / "real.npz")
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        victims = [worker.pid for worker in cluster.workers.values()]

        def kill(stage: str, share: float) -> None:
            if 0.3 < share < 0.8 and len(victims) == 2:
                os.kill(victims.pop(), signal.SIGKILL)

        address = cluster.scheduler_address
        rt.run_study(plant(), PLAN, data, tmp_path / "study", scheduler=address, report=kill)
        with pytest.raises(rt.InputError, match="none with a scheduler"):
            rt.run_study(plant(), PLAN, data, tmp_path / "study", processes=2, scheduler=address)
        (tmp_path / "other").mkdir()
        rt.save(measured(6, seed=5), tmp_path / "other/real.npz")
        work = Work(tmp_path / "other", plant(), PLAN, Roles.of([((0, 1, 2), (3, 4, 5))]))
        with pytest.raises(rt.InputError, match=r"see at the same path.*no such file"):
            run_jobs(work, 1, Stages(lambda stage, share: None), address)
    assert len(victims) == 1
    with np.load(tmp_path / "study/arrays.npz") as made, np.load(folder / "arrays.npz") as wanted:
        assert made.files == wanted.files
        for name in wanted.files:
            assert made[name].tobytes() == wanted[name].tobytes(), name


@pytest.mark.slow
def test_figures_agree_with_the_arrays(folder: Path) -> None:
    results = json.loads((folder / "results.json").read_text("utf-8"))
    with np.load(folder / "arrays.npz") as arrays:
        error = arrays["simulation/ibg_rg/mean"] - arrays["simulation/observed"]
        bands = arrays["simulation/ibg_rg/bands"]
        inside = (bands[:, 0] <= arrays["simulation/observed"]) & (
            arrays["simulation/observed"] <= bands[:, 4]
        )
        assert "simulation/twin/bands" not in arrays
        assert arrays["simulation/ids"].tolist() == results["data"]["test"]["ids"]
    found = results["sources"]["ibg_rg"]
    assert found["rmse"][0] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-3)
    assert found["coverage90"][0] == pytest.approx(inside.mean(), abs=0.01)


@pytest.mark.slow
def test_sections_that_need_labels_disappear(folder: Path) -> None:
    page = write_report(folder).read_text("utf-8")
    for section in ("confusion", "roc"):
        assert f'<section id="{section}">' not in page
    for section in ("scores", "simulation", "fidelity", "time"):
        assert f'<section id="{section}">' in page
    assert ">RMSE</abbr>, mm</th>" in page
    assert "No verdict, since a verdict over records needs at least 8 of them" in page
    assert "other stretches of the same test records" in page
    assert rt.write_report(folder, figures=True).read_text("utf-8") == page
    assert (folder / "figures" / "simulation.png").exists()


@pytest.mark.slow
def test_a_case_may_split_its_file_itself(tmp_path: Path) -> None:
    rt.save(measured(5, seed=5), tmp_path / "file.npz")
    split = replace(plant(), records=in_two)
    plan = replace(PLAN, sources=("twin", "ibg"))
    data = rt.StudyData(records=tmp_path / "file.npz")
    results = rt.run_study(split, plan, data, tmp_path / "study", processes=1)
    assert results.data.test.ids == ["record 4"]
    assert results.data.calibration.n == 4
    low, high = results.sources["twin"].interval("rmse")
    assert low < results.sources["twin"].runs("rmse")[0] < high, "blocks of the one record"
    with pytest.raises(rt.InputError, match="a case that declares how its file is split"):
        rt.run_study(plant(), plan, data, tmp_path / "other", processes=1)


def test_which_sources_are_possible(case: rt.Case) -> None:
    assert "ibg_rg_command" not in possible_sources(plant(), PLAN), "it is the same as ibg_rg"
    assert not {"dt", "dann", "inversion"} & set(possible_sources(plant(), PLAN))
    assert {"twin", "pi_ls_rg", "randomised"} <= set(possible_sources(plant(), PLAN))
    assert not {"twin", "pi_ls_rg"} & set(possible_sources(case, rt.StudyPlan()))
    assert "dt" in possible_sources(case, rt.StudyPlan())


def test_sources_of_the_other_kind_are_refused(tmp_path: Path, capsys, monkeypatch) -> None:
    (tmp_path / "data.csv").touch()
    command = f"retwin study tanks --sources dt --data {tmp_path}/data.csv --out {tmp_path}/out"
    monkeypatch.setattr("sys.argv", command.split())
    assert _run() == 2
    assert "a case with classes" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
