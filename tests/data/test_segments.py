from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from retwin import InputError, Segments


def ramp(onset: float, length: float, steps: int = 300, height: float = 10.0) -> np.ndarray:
    return height * np.clip((np.arange(steps) - onset) / length, 0, 1)


@given(
    onset=st.floats(0, 100),
    length=st.floats(20, 80),
    second=st.floats(0, 30),
)
def test_onset_and_end_are_found_between_samples(
    onset: float, length: float, second: float
) -> None:
    first = ramp(onset, length)
    later = onset + length + 20 + second
    commands = np.stack([first + ramp(later, 40, height=-5)], axis=-1)[None]
    found = Segments.from_commands(commands)
    assert found.valid.tolist() == [[True, True]]
    np.testing.assert_allclose(found.start[0], [onset, later], atol=1e-3)
    np.testing.assert_allclose(found.settle[0], [onset + length, later + 40], atol=1e-3)
    np.testing.assert_allclose(found.stop[0], [found.start[0, 1], 300])


def test_many_trajectories_are_told_as_each_is_alone() -> None:
    onsets = np.random.default_rng(0).uniform(0, 100, size=100)
    commands = np.stack([[ramp(onset, 60), ramp(onset, 40)] for onset in onsets]).swapaxes(1, 2)
    together = Segments.from_commands(commands)
    for i in range(100):
        alone = Segments.from_commands(commands[i : i + 1])
        np.testing.assert_array_equal(together.start[i], alone.start[0])
        np.testing.assert_array_equal(together.settle[i], alone.settle[0])


def test_the_slowest_actuator_ends_the_motion() -> None:
    commands = np.stack([ramp(10, 60), ramp(10, 100)], axis=-1)[None]
    found = Segments.from_commands(commands)
    assert found.settle[0, 0] == pytest.approx(110)


def test_trajectories_may_have_different_numbers_of_movements() -> None:
    one = ramp(10, 50)
    two = ramp(10, 50) + ramp(150, 50)
    found = Segments.from_commands(np.stack([one, two, np.zeros(300)])[..., None])
    assert found.valid.sum(axis=1).tolist() == [1, 2, 0]
    assert (found.start[0, 1], found.settle[0, 1], found.stop[0, 1]) == (300, 300, 300)


def test_commands_that_never_change_have_no_movement() -> None:
    found = Segments.from_commands(np.ones((2, 50, 3)))
    assert found.max_count == 0
    assert len(found) == 2


def test_the_path_tells_movements_where_commands_do_not() -> None:
    time = np.arange(300)
    path = np.stack([np.tanh((time - 80) / 10), np.zeros(300)], axis=-1)[None]
    found = Segments.from_path(path, threshold=0.05)
    assert found.valid.sum() == 1
    assert 40 < found.start[0, 0] < 70
    assert 90 < found.settle[0, 0] < 120


def test_steady_parts_end_with_the_trajectory_and_not_with_its_padding() -> None:
    found = Segments.given([[0, 2], [0.1, np.nan]], [[1, 3], [1.2, np.nan]], steps=200, rate=50.0)
    assert found.until([200, 200]).stop.tolist() == found.stop.tolist()
    assert found.until([180, 150]).stop.tolist() == [[100, 180], [150, 200]]
    assert found.until([120, 200]).stop[0, 1] == 150, "a commanded segment stays"


def test_given_segments_are_checked() -> None:
    found = Segments.given([[0, 2], [0.1, np.nan]], [[1, 3], [1.2, np.nan]], steps=200, rate=50.0)
    assert found.valid.tolist() == [[True, True], [True, False]]
    assert found.stop.tolist() == [[100, 200], [200, 200]]
    with pytest.raises(InputError, match="out of order"):
        Segments.given([[2, 0]], [[3, 1]], steps=200, rate=50.0)
    with pytest.raises(InputError, match=r"0 and 4 s, got 0 to 10 s; .* not samples"):
        Segments.given([[0.0]], [[10]], steps=200, rate=50.0)
    with pytest.raises(InputError, match="as many settle times"):
        Segments.given([[0.0, 1.0]], [[2]], steps=200, rate=50.0)
