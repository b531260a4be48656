"""Histograms in common bins: nothing is lost, and outliers do not stretch them."""

from __future__ import annotations

import numpy as np
import pytest

from retwin.scores.histograms import common_histogram

pytestmark = pytest.mark.numerical


def test_outliers_are_counted_and_lie_outside() -> None:
    rng = np.random.default_rng(0)
    observed = np.concatenate([rng.normal(11, 3, 191), np.full(9, 180.0), np.full(40, np.nan)])
    found = common_histogram(observed, rng.normal(11, 3, 4000))
    assert found is not None
    assert (found.counts, found.outside) == ((200, 4000), (9, 0))
    assert found.observed.sum() == pytest.approx(191 / 200)
    assert 15 < found.edges[-1] < 50


@pytest.mark.parametrize("values", [[1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0, 5.0]])
def test_few_or_equal_values(values: list[float]) -> None:
    found = common_histogram(np.array(values), np.random.default_rng(0).normal(size=100))
    assert found is not None
    assert np.all(np.diff(found.edges) > 0)
    assert found.outside[0] < found.counts[0]


def test_nothing_to_show_without_values() -> None:
    assert common_histogram(np.array([np.nan]), np.ones(3)) is None
