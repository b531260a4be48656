"""`retwin bench`: what it computes from times, and what the command prints."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from retwin.cli import bench
from retwin.nets.training import Training


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Time that passes only where a test says so: what a machine really takes is no number."""
    now = [0.0]
    monkeypatch.setattr(bench.time, "perf_counter", lambda: now[0])
    return now


def test_training_is_extrapolated_from_few_epochs(clock: list[float]) -> None:
    asked: list[int] = []

    def fit(how: Training) -> str:
        asked.append(how.max_epochs)
        clock[0] += 0.3 + 0.1 * how.max_epochs
        return "model"

    model, seconds = bench._train_briefly(fit, Training(max_epochs=20))
    assert (model, asked) == ("model", [1, 3])
    assert seconds == pytest.approx(0.3 + 0.1 * 20)


def test_seconds_are_the_median(clock: list[float]) -> None:
    pauses = iter([0.0, 0.2, 0.1])

    def make() -> None:
        clock[0] += next(pauses)

    assert bench.median_seconds(make, 3) == pytest.approx(0.1)


@pytest.mark.slow
def test_the_command(tmp_path: Path) -> None:
    words = ["bench", "--n", "18", "--repeats", "1", "--json", "--out", tmp_path / "a.json"]
    done = subprocess.run(
        [sys.executable, "-m", "retwin", *words], check=True, capture_output=True, text=True
    )
    figures = json.loads(done.stdout)
    assert figures == json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert figures.pop("trajectories") == 18
    ways = {name: each for name, each in figures.items() if each["ratio"] is not None}
    assert list(ways) == [
        "twin",
        "twin_default",
        "corrected",
        "corrected_command",
        "surrogate",
        "closed_form",
    ]
    assert list(figures)[6:] == ["surrogate_learning", "residual", "residual_command", "classifier"]
    for way in ways.values():
        assert way["ratio"] == pytest.approx(way["seconds"] / ways["corrected"]["seconds"])
    assert (ways["twin"]["paper"], ways["corrected"]["paper"]) == (30600, 270)
    assert all(each["seconds"] > 0 for each in figures.values())
