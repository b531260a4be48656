"""Checks of the arrays of trajectories, block by block and without a copy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import require
from retwin.errors import InputError
from retwin.workers.threads import in_threads

BYTES_PER_BLOCK = 2**22
"""The size of a block of rows in bytes: it fits the cache of a processor."""


def row_blocks(array: NDArray, count: int | None = None) -> Iterator[slice]:
    """Slices of rows, of at most 4 MB each: of all rows of `array`, or of `count` such rows.

    Work in blocks needs little memory, also where the array is a map of a file larger than the
    memory.
    """
    rows = max(1, BYTES_PER_BLOCK * len(array) // max(1, array.nbytes))
    count = len(array) if count is None else count
    return (slice(begin, begin + rows) for begin in range(0, count, rows))


def distinct_rows(array: NDArray) -> tuple[NDArray, NDArray]:
    """The different rows of an array (n, ...), by their bytes, in the order in which they come.

    Unlike `numpy.unique` it sorts nothing, which takes most of the time where rows are long.

    Returns
    -------
    rows : ndarray, shape (k, ...)
        One of each.
    place : ndarray, shape (n,)
        The index among these of each row.

    """
    places: dict[bytes, int] = {}
    place = np.array([places.setdefault(row.tobytes(), len(places)) for row in array], dtype=int)
    return array[np.unique(place, return_index=True)[1]], place


def floating(name: str, array: ArrayLike) -> NDArray:
    """`array` as floating-point numbers (n, T, d).

    Raises
    ------
    InputError
        It holds no real numbers, or has another number of axes.

    """
    array = np.asarray(array)
    if array.dtype.kind in "iub":
        array = array.astype(np.float64)
    require(
        array.dtype.kind == "f" and array.ndim == 3,
        name,
        expected="numbers of shape (trajectories, samples, channels)",
        got=f"{array.dtype} of shape {array.shape}",
        remedy="stack the trajectories into one three-dimensional array",
    )
    return array


def floats(values: Iterable[float]) -> tuple[float, ...]:
    """Numbers of any type as Python's, which JSON files hold and dataclasses compare."""
    return tuple(float(each) for each in values)


def check_shapes(commands: NDArray, nominal: NDArray, observed: NDArray) -> None:
    """Check that numbers of trajectories, samples and outputs agree.

    Raises
    ------
    InputError
        They differ, there are fewer than two samples, or there is no output.

    """
    require(
        nominal.shape == observed.shape,
        "observed",
        expected=f"the shape of nominal, {nominal.shape}",
        got=observed.shape,
        remedy="give observed and nominal the same channels and samples",
    )
    require(
        commands.shape[:2] == nominal.shape[:2],
        "commands",
        expected=f"{nominal.shape[0]} trajectories of {nominal.shape[1]} samples, as nominal",
        got=commands.shape,
        remedy="sample commands and outputs on the same grid",
    )
    require(
        nominal.shape[1] >= 2 and nominal.shape[2] >= 1,
        "nominal",
        expected="at least two samples and one channel",
        got=nominal.shape,
        remedy="give the outputs over time",
    )


def check_finite(name: str, array: NDArray) -> None:
    """Check that all numbers are finite.

    Raises
    ------
    InputError
        One is NaN or infinite; the message names the first one.

    """
    blocks = list(row_blocks(array))
    checked = in_threads(lambda rows: is_finite(array[rows]), blocks)
    for rows, finite in zip(blocks, checked, strict=True):
        if finite:
            continue
        bad = ~np.isfinite(array[rows])
        if bad.any():
            raise InputError(
                name,
                expected="finite numbers",
                got=f"NaN or an infinite value in {_first(bad, rows)}",
                remedy="these are known inputs: repair or drop that trajectory",
            )


