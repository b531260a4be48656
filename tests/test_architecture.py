"""The rooms of the package: what may import what, and what each loads."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import retwin
from retwin import catalog

ROOT = Path(retwin.__file__).parent
ROOMS = (
    (
        "_version",
        "_lazy",
        "errors",
        "checks",
        "times",
        "progress",
        "arrays",
        "compiler",
        "workers",
        "serialisation",
        "catalog",
        "results",
    ),
    ("data",),
    ("scores",),
    ("inference",),
    ("twins",),
    ("nets",),
    ("update",),
    ("diagnosis",),
    ("evaluation",),
    ("cases",),
    ("study",),
    ("report",),
    ("deploy",),
    ("monitor",),
    ("cli", "__main__"),
    ("testing",),
)
"""The rooms from the ground up, as docs/architecture.md lists them, and the modules of each."""
ORDER = {module: place for place, modules in enumerate(ROOMS) for module in modules}
FILES = {
    path.relative_to(ROOT).with_suffix("").as_posix().replace("/", "."): path
    for path in sorted(ROOT.rglob("*.py"))
    if path != ROOT / "__init__.py"
}


def imports(path: Path) -> set[str]:
    """The modules of retwin that a file imports, those for type checking included."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{name.name}" for name in node.names}
    names = {name.removeprefix("retwin.") for name in found if name.startswith("retwin.")}
    return {module for name in names if (module := file_of(name))}


def file_of(name: str) -> str:
    """The file that a dotted name is in: a module, or a package's `__init__`."""
    for candidate in (name, f"{name}.__init__"):
        if candidate in FILES:
            return candidate
    parent = name.rpartition(".")[0]
    return file_of(parent) if parent else ""


def place_of(module: str) -> int:
    return ORDER[module.split(".")[0]]


def test_no_room_imports_from_a_room_above_it_and_no_file_in_a_circle() -> None:
    graph = {module: imports(path) for module, path in FILES.items()}
    upwards = [
        f"{module} -> {other}"
        for module, others in graph.items()
        for other in others
        if place_of(other) > place_of(module)
    ]
    assert not upwards
    inside = {
        module: {other for other in others if not other.endswith("__init__")}
        for module, others in graph.items()
    }
    try:
        TopologicalSorter(inside).prepare()
    except CycleError as error:
        pytest.fail(f"imports in a circle: {' <- '.join(error.args[1])}")


def test_only_the_command_line_calls_the_package_by_its_public_names() -> None:
    for module, path in FILES.items():
        if place_of(module) < ORDER["cli"]:
            assert "import retwin as rt" not in path.read_text("utf-8"), module


def test_every_room_states_what_belongs_there() -> None:
    for folder in {path.parent for path in FILES.values()} - {ROOT}:
        text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8")))
        assert text, folder
        if folder.parent == ROOT:
            words = " ".join(text.split())
            assert "Belongs here:" in words, folder
            assert "Not here:" in words, folder


def test_every_folder_is_in_the_picture_of_the_rooms() -> None:
    page = ROOT.parents[1] / "docs" / "architecture.md"
    listed = set(re.findall(r"^ +(\w+)/ ", page.read_text("utf-8"), re.MULTILINE))
    assert {path.parent.name for path in FILES.values()} - {ROOT.name} <= listed


def test_only_cases_know_a_robot() -> None:
    for module, path in FILES.items():
        if place_of(module) < ORDER["cases"] and module != "catalog.__init__":
            assert not re.search(r"retwin[.]cases|armpi", path.read_text("utf-8")), module


def test_the_ground_needs_no_torch() -> None:
    modules = [f"retwin.{name}" for name in FILES if place_of(name) == 0]
    code = (
        "import importlib, sys\n"
        f"for name in {modules}: importlib.import_module(name.removesuffix('.__init__'))\n"
        "assert not {'torch', 'sklearn', 'scipy', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def targets() -> list[str]:
    """Every dotted name that the catalog holds."""
    entries = [
        entry
        for value in vars(catalog).values()
        if isinstance(value, dict)
        for entry in value.values()
        if is_dataclass(entry)
    ]
    values = [getattr(entry, each.name) for entry in entries for each in fields(entry)]
    texts = [part for each in values for part in (each if isinstance(each, tuple) else (each,))]
    return [text for text in texts if isinstance(text, str) and re.match(r"retwin\.\S+:", text)]


def test_the_catalog_names_what_exists() -> None:
    assert len(targets()) > 40
    for target in targets():
        assert catalog.resolve(target) is not None, target


def test_import_loads_no_torch() -> None:
    code = "import sys, retwin; assert not {'torch', 'sklearn'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_is_there() -> None:
    assert len(retwin.__all__) == len(set(retwin.__all__))
    for name in retwin.__all__:
        assert getattr(retwin, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = retwin.nonsense


@pytest.mark.parametrize("name", retwin._ROOMS)
def test_every_name_of_a_room_is_there(name: str) -> None:
    room = getattr(retwin, name)
    assert room.__all__
    assert len(room.__all__) == len(set(room.__all__))
    assert set(room.__all__) <= set(dir(room))
    for each in room.__all__:
        assert getattr(room, each) is not None
        assert f"{name}.{each}" not in FILES, "also the name of a module"
        assert f"{name}.{each}.__init__" not in FILES, "also the name of a package"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = room.nonsense
    homes = getattr(room, "_HOME", {})
    assert list(homes) == sorted(homes)


def test_a_room_holds_the_names_of_the_package_that_are_defined_there() -> None:
    for name, home in retwin._HOME.items():
        room = home.split(".")[0]
        if room in retwin._ROOMS:
            assert getattr(getattr(retwin, room), name) is getattr(retwin, name), name


def test_the_table_of_public_names_is_sorted_and_agrees_with_the_stub() -> None:
    assert list(retwin._HOME) == sorted(retwin._HOME)
    assert list(retwin._ROOMS) == sorted(retwin._ROOMS)
    tree = ast.parse((ROOT / "__init__.pyi").read_text("utf-8"))
    static = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    assert all(alias.name == alias.asname for node in static for alias in node.names)
    homes = {
        alias.name: str(node.module).removeprefix("retwin").removeprefix(".")
        for node in static
        for alias in node.names
    }
    assert homes == {**retwin._HOME, **dict.fromkeys(retwin._ROOMS, "")}


@pytest.mark.slow
def test_rooms_open_their_modules_when_used() -> None:
    code = (
        "import sys, retwin as rt\n"
        "assert rt.update.identification.identify is rt.identify\n"
        "assert rt.scores.energy.energy_score\n"
        "try: rt.update.nonsense\n"
        "except AttributeError: pass\n"
        "else: raise AssertionError"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
