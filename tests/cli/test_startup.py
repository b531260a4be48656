"""Start-up: a command that needs no torch imports none, and takes little processor time."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from retwin import cases
from retwin.data.io import save
from retwin.data.trajectories import Trajectories

BARE = "import numpy, pydantic, rich, typer"
COMMAND = f"""
{BARE}
from retwin.cli import main
sys.argv[0] = "retwin"
main()
"""
MEASURED = """
import atexit, json, resource, sys
def report(path=sys.argv.pop(1)):
    who = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    used = [resource.getrusage(each) for each in who]
    seconds = sum(each.ru_utime + each.ru_stime for each in used)
    heavy = sorted({"torch", "lightning", "sklearn"} & set(sys.modules))
    open(path, "w").write(json.dumps([seconds, heavy]))
atexit.register(report)
"""
FACTOR = 12.0
"""Greatest processor time of a command, in multiples of a bare import, which takes 0.14 s.

Most take 2 to 3; a command that imports torch takes
20 and more. The rest is room for a busy machine, on which both times vary.
"""


def measured(code: str, words: tuple[str, ...], folder: Path) -> tuple[int, float, list[str]]:
    """Exit code, seconds of processor time with its children, and heavy packages imported."""
    command = [sys.executable, "-c", MEASURED + code, str(folder / "used.json"), *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    seconds, heavy = json.loads((folder / "used.json").read_text())
    return done.returncode, seconds, heavy


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with sets of trajectories: made.npz, and one of each built-in system."""
    outputs = np.zeros((3, 20, 2))
    made = Trajectories(commands=outputs, nominal=outputs, observed=outputs, rate=10.0)
    save(made, tmp_path / "made.npz")
    for name in ("armpi", "tanks"):
        case = cases.data_case(name)
        arm = {"inputs": case.inputs, "outputs": case.outputs, "rate": case.rate}
        u, y = (np.zeros((3, 20, len(arm[each]))) for each in ("inputs", "outputs"))
        made = Trajectories(commands=u, nominal=y, observed=y, **arm)
        save(made, tmp_path / f"{name.removesuffix('pi')}.npz")
    return tmp_path


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> float:
    """Seconds of processor time of a bare import."""
    return measured(BARE, (), tmp_path_factory.mktemp("bare"))[1]


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("--version",), 0),
        (("--help",), 0),
        (("fit", "--help"), 0),
        (("twin", "info"), 0),
        (("twin", "info", "armpi-kinematic"), 0),
        (("data", "info", "made.npz"), 0),
        (("data", "info", "arm.npz", "--case", "armpi"), 0),
        (("data", "info", "tanks.npz", "--case", "tanks"), 0),
        (("data", "info", "nowhere", "--case", "tanks_overflow"), 2),
        (("data", "convert", "made.npz", "again.npz"), 0),
        (("data", "convert", "--public", "nonsense", "made-again.npz"), 2),
        (("bundle", "verify", "nowhere"), 2),
        (("report", "nowhere"), 2),
        (("doctor",), 0),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_a_command_without_torch_starts_at_once(
    words: tuple[str, ...], code: int, folder: Path, bare: float
) -> None:
    found, seconds, heavy = measured(COMMAND, words, folder)
    assert (found, heavy) == (code, [])
    assert seconds < FACTOR * bare


@pytest.mark.slow
@pytest.mark.parametrize("package", ["torch", "mujoco"])
def test_a_missing_package_is_named_with_what_installs_it(package: str, folder: Path) -> None:
    code = f"import sys; sys.modules[{package!r}] = None{COMMAND}"
    words = ["fit", "armpi", "--real", "arm.npz", "--out", "made"]
    command = [sys.executable, "-c", f"{code}", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert package in done.stderr
    assert "install what retwin needs: pip install" in done.stderr
