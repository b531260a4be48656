"""The examples of the API pages run, and how many public names they show."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest
from test_readme import ROOT, blocks

HERE = ("data", "errors", "nets", "scores")
"""Pages that run here; all run when the site is built (`test_docs.py`), where an error is one."""


@pytest.mark.parametrize("room", HERE)
def test_the_examples_of_a_room_run(
    room: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    module = ModuleType("example")
    monkeypatch.setitem(sys.modules, "example", module)
    codes = blocks(ROOT / "docs" / "examples" / f"{room}.md", "python")
    assert codes
    for code in codes:
        exec(compile(code, room, "exec"), vars(module))


@pytest.mark.slow
def test_each_public_name_has_an_example() -> None:
    rooms = runpy.run_path(str(ROOT / "docs" / "scripts" / "pages.py"))["modules"]()
    missing = []
    for room, names in rooms.items():
        code = "\n".join(blocks(ROOT / "docs" / "examples" / f"{room}.md", "python"))
        missing += [name for name in names if not re.search(rf"\b{name.split('.')[-1]}\b", code)]
    assert not missing, f"without an example in docs/examples: {missing}"
