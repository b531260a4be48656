"""Whole studies, in a file of their own so that they run in parallel with other tests."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small import small_case

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC
from retwin.catalog import SOURCES
from retwin.study import possible_sources
from retwin.twins.wrappers.command_side import CommandSide, command_side_parameters
from retwin.twins.wrappers.parametric import ParametricTwin

pytestmark = pytest.mark.slow


@pytest.mark.slow
def test_every_source_is_made(
    emulated: rt.Trajectories, twin_set: rt.Trajectories, tmp_path: Path
) -> None:
    """All fourteen, small: each predicts every trajectory and reports its costs."""
    free = command_side_parameters(KINEMATIC.inputs, delay=(0.0, 0.2), offset=25.0)
    quick = ParametricTwin(CommandSide(KINEMATIC, nominal=KINEMATIC.position), free)
    case = replace(small_case(), parametric=quick)
    place = np.array([np.flatnonzero(emulated.labels == name)[:5] for name in case.classes])
    parts = {
        "twin": twin_set,
        "calibration": emulated[place[:, :3].ravel()],
        "test": emulated[place[:, 3:].ravel()],
    }
    for name, part in parts.items():
        rt.save(part, tmp_path / f"{name}.npz")
    data = rt.StudyData(**{name: tmp_path / f"{name}.npz" for name in parts})
    plan = rt.StudyPlan(runs=1, per_class=10, seed=3)
    plan = replace(plan, sources=possible_sources(case, plan))
    diagnosing = [name for name, source in SOURCES.items() if not source.simulates]
    for name in ("dynamics", "inversion_dynamics"):
        diagnosing.remove(name)  # the arm's twin has no state equations
    assert list(plan.sources) == diagnosing
    results = rt.run_study(case, plan, data, tmp_path / "all", processes=2)
    untouched = ("dt", "randomised", "dann", "dann_transductive")
    for name, source in results.sources.items():
        assert np.array(source.predictions).shape == (1, 18)
        assert source.twin_runs > 0, name
        assert (source.update_s > 0) == (name not in untouched)
    inversion = results.sources["inversion"]
    assert inversion.runs("macro_f1")[0] > 0.8, "it needs no training set"
    assert inversion.generate_s is None
    assert inversion.predict_s > 0
    assert rt.write_report(tmp_path / "all").stat().st_size < 10_000_000


@pytest.mark.real_data
@pytest.mark.skipif(
    "RETWIN_DATA" not in os.environ, reason="RETWIN_DATA names the folder of the real data"
)
def test_the_whole_job_runs_on_the_public_files(case: rt.Case, tmp_path: Path) -> None:
    """The published twin (a tenth of it) and the real robot, commands recovered, two folds."""
    arm = Path(os.environ["RETWIN_DATA"]) / "armpi"
    real = next(f for n in ("real_a.mat", "my_dataset_test.mat") if (f := arm / n).exists())
    rt.save(rt.load(arm / "sim.mat", rate=100.0)[::10], tmp_path / "sim.npz")
    plan = rt.StudyPlan(sources=("dt", "ibg_rg"), runs=1, folds=2, per_class=40)
    data = rt.StudyData(twin=tmp_path / "sim.npz", real=real)
    results = rt.run_study(case, plan, data, tmp_path / "out", processes=1)
    assert results.emulated is False
    assert results.published["ibg_rg"]["healthy_recall"] == "0.62"
    assert results.sources["ibg_rg"].runs("auroc")[0] > 0.8
    assert rt.write_report(tmp_path / "out").stat().st_size < 10_000_000
