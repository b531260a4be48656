"""`hold_out`: measurements that identification does not use, to validate its result."""

from __future__ import annotations

import numpy as np

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.update.identification.identifiability import MIN_TRAJECTORIES

SHARE = 0.25
"""The share of the measurements that is held out by default."""


def hold_out(
    measured: Trajectories, share: float = SHARE, *, seed: int
) -> tuple[Trajectories, Trajectories | None]:
    """Split measurements into those for identification and those for validation.

    From four trajectories on, whole trajectories are held out, and three at least remain for the
    standard errors. Of fewer trajectories the last part of each is held out: its commands stay in
    both sets, since the state at its begin is the result of all earlier ones, and its outputs are
    masked in the first set.

    Parameters
    ----------
    measured : Trajectories
        All measurements.
    share : float
        The share that is held out, from 0 to below 1; 0 holds out nothing.
    seed : int
        Seed of the choice of trajectories.

    Returns
    -------
    (Trajectories, Trajectories or None)
        For identification, and for validation; None where nothing is held out.

    Raises
    ------
    InputError
        The share is out of range, or leaves one of the sets without a measurement.

    """
    expected = "a number from 0 to below 1"
    remedy = "a quarter is usual; 0 holds out nothing"
    require(0 <= share < 1, "share", expected=expected, got=repr(share), remedy=remedy)
    if share == 0:
        return measured, None
    count = len(measured)
    if count > MIN_TRAJECTORIES:
        held = min(max(1, round(share * count)), count - MIN_TRAJECTORIES)
        chosen = np.zeros(count, dtype=bool)
        chosen[np.random.default_rng(seed).permutation(count)[:held]] = True
        parts = measured[~chosen], measured[chosen]
    else:
        # By the last sample that was measured, since shorter trajectories are padded.
        seen = np.any(measured.mask, axis=2)
        last = measured.steps - np.argmax(seen[:, ::-1], axis=1)
        first = np.asarray(np.round((1 - share) * last))[:, None, None]
        after = np.arange(measured.steps)[None, :, None] >= first
        parts = (
            measured.replace(mask=measured.mask & ~after),
            measured.replace(mask=measured.mask & after),
        )
    require(
        all(each.mask.any() for each in parts),
        "share",
        expected="a share that leaves measurements to both sets",
        got=repr(share),
        remedy="give another share, or 0 to hold out nothing",
    )
    return parts
