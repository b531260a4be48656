"""What was measured in trajectories: nothing at all, or values that no sensor gives."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Trajectories

MAX_RATIO, MAX_VALUE = 1e6, 1e18
"""Largest measurement, over the usual size of an output and in any case: float32 has seven digits,
and the squares of larger numbers are infinite."""
USUAL = 0.99
"""Quantile of the magnitudes of measurements that is their usual size: a file has fewer values that
stand for a missing measurement, or they are the measurements."""

REPEATED, DISTINCT, FAR = 3, 10, 10.0
"""A value stands for a missing measurement if it occurs REPEATED times at least, and is FAR times
further from all others, of which DISTINCT at least differ, than these are from each other. Codes
such as -9999 are; sensors have noise, and hardly repeat a value so far away."""


def check_magnitude(argument: str, trajectories: Trajectories, *, ideal: bool = False) -> None:
    """Refuse values that no sensor gives, beside which the other measurements would be lost.

    Parameters
    ----------
    argument : str
        The name of the trajectories in messages.
    trajectories : Trajectories
        With measured outputs.
    ideal : bool
        Whether the usual size of an output is its largest ideal value, in place of a quantile of
        its measurements.

    Raises
    ------
    InputError
        A measurement is more than MAX_RATIO times the usual size, or more than MAX_VALUE.

    """
    size, mask = np.abs(trajectories.observed), trajectories.mask
    if ideal:
        scale = np.abs(trajectories.nominal).max(axis=(0, 1)).astype(float)
    else:
        columns = [size[..., k][mask[..., k]] for k in range(size.shape[2])]
        scale = np.array([np.quantile(each, USUAL) if each.size else 0.0 for each in columns])
    limit = np.where(scale > 0, MAX_RATIO * scale, np.inf).clip(max=MAX_VALUE)
    i, _, k = np.argwhere(size > limit)[:1].T
    usual = "largest ideal output" if ideal else f"{USUAL:.0%} quantile of the output"
    expected = f"measurements below {MAX_RATIO:g} times the {usual}"
    got = ", ".join(
        f"{size[each, :, at].max():.3g} of {trajectories.outputs.names[at]} "
        f"in {trajectories.ids[each]}"
        for each, at in zip(i, k, strict=True)
    )
    remedy = "replace the values that stand for a missing measurement by NaN"
    require(not len(i), f"{argument}.observed", expected=expected, got=got, remedy=remedy)


def unmeasured(trajectories: Trajectories) -> str:
    """A note that names trajectories in which nothing was measured.

    It is empty if there is none, and if there is no other: what needs measurements refuses them.
    """
    none = ~trajectories.mask.any(axis=(1, 2))
    if none.all() or not none.any():
        return ""
    return (
        f"nothing was measured in {', '.join(trajectories.ids[none].tolist())}, which are not used"
    )


def unmeasured_outputs(trajectories: Trajectories, needed: Collection[str] = ()) -> NDArray:
    """Why there is no evidence in each trajectory (n,); "" where there is.

    Nothing was measured in it, or not all outputs that are `needed`.
    """
    names = np.array(trajectories.outputs.names, dtype=np.str_)
    made = []
    for row in trajectories.mask:
        seen = row.any(axis=0)
        lost = [name for name in names[~seen].tolist() if name in needed]
        reason = f"{', '.join(lost)} never measured" if lost else ""
        made.append(reason if seen.any() else "nothing was measured")
    return np.array(made, dtype=np.str_)


def stand_in(values: NDArray, *, rounded: float = 1e-6) -> tuple[float, int] | None:
    """The value that seems to stand for a missing measurement, and how often it occurs.

    Parameters
    ----------
    values : NDArray
        (n,) of one channel; NaN where nothing was measured.
    rounded : float, default 1e-6
        Relative difference of values that are one: resampling and float32 round.

    Returns
    -------
    tuple of float and int, or None
        None if no value is so far from all others.

    """
    known = values[np.isfinite(values)]
    for extreme in (known.min, known.max) if len(known) else ():
        value = float(extreme())
        others = known[~np.isclose(known, value, rtol=rounded, atol=0.0)]
        if len(others) <= DISTINCT or len(known) - len(others) < REPEATED:
            continue
        low, high = float(others.min()), float(others.max())
        away = min(abs(low - value), abs(high - value))
        if away > FAR * (high - low) and len(np.unique(others[: 100 * DISTINCT])) > DISTINCT:
            return value, len(known) - len(others)
    return None


def measured_only(trajectories: Trajectories) -> Trajectories:
    """The trajectories in which something was measured, as independent as they are many.

    All are left if it is none: what needs measurements then refuses them.
    """
    some = trajectories.mask.any(axis=(1, 2))
    return trajectories if some.all() or not some.any() else trajectories[np.flatnonzero(some)]
