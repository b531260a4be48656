"""Corrected, labelled sets of any size: the same bytes whoever makes them, and after a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.deploy.simulations import SimulationPlan, simulate_to
from retwin.serialisation.files import sha256


@pytest.fixture(scope="module")
def model(updated: rt.CorrectedTwin, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corrected") / "model"
    updated.save(folder)
    return folder


def command(model: Path, out: Path, per_class: int, *more: str) -> list[str]:
    words = [model, "--per-class", per_class, "--seed", 4, "--out", out, *more]
    return ["generate", *map(str, words)]


def program(model: Path, out: Path, per_class: int, *more: str) -> list[str]:
    return [sys.executable, "-m", "retwin", *command(model, out, per_class, *more)]


@pytest.mark.slow
def test_balanced_and_the_same_with_any_number_of_workers(
    model: Path, updated: rt.CorrectedTwin, case: rt.Case, tmp_path: Path
) -> None:
    for workers in ("1", "2"):
        out = tmp_path / f"{workers}.zarr"
        subprocess.run(program(model, out, 40, "--workers", workers), check=True)
    assert sha256(tmp_path / "1.zarr") == sha256(tmp_path / "2.zarr")
    made = rt.load(tmp_path / "1.zarr", case=case)
    assert made.labels.tolist() == 40 * list(case.classes)
    assert made.emulated, "as what the twin was calibrated on"
    plan = SimulationPlan(updated, case.sampler, seed=4, n=360, faults=case.faults)
    # In this process too, where torch may have more threads.
    simulate_to(tmp_path / "here.zarr", plan, workers=1)
    np.testing.assert_array_equal(rt.load(tmp_path / "here.zarr").observed, made.observed)


@pytest.mark.slow
def test_killed_and_given_again(
    model: Path, updated: rt.CorrectedTwin, case: rt.Case, tmp_path: Path
) -> None:
    out, per_class = tmp_path / "a.zarr", 100
    process = subprocess.Popen(
        program(model, out, per_class, "--workers", "2"), start_new_session=True
    )
    done = tmp_path / "a.zarr.part" / "done"
    deadline = time.monotonic() + 120
    while not (done.exists() and list(done.glob("[0-9]*"))):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert 0 < len(list(done.glob("[0-9]*"))) < 4
    assert not out.exists()
    subprocess.run(program(model, out, per_class), check=True)
    plan = SimulationPlan(updated, case.sampler, seed=4, n=900, faults=case.faults)
    simulate_to(tmp_path / "b.zarr", plan, workers=1)
    assert sha256(out) == sha256(tmp_path / "b.zarr")
    assert not done.exists()


def test_an_npz_is_what_generate_makes(
    call, model: Path, updated: rt.CorrectedTwin, case: rt.Case, tmp_path: Path
) -> None:
    code, _, err = call(*command(model, tmp_path / "a.npz", 2))
    assert code == 0, err
    hand = rt.generate(updated, case, per_class=2, seed=4)
    np.testing.assert_array_equal(rt.load(tmp_path / "a.npz").observed, hand.observed)
    code, _, err = call(*command(model, tmp_path / "b.npz", 2, "--workers", "2"))
    assert code == 2
    assert "with workers" in err
