"""Poses in the report: there with their arrays, absent without, refused when they do not fit."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import retwin as rt
from retwin.errors import InputError
from retwin.report.blocks import Plot
from retwin.report.page import render
from retwin.report.poses import poses
from retwin.report.results import read_results
from retwin.study.files import Roles
from retwin.study.results import _poses
from retwin.study.work import Work

Study = tuple[dict[str, Any], dict[str, NDArray]]
Write = Callable[[Study], Path]
MOMENTS, POINTS = 21, 4


def plot_of(folder: Path) -> Plot:
    section = poses(read_results(folder))
    assert section is not None
    (plot,) = section.blocks
    assert isinstance(plot, Plot)
    return plot


def test_section_is_there_with_its_arrays(study: Study, write: Write) -> None:
    folder = write(study)
    page = render(read_results(folder), {})
    assert '<section id="poses">' in page
    assert "an inference and not a measurement" in page
    plot = plot_of(folder)
    assert [panel.title for panel in plot.panels] == ["Healthy", "M1 bias"]
    assert "0 mm apart" in plot.panels[0].note
    assert "10 mm apart" in plot.panels[1].note
    spec = plot.panels[1].spec
    assert len(spec["frames"]) == len(spec["layout"]["sliders"][0]["steps"]) == MOMENTS
    assert spec["layout"]["sliders"][0]["steps"][-1]["label"] == "2.0"
    last = spec["frames"][-1]["data"]
    np.testing.assert_allclose(last[1]["y"][-1] - last[0]["y"][-1], 0.01, atol=1e-4)
    assert len(last[0]["x"]) == POINTS
    shown = {trace["line"]["color"] for trace in spec["data"]}
    assert shown == {"@observed", "@c0"}, "colours that the page looks up for its theme"


def test_section_disappears_without_its_arrays(study: Study, write: Write) -> None:
    del study[1]["pose/rate"]
    assert "In space" not in render(read_results(write(study)), {})


def test_emulated_poses_say_so(study: Study, write: Write) -> None:
    study[0]["emulated"] = True
    assert plot_of(write(study)).caption.startswith("Emulated robot, no real measurements.")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("pose/observed", np.zeros((2, MOMENTS, POINTS - 1, 3))),
        ("pose/nominal", np.zeros((2, MOMENTS, POINTS, 2))),
        ("pose/nominal", np.full((2, MOMENTS, POINTS, 3), np.nan)),
        ("pose/ids", np.array(["one"])),
        ("pose/rate", np.array(0.0)),
    ],
)
def test_poses_that_do_not_fit(study: Study, write: Write, name: str, value: NDArray) -> None:
    study[1][name] = value
    with pytest.raises(InputError, match="pose/"):
        read_results(write(study))


def test_what_a_study_keeps(case: rt.Case, twin_set: rt.Trajectories, tmp_path: Path) -> None:
    work = Work(tmp_path, case, rt.StudyPlan(), Roles(()))
    kept = _poses(work, twin_set)
    ids = twin_set.ids.tolist()
    labels = [str(twin_set.labels[ids.index(name)]) for name in kept["pose/ids"]]
    assert labels[0] == "Healthy"
    assert len(set(labels)) == len(labels) == 3
    rate = float(kept["pose/rate"])
    assert rate == case.sensor_rate
    every = round(twin_set.rate / rate)
    for name, path in (("pose/nominal", twin_set.nominal), ("pose/observed", twin_set.observed)):
        assert kept[name].shape[0] == 3
        tips = np.stack([path[ids.index(each), ::every] for each in kept["pose/ids"]])
        np.testing.assert_allclose(kept[name][:, :, -1], tips, atol=2e-3)
    size = len(json.dumps({name: value.tolist() for name, value in kept.items()}))
    assert size < 1e6
