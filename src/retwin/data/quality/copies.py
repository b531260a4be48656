"""`find_copies`, `distinct_records` and `fingerprints`: which records are the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.serialisation.identity import identity

SHIFT = 3
"""Samples by which copies are shifted, at most."""
EXACT = 1e-5
"""The same to the range of an output, for records without noise."""
COMPARED = 10
"""Samples below which nothing is a copy."""


def find_copies(measured: NDArray, *, alike: float = 0.02) -> list[tuple[int, int, str]]:
    """Records that are copies of earlier ones.

    Repeats of one program differ by their noise, copies do not. Outputs that never change are no
    evidence.

    Parameters
    ----------
    measured : NDArray
        (n, T, d_y), NaN where nothing was measured.
    alike : float, default 0.02
        Distance of two records over their motion below which they are compared sample by sample.

    Returns
    -------
    list of (int, int, str)
        The copy, the record that it repeats, and how they differ; "" if they do not.

    """
    seen = np.isfinite(measured)
    values = np.where(seen, measured, 0.0).astype(float)
    count = np.maximum(seen.sum(axis=1, keepdims=True), 1)
    centred = np.where(seen, values - values.sum(axis=1, keepdims=True) / count, 0.0)
    power = np.sum(centred**2, axis=1)  # (n, d_y)
    scale = np.sqrt(power.max(axis=0, initial=0.0))
    moving = (power > (EXACT * scale) ** 2).any(axis=1) & (seen.sum(axis=(1, 2)) >= COMPARED)
    flat = np.divide(centred, scale, out=np.zeros_like(centred), where=scale > 0)
    flat = flat.reshape(len(flat), -1)
    found = []
    for i in np.flatnonzero(moving).tolist():
        apart = np.sum((flat[:i] - flat[i]) ** 2, axis=1)
        near = apart < 4 * SHIFT**2 * alike * np.sum(flat[i] ** 2)
        for j in np.flatnonzero(near & moving[:i]).tolist():
            why = _difference(measured[i], measured[j])
            if why is not None:
                found.append((i, j, why))
                break
    return found


def distinct_records(measured: NDArray) -> NDArray:
    """Indices of the records (n, T, d_y) that are no copies of earlier ones, see `find_copies`."""
    return np.setdiff1d(np.arange(len(measured)), [i for i, _, _ in find_copies(measured)])


def fingerprints(records: Trajectories) -> list[str]:
    """A digest of the measured outputs of each record, by which it is recognised."""
    return [
        identity(observed[mask].astype(np.float32))
        for observed, mask in zip(records.observed, records.mask, strict=True)
    ]


def _difference(one: NDArray, other: NDArray) -> str | None:
    """How two copies (T, d_y) differ; None if they are no copies."""
    for shift in sorted(range(-SHIFT, SHIFT + 1), key=abs):
        a, b = one[max(shift, 0) :], other[max(-shift, 0) :]
        a, b = a[: min(len(a), len(b))].astype(float), b[: min(len(a), len(b))].astype(float)
        both = np.isfinite(a) & np.isfinite(b)
        if both.sum() < max(COMPARED, 0.5 * np.isfinite(one).sum()):
            continue
        same = [_repeats(a[use, k], b[use, k]) for k, use in enumerate(both.T) if use.any()]
        if all(each is not None for each in same) and any(same):
            late = f"shifted by {abs(shift)} sample{'s' * (abs(shift) > 1)}" * bool(shift)
            size = max((np.abs(a - b)[both].max(), 0.0))
            return ", ".join(filter(None, [late, f"up to {size:.2g}" * bool(size)]))
    return None


def _repeats(a: NDArray, b: NDArray, *, near: float = 0.1, same: float = 0.98) -> bool | None:
    """Whether an output (m,) repeats another; False if neither changes, None if it does not.

    Parameters
    ----------
    near : float, default 0.1
        Ratio of the difference of two records to the noise of either, below which they are copies:
        that of repeats is 1.4.
    same : float, default 0.98
        Share of equal samples of a sensor with steps, in motion, from which on records are copies.

    """
    apart, spread = np.abs(a - b), np.ptp(a)
    if spread == 0 or np.ptp(b) == 0:
        return False if spread == np.ptp(b) == 0 and apart[0] <= EXACT * abs(a[0]) else None
    if apart.max() <= EXACT * spread:
        return True
    third = np.diff(a, n=3)
    noise = np.sqrt(np.mean(third**2) / 20)
    if np.sqrt(np.mean(apart**2)) <= near * noise and len(a) > COMPARED:
        return True
    moves = np.diff(a) != 0
    if apart.max() > 1.5 * np.abs(np.diff(a)[moves]).min():
        return None  # more than the step of any quantisation
    step = np.diff(np.unique(np.concatenate([a, b]))).min()
    quantised = len(np.unique(a)) < len(a) / 2 and moves.sum() >= COMPARED
    alike = apart.max() <= 1.5 * step and (apart[1:][moves] < step / 2).mean() >= same
    return True if quantised and alike else None
