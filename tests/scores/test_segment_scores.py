"""Delay and position error of a segment, compared with what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from retwin.scores.segments import clearest_segment, median_error_trajectory

pytestmark = pytest.mark.numerical

TIME = np.arange(21) / 10
TIMES = np.array([[0.1, 0.7, 1.0], [1.0, 1.7, 2.0]])


def test_delay_and_offset_are_those_put_in() -> None:
    """Two ramps of 100 mm in 0.6 s, of which the measured second one has 80 ms and 5 mm more."""
    nominal, observed = np.zeros((21, 3)), np.zeros((21, 3))
    nominal[:, 1] = np.interp(TIME, [0.1, 0.7, 1.0, 1.6], [0, 100, 100, 200])
    observed[:, 1] = np.interp(TIME, [0.1, 0.7, 1.08, 1.68], [0, 100, 100, 205])
    found = clearest_segment(nominal, observed, TIMES, 10.0)
    assert found is not None
    assert (found.output, found.onset, found.end) == (1, 1.0, 2.0)
    assert found.delay == pytest.approx(0.08, abs=0.01)
    assert found.offset == pytest.approx(5)
    assert found.midpoints[0][1] == pytest.approx(150)
    assert clearest_segment(nominal, observed, TIMES[:1], 10.0) is None


def test_a_segment_that_was_missed_has_no_delay() -> None:
    nominal = np.interp(TIME, [0.1, 0.7, 1.0, 1.6], [0, 100, 100, 200])[:, None]
    found = clearest_segment(nominal, np.minimum(nominal, 100), TIMES, 10.0)
    assert found is not None
    assert np.isnan(found.delay)
    assert found.offset == pytest.approx(-100)


def test_the_median_is_taken_over_complete_trajectories() -> None:
    observed = np.array([1.0, 3.0, 2.0, 9.0, 0.0])[:, None, None] * np.ones((5, 21, 1))
    observed[4, 3] = np.nan
    times = np.tile(TIMES, (5, 1, 1))
    candidates = np.array([True, True, True, False, True])
    nominal = np.zeros((5, 21, 1))
    assert median_error_trajectory(nominal, observed, times, candidates) == 2
    assert median_error_trajectory(nominal, observed, times, np.zeros(5, dtype=bool)) is None


def test_a_trajectory_with_gaps_may_be_typical_if_it_is_asked_for() -> None:
    nominal = np.zeros((3, 10, 1))
    observed = nominal + np.array([0.1, 0.2, 0.3])[:, None, None]
    observed[:, 4] = np.nan
    observed[2, :8] = np.nan
    times, every = np.zeros((3, 1, 3)), np.ones(3, dtype=bool)
    assert median_error_trajectory(nominal, observed, times, every) is None
    assert median_error_trajectory(nominal, observed, times, every, at_least=0.5) == 0
