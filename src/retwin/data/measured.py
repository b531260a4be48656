"""What was measured in trajectories: nothing at all, or values that no sensor gives."""

from __future__ import annotations

import numpy as np

from retwin.checks import require
from retwin.data.trajectories import Trajectories

MAX_RATIO, MAX_VALUE = 1e6, 1e18
"""Largest measurement, over the usual size of an output and in any case: float32 has seven digits,
and the squares of larger numbers are infinite."""
USUAL = 0.99
"""Quantile of the magnitudes of measurements that is their usual size: a file has fewer values that
stand for a missing measurement, or they are the measurements."""


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
    require(
        not len(i),
        f"{argument}.observed",
        expected=f"measurements below {MAX_RATIO:g} times the {usual}",
        got=", ".join(
            f"{size[each, :, at].max():.3g} of {trajectories.outputs.names[at]} "
            f"in {trajectories.ids[each]}"
            for each, at in zip(i, k, strict=True)
        ),
        remedy="replace the values that stand for a missing measurement by NaN",
    )


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


def measured_only(trajectories: Trajectories) -> Trajectories:
    """The trajectories in which something was measured, as independent as they are many.

    All are left if it is none: what needs measurements then refuses them.
    """
    some = trajectories.mask.any(axis=(1, 2))
    return trajectories if some.all() or not some.any() else trajectories[np.flatnonzero(some)]
