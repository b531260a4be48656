"""JSON documents of samples: what is read from them, and what is refused by name."""

from __future__ import annotations

import json

import numpy as np
import pytest

from retwin.errors import InputError
from retwin.monitor import Samples
from retwin.monitor.store.samples import parse

CHANNELS = {"line1": ("heater", "T1"), "line2": ("T1",)}


def channels(asset: str) -> tuple[str, ...]:
    if asset not in CHANNELS:
        raise InputError("asset", expected="a known one", got=repr(asset), remedy="add it")
    return CHANNELS[asset]


def sample(**changes: object) -> dict[str, object]:
    return {"asset": "line1", "time": 1.7e9, "values": {"heater": 1, "T1": 21.5}, **changes}


def test_objects_arrays_and_lines_are_the_same_samples() -> None:
    given = [sample(), sample(time=1.7e9 + 1), sample(asset="line2", values={"T1": 3})]
    lines = "\r\n".join(json.dumps(each) for each in given)
    for document in (json.dumps(given), lines, lines.encode(), json.dumps(given, indent=1)):
        first, second = parse(document, channels)
        assert (first.asset, second.asset) == ("line1", "line2")
        np.testing.assert_array_equal(first.times, [17 * 10**17, 17 * 10**17 + 10**9])
        np.testing.assert_array_equal(first.values, [[1, 21.5]] * 2)
        np.testing.assert_array_equal(second.values, [[3]])
    (one,) = parse(json.dumps(given[0]), channels)
    assert len(one.times) == 1
    assert parse("[]", channels) == []


def test_absent_null_and_infinite_values_are_missing() -> None:
    text = [{}, {"heater": 1, "T1": None}, {"heater": float("nan"), "T1": float("-inf")}]
    (found,) = parse(json.dumps([sample(values=each) for each in text]), channels)
    np.testing.assert_array_equal(found.values, [[np.nan, np.nan], [1, np.nan], [np.nan, np.nan]])
    (found,) = parse(json.dumps(sample()).replace("21.5", "1e999"), channels)
    assert np.isnan(found.values[0, 1])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"time": 1700000000}, 17 * 10**17),
        ({"time": 0.25}, 25 * 10**7),
        ({"time": "2023-11-14T22:13:20.000001+00:00"}, 17 * 10**17 + 1000),
        ({"time": "2023-11-14T23:13:20+01:00"}, 17 * 10**17),
        ({"time_ns": 17 * 10**17 + 1}, 17 * 10**17 + 1),
    ],
)
def test_times(given: dict[str, object], expected: int) -> None:
    (found,) = parse(json.dumps({"asset": "line2", "values": {}, **given}), channels)
    assert found.times.tolist() == [expected]


@pytest.mark.parametrize(
    "time", [None, True, "noon", "2023-11-14T22:13:20", 1e300, -1e10, 10**400, [1], float("nan")]
)
def test_other_times_are_refused(time: object) -> None:
    with pytest.raises(InputError, match="sample 0: time"):
        parse(json.dumps(sample(time=time)), channels)
    with pytest.raises(InputError, match="sample 0: time"):
        parse(json.dumps({"asset": "line2", "values": {}, "time_ns": 1.5}), channels)


@pytest.mark.parametrize(
    ("document", "what"),
    [
        ("", "samples"),
        (b"\xff\xfe", "samples"),
        ("{", "samples"),
        ("[" * 100_000, "samples"),
        ("3", "sample 0"),
        (json.dumps(sample(more=1)), "sample 0"),
        (json.dumps(sample(time_ns=1)), "time"),
        (json.dumps(sample(asset=["line1"])), "asset"),
        (json.dumps(sample(asset="line3")), "'line3'"),
        (json.dumps(sample(values=[1, 2])), "values"),
        (json.dumps([sample(), sample(values={"T9": 1})]), "sample 1: values.*'T9'"),
        (json.dumps(sample(values={"T1": "21.5"})), "T1"),
        (json.dumps(sample(values={"T1": 10**400})), "T1"),
        (json.dumps([sample(asset="line2", values={})] * 100_001), "at most 100000"),
    ],
)
def test_other_documents_are_refused(document: str | bytes, what: str) -> None:
    with pytest.raises(InputError, match=what):
        parse(document, channels)


def test_samples_have_a_row_for_each_time() -> None:
    with pytest.raises(InputError, match="one row"):
        Samples("a", np.arange(2), np.zeros((3, 1)))
    with pytest.raises(InputError, match="one row"):
        Samples("a", np.arange(2.0), np.zeros((2, 1)))
    given = np.array([[1.0, -np.inf]])
    assert np.isnan(Samples("a", np.arange(1), given).values[0, 1])
    assert np.isinf(given[0, 1])
