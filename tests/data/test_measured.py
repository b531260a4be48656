"""Measurements from which nothing, or something wrong, is learned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.data.measured import stand_in
from retwin.data.quality.check import doubtful

RNG = np.random.default_rng(0)
LEVEL = 20 + 5 * np.sin(np.arange(200) / 9) + RNG.normal(0, 0.1, 200)


def record(level: np.ndarray) -> rt.Trajectories:
    pump, unit = rt.Channels(("pump",), ("V",)), rt.Channels(("level",), ("m",))
    shape = (1, len(level), 1)
    return rt.Trajectories(
        commands=np.ones(shape),
        nominal=np.zeros(shape),
        observed=np.reshape(level, shape),
        rate=1.0,
        inputs=pump,
        outputs=unit,
    )


def coded(code: float, every: int = 7) -> np.ndarray:
    return np.where(np.arange(200) % every == 0, code, LEVEL)


@pytest.mark.parametrize("code", [-9999.0, 850.0, 65535.0])
def test_a_code_for_missing_values_is_found(code: float) -> None:
    assert stand_in(coded(code)) == (code, 29)
    assert f"{code:g} at 29 samples" in doubtful(record(coded(code)))


@pytest.mark.parametrize(
    "values",
    [
        LEVEL,
        coded(-9999.0, every=100),  # twice: two glitches
        coded(30.0),  # saturated
        np.where(np.arange(200) % 7 == 0, 1000.0, 20.0),  # a switch
        np.full(200, np.nan),
    ],
)
def test_other_values_are_measurements(values: np.ndarray) -> None:
    assert stand_in(values) is None


def test_a_sensor_that_never_changes_is_named() -> None:
    assert "level, never changes" in doubtful(record(np.full(50, 20.0)))
    assert doubtful(record(LEVEL)) == ""


def test_a_log_notes_the_code(tmp_path: Path) -> None:
    rows = [f"{t},{1 + t // 50},{value:.2f}" for t, value in enumerate(coded(-9999.0))]
    (tmp_path / "log.csv").write_text("\n".join(["time,pump,level", *rows]) + "\n")
    mapping = "rate = 1\n[commands.pump]\nsignal = 'pump'\n[outputs.level]\nsignal = 'level'\n"
    (tmp_path / "mapping.toml").write_text(mapping)
    found = rt.load(tmp_path / "log.csv", mapping=tmp_path / "mapping.toml")
    level = {each.channel: each for each in found.provenance[0].sampling}["level"]
    assert "29 values of -9999, far from all others" in str(level)