def measured(observed: NDArray, mask: ArrayLike | None) -> tuple[NDArray, NDArray]:
    """Measurements and their mask; arrays that need no change are not copied.

    Parameters
    ----------
    observed : (n, T, d_y) array
        Measurements, NaN where one is missing.
    mask : (n, T, d_y) array of bool, or None
        False where a measurement is missing; None for True everywhere.

    Returns
    -------
    observed : (n, T, d_y) array
        0 where the mask is False.
    mask : (n, T, d_y) array of bool
        False also where `observed` was NaN.

    Raises
    ------
    InputError
        A measurement is infinite, or the mask has another shape.

    """
    flags = np.ones(observed.shape, bool) if mask is None else np.asarray(mask, bool)
    require(
        flags.shape == observed.shape,
        "mask",
        expected=f"the shape of observed, {observed.shape}",
        got=flags.shape,
        remedy="give one flag per measurement",
    )
    masked = zeroed = True
    blocks = list(row_blocks(observed))
    plain = in_threads(lambda rows: flags[rows].all() and is_finite(observed[rows]), blocks)
    for rows, unchanged in zip(blocks, plain, strict=True):
        if unchanged:
            continue
        values, present = observed[rows], flags[rows]
        infinite = np.isinf(values)
        if infinite.any():
            raise InputError(
                "observed",
                expected="finite measurements (NaN where one is missing)",
                got=f"an infinite value in {_first(infinite, rows)}",
                remedy="replace infinite measurements by NaN",
            )
        missing = np.isnan(values)
        masked &= not (missing & present).any()
        hidden = values[~present & ~missing]
        # Minus zero has other bytes than zero.
        zeroed &= not (missing.any() or np.any(hidden != 0) or np.signbit(hidden).any())
    if not masked:
        flags = flags & ~np.isnan(observed)
    if not zeroed:
        observed = np.where(flags, observed, observed.dtype.type(0))
    return observed, flags


def named(name: str, given: ArrayLike | None, default: list[str]) -> NDArray:
    """One text (n,) per trajectory, those of `default` if none are given.

    Raises
    ------
    InputError
        There is not one text per trajectory.

    """
    texts = np.asarray(default if given is None else given, dtype=np.str_)
    require(
        texts.shape == (len(default),),
        name,
        expected=f"{len(default)} names, one per trajectory",
        got=f"shape {texts.shape}",
        remedy="give one name per trajectory",
    )
    return texts


def interpolated(values: NDArray, at: ArrayLike, stride: int = 1) -> NDArray:
    """`values`, linear in between and constant beyond the first and the last.

    Parameters
    ----------
    values : ndarray, shape (..., r, d)
        Values `stride` samples apart, the first one at sample 0.
    at : array_like, shape (T) or (..., T)
        Samples, fractions allowed.
    stride : int, default 1
        Samples from one value to the next.

    Returns
    -------
    ndarray, shape (..., T, d)
        The values at those samples.

    """
    at = np.asarray(at)
    last = values.shape[-2] - 1
    before = np.clip((at // stride).astype(int), 0, max(last - 1, 0))
    fraction = np.clip((at - stride * before) / stride, 0.0, 1.0)[..., None]
    after = np.minimum(before + 1, last)
    if at.ndim == 1:
        left, right = values[..., before, :], values[..., after, :]
    else:
        left, right = (
            np.take_along_axis(values, index[..., None], axis=-2) for index in (before, after)
        )
    return (1 - fraction) * left + fraction * right


def held(values: NDArray, axis: int) -> NDArray:
    """Values in which one that is not finite is the one before along an axis, if there is any."""
    moved = np.moveaxis(values, axis, 0)
    places = np.arange(len(moved)).reshape(-1, *(1,) * (moved.ndim - 1))
    index = np.maximum.accumulate(np.where(np.isfinite(moved), places, 0), axis=0)
    return np.moveaxis(np.take_along_axis(moved, index, axis=0), 0, axis)


def runs(flags: NDArray) -> NDArray:
    """First index of each run of true flags (n,), and the index after its last one: (k, 2)."""
    return np.flatnonzero(np.diff(flags.astype(int), prepend=0, append=0)).reshape(-1, 2)


def is_finite(values: NDArray) -> bool:
    """Whether the sum of all is finite, from which it follows that each is."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()))


def _first(bad: NDArray, rows: slice) -> str:
    """The indices of the first flag in a block of rows."""
    trajectory, sample, channel = np.argwhere(bad)[0]
    return f"trajectory {rows.start + trajectory}, sample {sample}, channel {channel}"
