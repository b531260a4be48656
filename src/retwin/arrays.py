"""Arrays: what those of trajectories must be, and how they are gone through without a copy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.errors import InputError

__all__ = ["check_finite", "check_shapes", "floating", "measured", "named", "row_blocks"]

BLOCK = 2**22
"""Bytes of an array that are looked at together."""


def row_blocks(array: NDArray, count: int | None = None) -> Iterator[slice]:
    """Slices of rows, of at most 4 MB each: of all rows of `array`, or of `count` such rows.

    Whoever goes through a set by them needs little memory for it, also where the set is a map of
    a file that no memory holds.
    """
    rows = max(1, BLOCK * len(array) // max(1, array.nbytes))
    count = len(array) if count is None else count
    return (slice(begin, begin + rows) for begin in range(0, count, rows))


def floating(name: str, array: ArrayLike) -> NDArray:
    """`array` as floating-point numbers (n, T, d), or an InputError."""
    array = np.asarray(array)
    if array.dtype.kind in "iub":
        array = array.astype(np.float64)
    if array.dtype.kind != "f" or array.ndim != 3:
        raise InputError(
            name,
            expected="numbers of shape (trajectories, samples, channels)",
            got=f"{array.dtype} of shape {array.shape}",
            remedy="stack the trajectories into one three-dimensional array",
        )
    return array


def check_shapes(commands: NDArray, nominal: NDArray, observed: NDArray) -> None:
    """Raise InputError unless they are of as many trajectories, samples and outputs."""
    if nominal.shape != observed.shape:
        raise InputError(
            "observed",
            expected=f"the shape of nominal, {nominal.shape}",
            got=str(observed.shape),
            remedy="give observed and nominal the same channels and samples",
        )
    if commands.shape[:2] != nominal.shape[:2]:
        raise InputError(
            "commands",
            expected=f"{nominal.shape[0]} trajectories of {nominal.shape[1]} samples, as nominal",
            got=str(commands.shape),
            remedy="sample commands and outputs on the same grid",
        )
    if nominal.shape[1] < 2 or nominal.shape[2] < 1:
        raise InputError(
            "nominal",
            expected="at least two samples and one channel",
            got=str(nominal.shape),
            remedy="give the outputs over time",
        )


def check_finite(name: str, array: NDArray) -> None:
    """Raise InputError, which names the place, where a number is NaN or infinite."""
    for rows in row_blocks(array):
        if _is_finite(array[rows]):
            continue
        bad = ~np.isfinite(array[rows])
        if bad.any():
            raise InputError(
                name,
                expected="finite numbers",
                got=f"NaN or an infinite value in {_first(bad, rows)}",
                remedy=f"{name} are known inputs: repair or drop that trajectory",
            )


def measured(observed: NDArray, mask: ArrayLike | None) -> tuple[NDArray, NDArray]:
    """`observed` with 0 where the mask is False, and the mask, which is False where that was NaN.

    Without a mask it is True elsewhere. What is so already is not copied.
    Raises InputError for infinite values, or a mask of another shape.
    """
    flags = np.ones(observed.shape, bool) if mask is None else np.asarray(mask, bool)
    if flags.shape != observed.shape:
        raise InputError(
            "mask",
            expected=f"the shape of observed, {observed.shape}",
            got=str(flags.shape),
            remedy="give one flag per measurement",
        )
    told = zeroed = True
    for rows in row_blocks(observed):
        values, there = observed[rows], flags[rows]
        if there.all() and _is_finite(values):
            continue
        infinite = np.isinf(values)
        if infinite.any():
            raise InputError(
                "observed",
                expected="finite measurements (NaN where one is missing)",
                got=f"an infinite value in {_first(infinite, rows)}",
                remedy="replace infinite measurements by NaN",
            )
        missing = np.isnan(values)
        told &= not (missing & there).any()
        hidden = values[~there & ~missing]
        # A minus zero is another byte.
        zeroed &= not (missing.any() or np.any(hidden != 0) or np.signbit(hidden).any())
    if not told:
        flags = flags & ~np.isnan(observed)
    if not zeroed:
        observed = np.where(flags, observed, observed.dtype.type(0))
    return observed, flags


def named(name: str, given: ArrayLike | None, default: list[str]) -> NDArray:
    """One text (n,) per trajectory, those of `default` where none are given, or an InputError."""
    texts = np.asarray(default if given is None else given, dtype=np.str_)
    if texts.shape != (len(default),):
        raise InputError(
            name,
            expected=f"{len(default)} names, one per trajectory",
            got=f"shape {texts.shape}",
            remedy="give one name per trajectory",
        )
    return texts


def _is_finite(values: NDArray) -> bool:
    """Whether all are finite for certain: where their sum is, each is, and no flags are needed."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()))


def _first(bad: NDArray, rows: slice) -> str:
    """The place of the first flag among those of some rows."""
    trajectory, sample, channel = np.argwhere(bad)[0]
    return f"trajectory {rows.start + trajectory}, sample {sample}, channel {channel}"
