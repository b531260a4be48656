"""Ctrl-C, the real signal: a line says how to go on, and what was finished is there."""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from retwin.cli.terminal import interrupted_by_term
from retwin.serialisation.places import in_use


@pytest.mark.slow
def test_a_study_goes_on(call, start, own: Path) -> None:
    words = (
        *("study", "reach.toml", "--real", "real.npz", "--folds", 2, "--sources", "dt,ibg"),
        *("--runs", 1, "--per-class", 12, "--processes", 1, "--out", "a study"),
    )
    results = own / "a study" / "work"

    def finished() -> dict[Path, int]:
        files = results.glob("run-*/**/model.json")
        return {file: file.stat().st_mtime_ns for file in files}

    line = start(*words).interrupt(lambda: len(finished()) > 0)
    before = finished()
    again = re.search(r"give the same command again to go on: retwin (.*)", line)
    assert again, line
    assert shlex.split(again[1]) == list(map(str, words))
    code, out, err = call(*shlex.split(again[1]))
    assert code == 0, err
    assert "Surrogate only" in out
    after = finished()
    assert len(after) > len(before)
    assert {file: after[file] for file in before} == before, "made twice"


def others(running) -> list[str]:
    """Lines of standard error that state no progress."""
    progress = re.compile(r"\w+: .*%|✓ ")
    return [line for line in running.stderr.splitlines() if not progress.match(line)]


@pytest.mark.slow
def test_a_study_in_use_is_refused_and_all_its_processes_end_in_one_line(
    call, start, own: Path
) -> None:
    words = (
        *("study", "reach.toml", "--real", "real.npz", "--folds", 2, "--sources", "dt,ibg"),
        *("--per-class", 12, "--processes", 2, "--out", "in use"),
    )
    running = start(*words)
    roles = own / "in use" / "work" / "roles.json"
    running.wait(roles.exists)
    code, out, err = call(*words)
    assert (code, out) == (2, "")
    assert "expected a folder that no other process writes to" in err.splitlines()[-1]
    running.interrupt(
        lambda: "diagnosis" in running.stderr or "surrogate" in running.stderr, workers=True
    )
    assert len(others(running)) == 1, running.stderr
    with in_use("in use"):
        assert roles.exists(), "the interrupted study is free to go on"


@pytest.mark.slow
def test_a_simulation_in_use_is_refused_and_all_its_processes_end_in_one_line(
    call, start, own: Path
) -> None:
    words = ("twin", "simulate", "armpi", "--n", 4000, "--workers", 2, "--chunk", 8)
    target = own / "made.zarr"
    running = start(*words, "--out", target)
    running.wait(lambda: any((own / "made.zarr.part" / "done").glob("*.json")))
    code, out, err = call(*words, "--out", target)
    assert (code, out) == (2, "")
    assert "expected a folder that no other process writes to" in err
    running.interrupt(lambda: True, workers=True)
    assert len(others(running)) == 1, running.stderr


@pytest.mark.slow
def test_a_fit_leaves_nothing_half_written(start, own: Path) -> None:
    """In the midst of training, between two epochs or within one."""
    long = (own / "reach.toml").read_text().replace("epochs = 20,", "epochs = 400,")
    (own / "long.toml").write_text(long)
    before = {file.name for file in own.iterdir()}
    words = ("fit", "long.toml", "--real", "real.npz", "--simulations", 40, "--out", "model")
    running = start(*words)
    line = running.interrupt(lambda: "fit: surrogate" in running.stderr)
    assert "to begin anew, nothing is left half-written: retwin fit long.toml" in line
    assert {file.name for file in own.iterdir()} - before <= {"__pycache__"}


def test_an_interrupt_while_the_program_is_imported_is_one_line() -> None:
    code = """
import os, signal, sys

class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == "retwin.cli.options":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupts())
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
from retwin.__main__ import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr == "error: interrupted; nothing was done yet\n"


class InterruptedWhenDeleted:
    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_an_interrupt_that_python_ignores_is_repeated() -> None:
    with interrupted_by_term(), pytest.raises(KeyboardInterrupt):
        InterruptedWhenDeleted()
        time.sleep(10)
