"""What the docs show is true: every Python block runs, the notebook too, and the site builds."""

from __future__ import annotations

import ast
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from test_readme import ROOT, blocks, python_of, shown
from typer.testing import CliRunner

import retwin as rt
from retwin.cli import app

DOCS, TESTS = ROOT / "docs", ROOT / "tests"
HERE = ("architecture.md", "data.md", "tanks.md")
"""Pages whose blocks run below, one after the other."""
APART = ("identify.md", "pitfalls.md", "scale.md", "tutorial.md", "twins.md")
"""Pages with a test of their own below."""
SMALL = "--sources dt --per-class 9"
"""What makes the tutorial's study small enough for a test."""
DRIVE = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Drive(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.torque, self.speed, self.inertia = 0.0, 0.0, 0.01
        free = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.tunable}
        self.register_variable(Real("torque", causality=Fmi2Causality.input, start=0.0))
        self.register_variable(Real("inertia", start=0.01, **free))
        self.register_variable(Real("speed", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.speed += step_size * self.torque / self.inertia
        return True
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """An empty module that can be found by its name, as pickle and dataclasses do."""
    made = ModuleType("shown")
    monkeypatch.setitem(sys.modules, "shown", made)
    return made


def run(page: str, into: dict[str, Any], *codes: str) -> dict[str, Any]:
    """The names that Python blocks of a page make: all of them, or these in their place."""
    for code in codes or blocks(DOCS / page, "python"):
        exec(compile(code, f"docs/{page}", "exec"), into)
    return into


def test_no_python_block_is_left_out() -> None:
    """A page that does not run here is run by the test of its subject."""
    texts = [file.read_text("utf-8") for file in TESTS.rglob("*.py") if file != Path(__file__)]
    running = "".join(texts)
    for page in DOCS.glob("*.md"):
        if blocks(page, "python") and page.name not in (*HERE, *APART):
            assert re.search(rf'"{page.name}"|python_of\("{page.stem}"', running), (
                f"no test runs the Python of {page.name}"
            )


@pytest.mark.parametrize("page", HERE)
def test_the_code_of_a_page_runs(page: str, module: ModuleType) -> None:
    names = run(page, vars(module))
    if page == "architecture.md":
        tried = rt.generate(names["case"].twin, names["case"], per_class=20, seed=2)
        assert rt.evaluate(names["nearest"], tried).macro_f1 > 0.8
    if page == "data.md":
        assert [len(names["bench"]), names["bench"].steps] == [2, 1250]
        assert 0.015 < names["bench"].provenance[0].sampling[1].missing < 0.03


def test_the_functions_that_pages_place_in_files_are_there() -> None:
    """Such as "`update/corrected.py`: `CorrectedTwin`", the table of equations above all."""
    for page in DOCS.glob("*.md"):
        for file, name in re.findall(r"`((?:\w+/)+\w+\.py)`: `(\w+)", page.read_text("utf-8")):
            source = (ROOT / "src" / "retwin" / file).read_text("utf-8")
            assert re.search(rf"^ *(def|class) {name}\b", source, re.MULTILINE), (file, name)


def test_what_cannot_be_told_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.warns(UserWarning, match="not identified: motor, gear"):
        names = run("pitfalls.md", {})
    values = names["updated"].values
    assert values["motor"] * values["gear"] == pytest.approx(3, rel=1e-2)
    assert names["hidden"].shape == names["seen"].shape
    assert "not identified: motor, gear" in capsys.readouterr().out


def test_the_page_on_fmus(folder: Path) -> None:
    (folder / "drive.py").write_text(DRIVE, encoding="utf-8")
    build = [sys.executable, "-m", "pythonfmu", "build", "-f", "drive.py", "-d", "."]
    subprocess.run(build, check=True, capture_output=True)
    (folder / "Drive.fmu").rename("drive.fmu")
    (code,) = python_of("twins", "FMU")
    torque = np.ones((2, 50, 1))
    made = run("twins.md", {"__name__": "__main__", "commands": torque}, code)["made"]
    assert made.observed[0, -1, 0] == pytest.approx(49 * 0.01 / 0.02, rel=1e-3)


@pytest.mark.slow
def test_the_page_on_identification(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs are made, the commands run on them, and the result goes to FMPy."""
    damped = DRIVE.replace(
        "self.torque / self", "(self.torque - self.friction * self.speed) / self"
    )
    damped = damped.replace("0.0, 0.0, 0.01\n", "0.0, 0.0, 0.01\n        self.friction = 0.2\n")
    friction = 'self.register_variable(Real("friction", start=0.2, **free))'
    damped = damped.replace(
        "        self.register", f"        {friction}\n        self.register", 1
    )
    (folder / "drive.py").write_text(damped, encoding="utf-8")
    build = [sys.executable, "-m", "pythonfmu", "build", "-f", "drive.py", "-d", "."]
    subprocess.run(build, check=True, capture_output=True)
    (folder / "Drive.fmu").rename("drive.fmu")
    logs, fmpy, python = blocks(DOCS / "identify.md", "python")
    names = run("identify.md", {"__name__": "__main__"}, logs)
    runs = " ".join(f"run{i}.csv" for i in range(5))
    for line, whole in shown(DOCS / "identify.md"):
        # Those of a log and an FMU are in test_log_to_fmu.py.
        if whole and not line.startswith(("fit", "evaluate", "export")) and "run.mcap" not in line:
            words = shlex.split(line.replace("run*.csv", runs))
            result = CliRunner().invoke(app, words, catch_exceptions=False)
            assert result.exit_code == 0, f"retwin {line}: {result.output}"
    found = run("identify.md", names, fmpy)["start_values"]
    assert found == pytest.approx({"inertia": 0.02, "friction": 0.1}, rel=0.05)
    checked = run("identify.md", names, python)["checked"]
    assert checked.outputs[0].validation.after < 0.25


def test_the_page_on_scale(updated: rt.CorrectedTwin, case: rt.Case) -> None:
    """With 60 trajectories in place of a million, and no GPU; the code for Slurm compiles."""
    here, slurm, on_gpu, reading = blocks(DOCS / "scale.md", "python")
    updated.save("twin")
    commands = case.sampler.sample(9, rng=np.random.default_rng(0))
    sent = {"commands": commands, "faults": list(case.faults.values())}
    made = run("scale.md", sent, on_gpu.replace('"cuda"', '"cpu"'))
    assert made["observed"].shape == (9, 1000, 3)
    small = here.replace("n=1_000_000", "n=60")
    assert small != here
    run("scale.md", {"__name__": "__main__"}, small)
    assert len(run("scale.md", {}, reading)["part"]) == 60
    ast.parse(slurm)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
@pytest.mark.filterwarnings("ignore:only .* healthy:UserWarning")
def test_the_tutorial(folder: Path) -> None:
    """Its Python as a notebook, then its commands; the study with fewer sources and data."""
    made = runpy.run_path(str(DOCS / "scripts" / "notebook.py"))["notebook"]()
    nbformat.validate(made)
    NotebookClient(made, timeout=600, resources={"metadata": {"path": str(folder)}}).execute()
    told = "".join(o.get("text", "") for cell in made.cells for o in cell.get("outputs", []))
    assert 0.8 < float(re.search(r"coverage90: ([\d.]+)", told)[1]) <= 1.0
    first, second = (float(score) for score in re.findall(r"macro_f1 ([\d.]+)", told))
    assert first > 3 / 9, "no better than a guess"
    assert second > 0.7

    commands = [line for line, whole in shown(DOCS / "tutorial.md") if whole]
    assert len(commands) >= 5
    for line in sorted(commands, key=lambda line: not line.startswith("study")):
        words = shlex.split(line + " " + SMALL * line.startswith("study"))
        result = CliRunner().invoke(app, words, catch_exceptions=False)
        assert result.exit_code == 0, f"retwin {line}: {result.output}"
    assert (folder / "study" / "report.html").stat().st_size > 5e5  # the plot library alone


def test_every_picture_has_its_script() -> None:
    scripts = "".join(file.read_text("utf-8") for file in (DOCS / "figures").glob("*.py"))
    for picture in (DOCS / "images").iterdir():
        assert f'"{picture.stem}"' in scripts, f"no script in docs/figures makes {picture.name}"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built with every warning an error."""
    target = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(target)]
    told = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, env=told, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return target


@pytest.mark.slow
def test_the_site_needs_no_network(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text("utf-8")
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=\"([^\"]+)", text)
        away = [address for address in loaded if re.match(r"(?:https?:)?//", address)]
        assert not away, f"{page.name} loads {away}"
        assert 'class="mermaid"' not in text, f"{page.name} would load mermaid from elsewhere"


@pytest.mark.slow
def test_search_equations_and_outputs_are_in_the_site(site: Path) -> None:
    assert "var __index" in (site / "search" / "search_index.js").read_text("utf-8")[:20]
    assert (site / "katex" / "katex.min.js").exists()
    theory = (site / "theory.html").read_text("utf-8")
    assert all(rf"\tag{{{number}}}" in theory for number in range(1, 12))
    tutorial = (site / "tutorial.html").read_text("utf-8")
    assert "coverage90: 0." in tutorial
    assert "data:image/png;base64," in tutorial
    arm = (site / "results_arm.html").read_text("utf-8")
    assert "<summary>Table</summary>" in arm


@pytest.mark.slow
def test_the_references_are_whole(site: Path) -> None:
    names = "".join(page.read_text("utf-8") for page in (site / "api").glob("*.html"))
    missing = [name for name in rt.__all__ if f"retwin.{name}" not in names and name[0] != "_"]
    assert not missing
    commands = (site / "cli.html").read_text("utf-8")
    for name in ("demo", "fit", "generate", "study", "data convert", "twin info", "diagnose fit"):
        assert f"retwin {name}" in commands
