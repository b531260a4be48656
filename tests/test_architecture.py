"""The house stands: a module imports only from floors below its own."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import retwin

ROOT = Path(retwin.__file__).parent
# From the ground up, as docs/architecture.md draws it.
FLOORS = [
    "errors",
    "configs",
    "processes",
    "arrays",
    "trajectories",
    "storage",
    "download",
    "models",
    "segments",
    "commands",
    "faults",
    "twins",
    "state_space",
    "networks",
    "training",
    "lines",
    "surrogate",
    "mixture",
    "flows",
    "corrections",
    "residual",
    "case",
    "animation",
    "corrected",
    "updating",
    "scale",
    "diagnosis",
    "testing",
    "statistics",
    "fidelity",
    "bundle",
    "study",
    "report",
    "cases",
    "bench",
    "doctor",
    "cli",
]
ONE_ROOM = {"__main__": "cli"}
MODULES = sorted(p for p in ROOT.rglob("*.py") if p != ROOT / "__init__.py")


def floor_of(dotted: str) -> int:
    room = dotted.split(".")[1]
    return FLOORS.index(ONE_ROOM.get(room, room))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_only_from_below(path: Path) -> None:
    own = floor_of("retwin." + path.relative_to(ROOT).with_suffix("").as_posix().replace("/", "."))
    imported = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("retwin."):
            imported.append(node.module)
        elif isinstance(node, ast.ImportFrom) and node.module == "retwin":
            imported += [f"retwin.{name.name}" for name in node.names]
    for dotted in imported:
        if dotted == "retwin.__version__":
            continue
        assert floor_of(dotted) <= own, f"{path.name} reaches up to {dotted}"


def test_only_cases_and_twins_know_a_robot() -> None:
    for path in MODULES:
        if path.relative_to(ROOT).parts[0] in ("cases", "twins", "cli"):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                assert "armpi" not in node.module, path
                assert node.module not in ("retwin.twins.arm", "retwin.twins.emulated"), path


def test_import_loads_no_torch() -> None:
    code = "import sys, retwin; assert not {'torch', 'lightning', 'sklearn'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_is_there() -> None:
    assert len(retwin.__all__) == len(set(retwin.__all__))
    for name in retwin.__all__:
        assert getattr(retwin, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = retwin.nonsense
