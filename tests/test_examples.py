"""The examples of the API pages run, and how many public names they show."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest
from test_readme import ROOT, blocks

EXAMPLES = sorted((ROOT / "docs" / "examples").glob("*.md"))
QUICK = ("data", "errors", "twins")
SHOWN = 156
"""Public names with an example, at least; raise it with each that is added."""


@pytest.mark.filterwarnings("ignore:only .* healthy:UserWarning")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=() if page.stem in QUICK else pytest.mark.slow, id=page.stem)
        for page in EXAMPLES
    ],
)
def test_the_examples_of_a_room_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    module = ModuleType("example")
    monkeypatch.setitem(sys.modules, "example", module)
    codes = blocks(page, "python")
    assert codes
    for code in codes:
        exec(compile(code, page.name, "exec"), vars(module))


@pytest.mark.slow
def test_the_number_of_names_with_an_example_does_not_fall() -> None:
    rooms = runpy.run_path(str(ROOT / "docs" / "scripts" / "pages.py"))["modules"]()
    shown = 0
    for room, names in rooms.items():
        page = ROOT / "docs" / "examples" / f"{room}.md"
        code = "\n".join(blocks(page, "python")) if page.exists() else ""
        shown += sum(bool(re.search(rf"\b{name.split('.')[-1]}\b", code)) for name in names)
    assert shown >= SHOWN, f"{shown} of {sum(map(len, rooms.values()))}"
