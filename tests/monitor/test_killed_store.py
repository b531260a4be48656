"""Processes that store a stream and are killed: nothing acknowledged is lost or counted twice."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = ("killing.py", "killing_live.py")


@pytest.mark.parametrize(
    "kills",
    [pytest.param(5, marks=pytest.mark.slow), pytest.param(200, marks=pytest.mark.long)],
)
@pytest.mark.parametrize("database", ["sqlite", "postgresql"])
@pytest.mark.parametrize("script", SCRIPTS)
def test_kills(
    script: str, database: str, kills: int, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    url = request.getfixturevalue("new_database")() if database == "postgresql" else ""
    command = [
        sys.executable,
        str(Path(__file__).with_name(script)),
        str(tmp_path),
        url,
        str(kills),
        "0",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert f"{kills} kills" in done.stderr
