"""Rows of arrays."""

from __future__ import annotations

import numpy as np
import pytest

from retwin.arrays import distinct_rows


@pytest.mark.parametrize("count", [0, 1, 20])
def test_distinct_rows_are_those_of_numpy(count: int) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 4, 2))[rng.integers(3, size=count)]
    rows, place = distinct_rows(values)
    np.testing.assert_array_equal(rows[place], values)
    assert len(rows) == len(np.unique(values, axis=0))
