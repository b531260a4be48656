"""Ramps and holds, biased references, and extremes, in one compiled pass: `commands.c`.

Results are those of the same functions in numpy, to the last digit. A function that does not apply,
without a C compiler or for another precision, gives None.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.compiler import call, compiled_files
from retwin.data.segments import Segments

LANES = 256
"""Channels at most of `extremes`, as in `commands.c`."""


def library() -> ctypes.CDLL | None:
    """The compiled functions; None without a C compiler."""
    return compiled_files(__package__, "commands.c")


def ramped(
    start: NDArray, levels: NDArray, spans: NDArray, onsets: NDArray, steps: int
) -> NDArray | None:
    """Commands (n, steps, d_u) in single precision; see `ramps_and_holds`.

    None also where a ramp begins before the one before it has ended.
    """
    kernel = library()
    if kernel is None or not levels.size:
        return None
    n, segments, width = levels.shape
    out, done = np.empty((n, steps, width), np.float32), np.empty(n, np.uint8)
    given = (np.ascontiguousarray(each, np.float64) for each in (start, levels, spans, onsets))
    call(kernel, "ramps", (n, steps, segments, width), 0.0, (), (*given, out, done))
    return out if done.all() else None


def biased_references(
    commands: NDArray,
    out: NDArray,
    actuators: Sequence[int],
    biases: Sequence[Sequence[float]],
    segments: Segments,
) -> bool:
    """Write the references of trajectories with a biased actuator, and whether that was possible.

    Parameters
    ----------
    commands, out : ndarray, shape (n, T, d_u)
        Clean commands, and a copy of them, which is changed.
    actuators : sequence of int
        (n,), the actuator; below 0 for none.
    biases : sequence of sequence of float
        (n,), the bias of each segment that exists.
    segments : Segments
        Those of the commands.

    """
    kernel = library()
    if kernel is None or commands.dtype != np.float32 or not commands.size:
        return False
    levels = np.zeros(segments.start.shape)
    for row, bias in enumerate(biases):
        levels[row, : len(bias)] = bias
    start, settle = (
        np.ascontiguousarray(each, np.float64) for each in (segments.start, segments.settle)
    )
    count = segments.valid.sum(axis=1).astype(np.int64)
    given = (np.array(actuators, np.int64), start, settle, count, levels)
    sizes = (*commands.shape[:2], segments.max_count, commands.shape[2])
    call(kernel, "biases", sizes, 0.0, (), (*given, np.ascontiguousarray(commands), out))
    return True


def extremes(values: NDArray) -> tuple[NDArray, NDArray, NDArray] | None:
    """Least and greatest value and greatest change, (n, d) each; see `command_range.extremes`.

    None also where a value is NaN.
    """
    kernel = library()
    n, steps, width = values.shape
    suits = values.dtype == np.float32 and steps and 0 < width <= LANES
    if kernel is None or not suits:
        return None
    found = tuple(np.empty((n, width), np.float32) for _ in range(3))
    done = np.empty(n, np.uint8)
    rows = (np.ascontiguousarray(values), *found, done)
    call(kernel, "extremes", (n, steps, width), 0.0, (), rows)
    return found if done.all() else None  # type: ignore[return-value]
