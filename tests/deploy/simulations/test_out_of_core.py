"""Sets that no memory holds: everything that reads one does so within a limit of the memory."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import plant
import pytest

import retwin as rt
from retwin import arrays
from retwin.data.io import zarr_folder
from retwin.data.io.zarr_folder import read_zarr
from retwin.deploy.simulations import simulate_to
from retwin.nets.networks import Standardise
from retwin.update import surrogate

LARGE = 650
"""Trajectories whose numbers take twice the memory that is allowed."""


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A small set and one that is too large, in Zarr."""
    folder = tmp_path_factory.mktemp("sets")
    made = {}
    for name, n in (("small", 60), ("large", LARGE)):
        made[name] = simulate_to(folder / f"{name}.zarr", plant.plan(n), workers=1).path
    return made


@pytest.mark.slow
@pytest.mark.parametrize("work", ["learn", "study", "copy", "simulate"])
def test_a_set_that_does_not_fit(work: str, sets: dict[str, Path], tmp_path: Path) -> None:
    assert LARGE * plant.STEPS * plant.BYTES > 1.9 * plant.HEADROOM
    subprocess.run(
        [sys.executable, plant.__file__, work, sets["small"], sets["large"], tmp_path],
        check=True,
        # An arena per thread is memory that is taken and not used.
        env=os.environ | {"MALLOC_ARENA_MAX": "1", "OMP_NUM_THREADS": "1"},
    )


def test_what_is_read_is_a_map_and_leaves_nothing(
    sets: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zarr_folder.tempfile, "tempdir", str(tmp_path))
    made = rt.load(sets["small"])
    base = made.observed
    while isinstance(base.base, np.ndarray):
        base = base.base
    assert isinstance(base, np.memmap)
    assert not base.flags.writeable
    assert not list(tmp_path.iterdir())
    rt.save(made, tmp_path / "again.zarr")
    again = rt.load(tmp_path / "again.zarr")
    for name in ("commands", "nominal", "observed", "mask", "labels", "ids"):
        np.testing.assert_array_equal(getattr(again, name), getattr(made, name))


def test_a_full_disk_is_told(sets: dict[str, Path]) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(rt.InputError, match="set TMPDIR to a folder on a larger disk"):
            read_zarr(sets["small"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_blocks_change_nothing(sets: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """What is learned and said does not depend on how much is looked at together."""
    made = rt.load(sets["small"]).replace(rate=160.0)[::2]
    found = []
    for block in (2**24, 10**5):
        monkeypatch.setattr(arrays, "BYTES_PER_BLOCK", block)
        monkeypatch.setattr(surrogate, "MAX_SAMPLES", 5000)
        network = rt.fit_surrogate(made, rt.MLP((4,)), seed=0, training=plant.BRIEF)
        diagnoser = rt.fit_diagnoser(made, seed=0, rate=1.0, training=plant.BRIEF)
        weights = [*network.state_dict().values(), *diagnoser.state_dict().values()]
        found.append([*map(np.asarray, weights), diagnoser.predict_proba(made), made.lengths])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_network_with_memory_learns_from_a_part(
    sets: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = rt.load(sets["small"])
    monkeypatch.setattr(surrogate, "MAX_SEQUENCE_SAMPLES", 3 * plant.STEPS + 1)
    commands, nominal, there = surrogate._sequences(made, np.array([5, 3, 8, 1]), 0)
    np.testing.assert_array_equal(commands, made.commands[[5, 3, 8]])
    np.testing.assert_array_equal(nominal, made.nominal[[5, 3, 8]])
    assert there.shape == (3, plant.STEPS)


def test_standardised_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    values = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)) * 5 + 100
    values[:, 2] = 7.0
    whole = Standardise(3).fit(values)
    monkeypatch.setattr("retwin.nets.networks.ROWS_PER_BLOCK", 70)
    parts = Standardise(3).fit(values.view(10, 100, 3))
    np.testing.assert_allclose(parts.mean, values.double().mean(0), rtol=1e-6)
    np.testing.assert_allclose(parts.scale[:2], values.double().std(0, correction=0)[:2], rtol=1e-6)
    torch.testing.assert_close(parts.state_dict(), whole.state_dict())
    assert parts.scale[2] == 1.0
