"""Worker processes can be kept from one simulation to the next."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from fmus import c_fmu

import retwin as rt
from retwin.twins.fmu.twin import FMUTwin
from retwin.twins.function import FunctionTwin
from retwin.twins.workers import keep_workers

IN, OUT = rt.Channels(("u",), ("1",)), rt.Channels(("process",), ("1",))
COMMANDS = np.ones((3, 8, 1))


def process_number(commands: np.ndarray) -> np.ndarray:
    """The number of the process that simulates; refuses negative commands."""
    if commands.min() < 0:
        raise ArithmeticError("negative")
    return np.full((len(commands), 1), float(os.getpid()))


TWIN = FunctionTwin(process_number, IN, OUT, 10.0, vectorised=False, workers=2)


def processes(twin: rt.Twin = TWIN, commands: np.ndarray = COMMANDS) -> set[float]:
    return set(twin.simulate(commands, seed=0).observed.ravel().tolist())


def test_each_simulation_has_processes_of_its_own() -> None:
    assert not processes() & processes()
    assert not multiprocessing.active_children()


def test_kept_processes_serve_all_twins_that_need_as_many() -> None:
    with keep_workers():
        first = processes()
        with keep_workers():
            assert processes(rt.FunctionTwin(process_number, IN, OUT, 5.0, vectorised=False))
            assert len(first | processes()) <= 2
        assert len(first | processes()) <= 2
    assert not multiprocessing.active_children()


def test_an_error_ends_the_kept_processes_and_the_next_simulation_starts_others() -> None:
    with keep_workers():
        first = processes()
        with pytest.raises(rt.InputError, match="seed"):
            TWIN.simulate(COMMANDS, seed=-1)
        assert len(first | processes()) <= 2
        with pytest.raises(ArithmeticError):
            TWIN.simulate(-COMMANDS, seed=0)
        assert not first & processes()


def test_processes_end_when_the_block_raises() -> None:
    with pytest.raises(KeyError), keep_workers():
        processes()
        raise KeyError
    assert not multiprocessing.active_children()


def test_an_fmu_is_unpacked_once_and_removed_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = c_fmu(tmp_path)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    log = tmp_path / "log"
    monkeypatch.setenv("LAG_LOG", str(log))
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    twin = FMUTwin.from_file(path, 100.0, ["u"], ["x"], workers=1)
    alone = twin.simulate(COMMANDS, seed=0)
    with keep_workers():
        kept = [twin.simulate(COMMANDS, seed=0) for _ in range(2)]
        assert len(list(scratch.iterdir())) == 1
        path.touch()  # the file may be another one now
        twin.simulate(COMMANDS, seed=0)
        assert len(list(scratch.iterdir())) == 2
    assert not list(scratch.iterdir())
    for made in kept:
        assert made.observed[..., 0].tobytes() == alone.observed[..., 0].tobytes()
    # The second simulation found it loaded, and its reset checked.
    assert log.read_text("utf-8") == "irrrr" + "irrrrrrr" + "irrrr"
