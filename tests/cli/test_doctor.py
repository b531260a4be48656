"""`retwin doctor`: what is found, what is missing and what to do; only requirements can fail."""

from __future__ import annotations

import json
import os
import re
from importlib import metadata
from pathlib import Path

import pytest

from retwin.catalog import EXTRAS
from retwin.cli import doctor

FOR_DEVELOPERS = {"all", "dev", "docs"}
STATES = {"ok", "warning", "missing", "broken"}


@pytest.fixture
def healthy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    """A machine without data of its own."""
    monkeypatch.setenv("RETWIN_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("RETWIN_DATA", raising=False)
    return monkeypatch


def found(name: str, *, deep: bool = False) -> tuple[str, str, str]:
    """State, what was found and remedy of one check."""
    checks = (*doctor._installation(deep), *doctor._machine(deep), *doctor._data())
    (check,) = (each for each in checks if each[0] == name)
    _, state, words, remedy = check
    return state if remedy else "ok", words, remedy


# Deep, it loads every library of every extra.
DEEP = pytest.param(("--deep",), id="deep", marks=pytest.mark.slow)


@pytest.mark.parametrize("options", [pytest.param((), id="default"), DEEP])
def test_this_very_machine(call, options: tuple[str, ...]) -> None:
    """All of it, drawing too; the tests run, so nothing that is needed can be broken."""
    code, out, err = call("--quiet", "doctor", *options, "--json")
    assert (code, err) == (0, "")
    printed = json.loads(out)
    assert printed.keys() == {"ok", "checks"}
    assert printed["ok"] is True
    for each in printed["checks"]:
        assert each.keys() == {"name", "state", "found", "remedy"}
        assert each["state"] in STATES - {"broken"}
        assert (each["state"] == "ok") == (each["remedy"] == ""), each
    names = [each["name"] for each in printed["checks"]]
    assert len(names) == len(set(names))
    assert {"Python", "torch", "mujoco", "cores", "memory", "GPU", *EXTRAS} < {*names}
    found = {each["name"]: each["found"] for each in printed["checks"]}
    assert found["torch"].startswith(metadata.version("torch"))
    assert ("not loaded" in found["torch"]) == (not options)
    assert ("--deep" in found["GPU"]) == (not options)


def test_every_extra_is_explained() -> None:
    extras = metadata.metadata("retwin").get_all("Provides-Extra") or []
    assert set(extras) - FOR_DEVELOPERS == set(EXTRAS)


def test_a_screen_of_80_columns_says_what_to_do(
    call, healthy: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    healthy.setenv("COLUMNS", "80")
    real = metadata.version
    healthy.setattr(
        "importlib.metadata.version", lambda name: "0.1" if name == "zuko" else real(name)
    )
    code, out, _ = call("doctor")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80
    whole = " ".join(out.split())
    assert re.search(r"missing flows .*zuko is 0.1, and must be .* → pip install", whole)
    assert whole.endswith("retwin works on this machine.")
    assert not (tmp_path / "cache").exists(), "nothing is changed"


def test_what_is_needed_and_missing_is_broken(call, healthy: pytest.MonkeyPatch) -> None:
    real = metadata.version

    def without(name: str) -> str:
        if name in ("jinja2", "dask"):
            raise metadata.PackageNotFoundError(name)
        return real(name)

    healthy.setattr("importlib.metadata.version", without)
    code, out, _ = call("doctor")
    assert code == 1
    whole = " ".join(out.split())
    assert re.search(r'broken jinja2 jinja2 is not installed → pip install "jinja2', whole)
    assert re.search(r'missing scale .*dask is not installed → pip install .*\[scale\]"', whole)
    assert "broken: jinja2; retwin cannot work like this" in whole


@pytest.mark.slow
def test_a_library_that_does_not_load(healthy: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = "raise OSError('libmujoco.so.1: cannot open\\nshared object file')"
    (tmp_path / "mujoco.py").write_text(broken)
    healthy.syspath_prepend(tmp_path)
    healthy.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    assert found("mujoco")[0] == "ok", "it is installed, and not loaded"
    words = "OSError: libmujoco.so.1: cannot open shared object file"
    assert found("mujoco", deep=True) == ("broken", words, "install mujoco-core again")


def test_a_library_that_hangs(healthy: pytest.MonkeyPatch) -> None:
    healthy.setattr(doctor, "IMPORT_TIMEOUT", 0.0)
    assert doctor._run("import numpy") == ("", "no end after 0 s")


def test_few_cores_and_little_memory(healthy: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name, text in {
        "memory.max": str(2**29),
        "memory.current": str(2**28),
    }.items():
        (tmp_path / name).write_text(text)
    healthy.setattr("retwin.serialisation.sizes.CGROUP", tmp_path)
    healthy.setenv("OMP_NUM_THREADS", "64")
    assert found("cores")[0] == "warning"
    assert "OMP_NUM_THREADS=" in found("cores")[2]
    state, words, remedy = found("memory")
    assert (state, words) == ("warning", "0.2 GB free of 0.5")
    assert "--processes 1" in remedy


def test_data_that_are_found(healthy: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert found("RETWIN_DATA")[0] == "missing"
    healthy.setenv("RETWIN_DATA", str(tmp_path / "data"))
    assert "data: demo" in found("RETWIN_DATA")[1]
    (tmp_path / "data").mkdir()
    assert found("RETWIN_DATA")[0] == "ok"
    ((name, known),) = doctor.DOWNLOADS.items()
    assert found(f"public {name}")[::2] == (
        "missing",
        f"retwin data convert --public {name} {name}.npz",
    )
    file = tmp_path / "cache" / known.file
    file.parent.mkdir(parents=True)
    file.write_bytes(b"x")
    assert found(f"public {name}")[0] == "ok"
