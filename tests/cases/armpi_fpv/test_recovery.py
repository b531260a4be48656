"""Recovery of commands from paths: exact on synthetic ones, complete on the published ones."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import loadmat

from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.cases.armpi_fpv.recovery import Recovery, recover_commands
from retwin.cases.armpi_fpv.twin import KINEMATIC, RAMPS
from retwin.errors import InputError
from retwin.twins.commands.ramps import ramps_and_holds

ARM = YawPitchArm(base=0.028505 + 0.0361, links=(0.10048, 0.094714, 0.05071))
DATA = os.environ.get("RETWIN_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="RETWIN_DATA is not set")


class Made:
    """Commands drawn as the published ones are, and their path."""

    def __init__(
        self,
        count: int,
        seed: int,
        *,
        real: bool,
        moves: int = 5,
        whole: bool = True,
        digits: int | None = None,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.ramps = rng.choice(RAMPS, size=(count, moves, 4))
        self.start = np.full((count, 4), 500.0)
        spacings = np.full((count, moves - 1), 200.0)
        first = np.zeros((count, 1))
        if real:
            self.start += rng.integers(-5, 6, size=(count, 4))
            first = rng.uniform(0, 9, size=first.shape)
            spacings = rng.uniform(200, 204, size=spacings.shape)
        self.onsets = np.cumsum(np.concatenate([first, spacings], axis=1), axis=1)
        goals = 500 + rng.uniform(-1, 1, self.ramps.shape) * np.array([80, 50, 50, 50]) / 0.24
        self.targets = np.empty_like(goals)
        now = self.start
        for move in range(moves):
            largest = 2.72 / 0.24 * self.ramps[:, move]
            now = now + np.clip(goals[:, move] - now, -largest, largest)
            now = np.rint(now) if whole else now
            self.targets[:, move] = now
        length = 200 * moves + 20 * real
        # A ramp of the simulated paths counts both its ends.
        spans = self.ramps - (not real)
        self.commands = ramps_and_holds(self.start, self.targets, spans, self.onsets, length)
        self.path = ARM.position(KINEMATIC.angles(self.commands))
        if digits is not None:
            self.path = np.round(self.path, digits)

    def exact(self, found: Recovery, tolerance: float) -> NDArray:
        """Which movements (n, M) are found with their ramps and their targets."""
        before = np.concatenate([self.start[:, None], self.targets[:, :-1]], axis=1)
        moved = np.abs(self.targets - before) > tolerance
        ramps = ((found.ramps == self.ramps) | ~moved).all(axis=2)
        return ramps & (np.abs(found.targets - self.targets).max(axis=2) <= tolerance)


@pytest.mark.parametrize("digits", [None, 6])
@pytest.mark.parametrize("real", [False, True])
def test_whole_units_come_back_exactly(real: bool, digits: int | None) -> None:
    made = Made(60, 1, real=real, digits=digits)
    found = recover_commands(made.path, arm=ARM)
    exact = made.exact(found, 0)
    assert exact.mean() >= 0.99
    assert exact[~found.ambiguous].all()
    assert found.ambiguous.mean() <= 0.01
    assert found.whole.all()
    np.testing.assert_array_equal(found.closed, not real)
    np.testing.assert_array_equal(found.start, made.start)
    np.testing.assert_allclose(found.onsets, made.onsets, atol=1e-9 if digits is None else 0.01)
    assert found.rms.max() <= (1e-12 if digits is None else 1e-6)


def test_targets_off_the_grid_are_estimated() -> None:
    made = Made(60, 2, real=False, whole=False, digits=6)
    found = recover_commands(made.path, arm=ARM)
    assert not found.whole.any()
    assert np.mean(found.rms <= 5e-5) >= 0.98
    assert made.exact(found, 0.5)[~found.ambiguous].mean() >= 0.99
    assert np.abs(found.commands - made.commands)[found.rms <= 1e-6].max() < 2


def test_length_and_number_of_movements_are_free() -> None:
    made, other = Made(6, 3, real=True, moves=7), Made(6, 4, real=True, moves=2)
    held = np.repeat(other.path[:, -1:], made.path.shape[1] - other.path.shape[1], axis=1)
    path = np.concatenate([made.path, np.concatenate([other.path, held], axis=1)])
    done: list[float] = []
    found = recover_commands(path, arm=ARM, progress=done.append)
    assert found.targets.shape == (12, 7, 4)
    np.testing.assert_array_equal(found.targets[:6], made.targets)
    np.testing.assert_array_equal(found.targets[6:, :2], other.targets)
    assert np.isnan(found.onsets[6:, 2:]).all()
    np.testing.assert_array_equal(found.targets[6:, 2:], np.repeat(other.targets[:, 1:], 5, 1))
    assert not found.ambiguous.any()
    spans = found.ramps - found.closed[:, None, None]
    again = ramps_and_holds(found.start, found.targets, spans, found.onsets, path.shape[1])
    np.testing.assert_array_equal(again, found.commands)
    assert done == sorted(done)
    assert done[-1] == 1


def test_a_motor_that_stays_is_not_ambiguous() -> None:
    start = np.array([[510.0, 480, 530, 470]])
    targets = np.array([[[600.0, 480, 530, 400], [600, 350, 530, 400]]])
    ramps = np.array([[[60, 60, 60, 100], [60, 80, 60, 60]]])
    commands = ramps_and_holds(start, targets, ramps, np.array([[3.25, 205.5]]), 400)
    found = recover_commands(ARM.position(KINEMATIC.angles(commands)), arm=ARM)
    np.testing.assert_array_equal(found.targets, targets)
    np.testing.assert_array_equal(found.ramps, ramps)
    np.testing.assert_array_equal(found.start, start)
    assert not found.ambiguous.any()


def test_a_cut_movement_is_ambiguous() -> None:
    made = Made(5, 5, real=True)
    found = recover_commands(made.path[:, :860], arm=ARM)
    assert found.ambiguous[:, 4].all()
    assert made.exact(found, 0.5)[:, :4][~found.ambiguous[:, :4]].all()


def test_the_mirrored_posture_is_ambiguous_where_the_yaw_could_reach_it() -> None:
    start = np.array([[800.0, 480, 530, 470]])
    targets = np.array([[[790.0, 430, 600, 400]]])
    commands = ramps_and_holds(start, targets, np.full((1, 1, 4), 80), np.array([[3.25]]), 200)
    found = recover_commands(ARM.position(KINEMATIC.angles(commands)), arm=ARM)
    np.testing.assert_array_equal(found.targets, targets)
    assert found.ambiguous.all()


def test_rest_without_movement() -> None:
    straight = np.tile([0.0, 0.0, ARM.reach], (2, 50, 1))
    found = recover_commands(straight, arm=ARM)
    assert found.targets.shape == (2, 0, 4)
    np.testing.assert_array_equal(found.commands, 500)
    made = Made(3, 6, real=True)
    found = recover_commands(np.repeat(made.path[:, :1], 30, axis=1), arm=ARM)
    np.testing.assert_array_equal(found.start, made.start)
    assert recover_commands(made.path[:0], arm=ARM).commands.shape == (0, 1020, 4)


@pytest.mark.slow
def test_what_is_no_path_of_the_arm_is_not_explained() -> None:
    rng = np.random.default_rng(7)
    made = Made(2, 8, real=True)
    walk = np.cumsum(rng.normal(scale=1e-3, size=(2, 1020, 3)), axis=1)
    jumps = rng.normal(size=(2, 1020, 3))
    for path in (walk, jumps, 1.3 * made.path):
        found = recover_commands(path, arm=ARM)
        assert (found.rms > 5e-5).all()
        assert np.isfinite(found.commands).all()
        assert (np.abs(found.commands - 500) <= 500).all()
        assert found.ambiguous[~np.isnan(found.onsets)].all()


def test_wrong_paths_are_refused() -> None:
    path = Made(2, 9, real=True).path
    with pytest.raises(InputError, match=r"path: expected shape \(n, T, 3\) .*got \(1020, 3\)"):
        recover_commands(path[0], arm=ARM)
    with pytest.raises(InputError, match=r"path: expected shape .*got \(2, 1020, 2\)"):
        recover_commands(path[..., :2], arm=ARM)
    path[1, 5, 0] = np.nan
    with pytest.raises(InputError, match=r"path: expected finite numbers, got NaN .* trajectory 1"):
        recover_commands(path, arm=ARM)
    with pytest.raises(InputError, match="arm: expected 3 pitch joints, got 1"):
        recover_commands(path[:1], arm=YawPitchArm(0.1, (0.2,)))


def read(name: str, key: str) -> NDArray:
    cells = loadmat(Path(str(DATA)) / "armpi" / name, variable_names=[key])[key].ravel()
    return np.stack([cell[:, :3] for cell in cells])


@needs_data
@pytest.mark.real_data
def test_real_paths_are_explained() -> None:
    path = read("real_a.mat", "X_test_array")
    found = recover_commands(path, arm=ARM)
    assert np.mean(found.rms <= 5e-5) >= 0.99
    assert found.whole.all()
    assert not found.closed.any()
    assert found.ambiguous.mean() <= 0.01
    assert found.onsets.shape[1] == 5
    assert ((found.onsets[:, 0] >= 0) & (found.onsets[:, 0] <= 10)).all()


@pytest.mark.slow
@needs_data
@pytest.mark.real_data
def test_simulated_paths_are_explained() -> None:
    path = read("sim.mat", "X_array")[::18]
    found = recover_commands(path, arm=ARM)
    assert np.mean(found.rms <= 5e-5) >= 0.99
    assert found.closed.all()
    np.testing.assert_allclose(found.onsets, np.tile(200.0 * np.arange(5), (len(path), 1)), atol=1)
    assert found.ambiguous.mean() <= 0.02
