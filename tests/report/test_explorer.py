"""The explorer: all test trajectories in the page, and refused where they do not fit."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import retwin as rt
from retwin.errors import InputError
from retwin.evaluation.fidelity.overlay import Overlay
from retwin.report.sections.explorer import packed
from retwin.report.study import read_study
from retwin.study.files import Roles
from retwin.study.results import _overlay_arrays
from retwin.study.work import Work

Study = tuple[dict[str, Any], dict[str, NDArray]]
Write = Callable[[Study], Path]


def unpacked(code: dict[str, Any]) -> NDArray:
    """What the page's script does."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(code["codes"])), np.uint8)
    low, high = planes.reshape(2, -1).astype(np.uint16)
    change = (low + 256 * high).astype(np.uint16).reshape(code["shape"])
    codes = np.cumsum(change, axis=code["axis"], dtype=np.uint16)
    values = code["low"] + code["step"] * codes.astype(float)
    return np.where(codes == 65535, np.nan, values)


def content_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="explorer-content">(.*?)</script>', page)
    assert found is not None
    content: dict[str, Any] = json.loads(found[1])
    return content


def test_all_trajectories_are_in_the_page(
    study: Study, write: Write, rendered: Callable[[Path], str]
) -> None:
    results, arrays = study
    content = content_of(rendered(write(study)))
    assert content["ids"] == results["data"]["test"]["ids"]
    assert [content["classes"][k] for k in content["truth"][::10]][:2] == ["Healthy", "M1 stuck"]
    observed = unpacked(content["observed"])
    expected = 1000 * arrays["portrait/observed"]
    np.testing.assert_allclose(observed, expected, atol=content["observed"]["step"])
    np.testing.assert_allclose(
        unpacked(content["probabilities"]),
        np.array(
            [arrays[f"probabilities/{name}"].mean(axis=0) for name in ("dt", "ibg", "ibg_rg")]
        ),
        atol=1e-4,
    )
    assert content["inputs"]["units"] == ["deg"] * 4
    np.testing.assert_allclose(unpacked(content["commands"])[0, 0], 0.24 * 400, atol=0.01)
    latent = content["latent"]
    assert (latent["names"], latent["units"]) == (["delay", "offset motor 1"], ["ms", "deg"])
    assert latent["z"][0][1][0] is None
    pose = unpacked(content["pose"]["observed"]) - unpacked(content["pose"]["nominal"])
    np.testing.assert_allclose(pose[1, :, -1, 1], 0.01, atol=3e-4)


def test_packed_numbers_come_back() -> None:
    values = np.array([[-3.0, np.nan], [0.25, 1e4]])
    for axis in (0, 1):
        code = packed(values, axis)
        np.testing.assert_allclose(unpacked(code), values, atol=code["step"])
    np.testing.assert_array_equal(unpacked(packed(np.full(3, 2.5))), 2.5)
    assert np.isnan(unpacked(packed(np.full(3, np.nan)))).all()


def test_what_is_not_there_is_left_out(
    study: Study, write: Write, rendered: Callable[[Path], str]
) -> None:
    for name in ("pose/nominal", "pose/observed"):
        del study[1][name]
    page = rendered(write(study))
    assert content_of(page)["pose"] is None
    assert "explore-pose" not in page.split("<script")[0]
    assert "an inference and not a measurement" not in page
    del study[0]["portrait"]
    page = rendered(write(study))
    assert '<section id="explorer">' not in page
    assert "explorer-content" not in page


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("portrait/bands", np.zeros((90, 4, 21, 3))),
        ("portrait/bands", np.full((90, 5, 21, 3), np.nan)),
        ("portrait/bands", np.zeros((89, 5, 21, 3))),
        ("portrait/commands", np.zeros((90, 21, 3))),
        ("portrait/observed", np.zeros((90, 20, 3))),
        ("portrait/z", np.zeros((90, 2, 3))),
        ("portrait/times", np.zeros((90, 2))),
        ("portrait/rate", np.zeros(2)),
        ("pose/observed", np.zeros((90, 21, 4, 2))),
        ("pose/updated", np.zeros((90, 20, 4, 3))),
    ],
)
def test_arrays_that_do_not_fit(study: Study, write: Write, name: str, value: NDArray) -> None:
    study[1][name] = value
    with pytest.raises(InputError, match=f"^{name}: expected"):
        read_study(write(study))


@pytest.mark.slow
def test_what_a_study_keeps_of_poses(
    case: rt.Case, twin_set: rt.Trajectories, tmp_path: Path
) -> None:
    some = twin_set[::12]
    work = Work(tmp_path, case, rt.StudyPlan(), Roles(()))
    every = round(twin_set.rate / case.sensor_rate)
    bands = np.repeat(some.nominal[:, None, ::every], 5, axis=1)
    unknown = np.full((len(some), 1, 1), np.nan)
    backwards = slice(None, None, -1)  # overlays have an order of their own
    overlay = Overlay(
        rt.Channels((), ()), some.ids[backwards], bands[backwards], unknown, unknown, unknown
    )
    kept = _overlay_arrays(work, some, overlay)
    for name, path in (
        ("pose/nominal", some.nominal),
        ("pose/observed", some.observed),
        ("pose/updated", some.nominal),
    ):
        assert kept[name].shape[:2] == (len(some), -(-some.steps // every))
        np.testing.assert_allclose(kept[name][:, :, -1], path[:, ::every], atol=2e-3)
