"""Errors of free simulation, which show slow faults that a filter follows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.update.agreement import DIVERGED
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.forecasts import begin_of, started_moments


def sizes_of_parts(error: NDArray) -> tuple[NDArray, int]:
    """Root mean squares (n, B, S) of errors (n, T, S) in B parts, and the samples of a part.

    NaN is missing, and a part of which half is missing has size 0. Parts have as many samples as
    there are parts.
    """
    count, samples, streams = error.shape
    length = max(1, int(np.sqrt(samples)))
    parts = error[:, : samples // length * length].reshape(count, -1, length, streams)
    seen = np.isfinite(parts).sum(axis=2)
    squares = np.nansum(parts**2, axis=2) / np.maximum(seen, 1)
    return np.sqrt(np.where(seen > length / 2, squares, 0.0)), length


def free_errors(twin: DynamicsTwin, records: Trajectories) -> tuple[NDArray, int] | None:
    """Sizes (n, B, d_y) of the errors of free simulation, see `sizes_of_parts`.

    Starts are inferred from the first tenth of each record, which is not counted. None where a
    simulation diverges.
    """
    begin = begin_of(records)
    try:
        with np.errstate(all="ignore"):
            mean = started_moments(twin, records, begin)[0]
    except InputError:
        return None
    if not np.all(np.abs(mean, dtype=float) < DIVERGED):
        return None
    error = np.where(records.mask, records.observed - mean, np.nan)
    error[:, : round(begin * records.rate)] = np.nan
    return sizes_of_parts(error)
