"""`retwin next`: what it prints and saves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import retwin as rt


@pytest.mark.slow
def test_the_command_saves_commands_and_says_what_they_narrow(
    updated: rt.CorrectedTwin, emulated: rt.Trajectories, call, tmp_path: Path
) -> None:
    updated.save(tmp_path / "model")
    rt.save(emulated, tmp_path / "real.npz")
    words = ("next", "armpi", tmp_path / "model", "--real", tmp_path / "real.npz")
    how = ("--count", 2, "--candidates", 10)
    code, printed, err = call(*words, "--out", tmp_path / "next.npz", *how, "--json")
    assert code == 0, err
    said = json.loads(printed)
    assert [each["trajectories"] for each in said["chosen"]] == [10, 11, 12]
    made = rt.load(tmp_path / "next.npz")
    assert made.commands.shape[0] == 2
    assert not made.mask.any()
    code, _, err = call(*words, "--out", tmp_path / "next.txt")
    assert (code, "--out" in err) == (2, True), err
