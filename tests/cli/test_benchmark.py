"""`retwin bench`: what the command prints."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest


@pytest.mark.slow
def test_the_command() -> None:
    words = ["bench", "--n", "18", "--repeats", "1", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "retwin", *words], check=True, capture_output=True, text=True
    )
    figures = json.loads(done.stdout)
    assert figures.pop("trajectories") == 18
    ways: dict[str, dict[str, float]] = figures
    assert list(ways) == [
        "twin",
        "twin_default",
        "corrected",
        "corrected_command",
        "surrogate",
        "closed_form",
    ]
    for way in ways.values():
        assert way["ratio"] == pytest.approx(way["seconds"] / ways["corrected"]["seconds"])
    assert (ways["twin"]["paper"], ways["corrected"]["paper"]) == (30600, 270)
    assert all(each["seconds"] > 0 for each in ways.values())
