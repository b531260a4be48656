"""The example of the promise, on the page of the monitor, runs, and shows what it describes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "monitor.md"


@pytest.mark.slow
def test_the_example_raises_its_alarm_after_the_change(capsys: pytest.CaptureFixture[str]) -> None:
    text = PAGE.read_text("utf-8")
    names: dict[str, Any] = {}
    exec(compile(text.split("```python\n")[2].split("```")[0], str(PAGE), "exec"), names)
    assert names["alarms"]
    assert 200 <= names["alarms"][0] < 240
    assert not names["validity"].void(names["tested"]).any() or len(names["alarms"]) >= 4
    assert "until a false alarm" in capsys.readouterr().out
