"""How far measured outputs agree with nominal ones, and what the disagreement looks like."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.finding import Finding
from retwin.data.trajectories import Trajectories

CLEAR = 0.5
"""Share of the variance below which an output is not explained by its own nominal output."""
FACTOR = 10.0
"""Ratio of what is not explained from which on another explanation is named."""
OWN = 0.9
"""Share of the variance from which on a record belongs to its commands, whatever fits as well."""
STRETCHES = np.array([0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2, 1.25])
"""Time bases that are tried."""
FASTER = 3.0
"""Ratio of what is not explained from which on another time base is named; twins that are not
identified have up to 1.5 by chance."""
POWERS = 0.05, 0.25
"""Decades from one power of ten, and from a higher one, within which a unit is named."""
OTHER, UNLIKE = GENERAL = ("other commands", "unlike the others")
"""What is wrong with a record of which nothing else is known."""


def explained_shares(records: Trajectories) -> dict[str, dict[str, float]]:
    """Share of the variance of each output that its nominal output explains.

    Parameters
    ----------
    records : Trajectories
        With nominal outputs.

    Returns
    -------
    dict of str to dict of str to float
        For `healthy` (or unlabelled) and `faulty` records, by output: 1 − Σ(y − nominal)² over
        Σ(y − mean)². It is negative where the nominal output is worse than the mean; NaN where the
        output never changes. Kinds of which there is no record are left out.

    """
    made = {}
    for kind, rows in (("healthy", records.maybe_healthy), ("faulty", ~records.maybe_healthy)):
        if not rows.any():
            continue
        y = records.measured[rows].astype(float)
        residual = np.nansum((y - records.nominal[rows]) ** 2, axis=(0, 1))
        count = np.maximum(np.isfinite(y).sum(axis=(0, 1)), 1)
        power = np.nansum((y - np.nansum(y, axis=(0, 1)) / count) ** 2, axis=(0, 1))
        share = 1 - np.divide(residual, power, out=np.full_like(power, np.nan), where=power > 0)
        made[kind] = dict(zip(records.outputs.names, share.tolist(), strict=True))
    return made


def find_disagreements(records: Trajectories) -> Iterator[Finding]:
    """Records of other commands, exchanged outputs, other units, time bases, and wrong labels."""
    varies = np.ptp(records.nominal, axis=(0, 1)) > 0 if len(records) else np.zeros(0, bool)
    varies &= records.mask.any(axis=(0, 1))
    if not varies.any():
        return
    y = records.measured[..., varies].astype(float)
    ideal = np.where(np.isfinite(y), records.nominal[..., varies], np.nan).astype(float)
    names = [name for name, own in zip(records.outputs.names, varies, strict=True) if own]
    seen = np.isfinite(y).any(axis=(1, 2))
    healthy = np.flatnonzero(records.maybe_healthy & seen)
    if not len(healthy):
        return
    own = records[healthy]
    y, ideal = y[healthy], ideal[healthy]
    yield from _find_permutations(own, _square(y, ideal))
    yield from _find_exchange(own, names, y, ideal)
    yield from _units(names, y, ideal)
    yield from _time_base(own, y, ideal)
    yield from _unlike(own, names, y, ideal)


def _unit_length(values: NDArray, axis: tuple[int, ...] | int) -> NDArray:
    """Values, NaN where missing, centred and divided by their length; 0 where missing."""
    count = np.maximum(np.isfinite(values).sum(axis=axis, keepdims=True), 1)
    centred = np.nan_to_num(values - np.nansum(values, axis=axis, keepdims=True) / count)
    length = np.sqrt(np.sum(centred**2, axis=axis, keepdims=True))
    return np.divide(centred, length, out=np.zeros_like(centred), where=length > 0)


def _square(y: NDArray, ideal: NDArray) -> NDArray:
    """Squared correlation (n, n) of the outputs of each record with the nominal ones of each.

    It is the mean over outputs, by the motion of each nominal one.
    """
    one, other = _unit_length(y, 1), _unit_length(ideal, 1)
    spread = np.nanstd(ideal, axis=1)
    largest = np.nanmax(spread, axis=0)
    weight = np.divide(spread, largest, out=np.zeros_like(spread), where=largest > 0)  # (n, d)
    found = np.einsum("itk,jtk->ijk", one, other, optimize=True) ** 2
    total = np.maximum(weight.sum(axis=1), 1e-300)
    return np.asarray((found * weight).sum(axis=2) / total)


def _find_permutations(records: Trajectories, squared: NDArray) -> Iterator[Finding]:
    """Records that fit the commands of another one, and not their own."""
    own, best = np.diag(squared), squared.argmax(axis=1)
    for i, j in enumerate(best.tolist()):
        left = 1 - squared[i, j]
        if own[i] < OWN and left < min(CLEAR, (1 - own[i]) / FACTOR):
            text = f"seems to belong to those of {records.ids[j]}: its outputs fit them by "
            text += f"{1 - left:.0%}, its own by {own[i]:.0%}"
            yield Finding(str(records.ids[i]), "", OTHER, text)


def _find_exchange(
    records: Trajectories, names: list[str], y: NDArray, ideal: NDArray
) -> Iterator[Finding]:
    """Pairs of outputs that fit each other's nominal outputs, in all records or in one."""
    every = [("", slice(None), FASTER)]
    every += [(name, slice(i, i + 1), FACTOR) for i, name in enumerate(records.ids.tolist())]
    for record, rows, factor in every:
        one, other = (_unit_length(each[rows], (0, 1)) for each in (y, ideal))
        left = 1 - np.einsum("itk,itl->kl", one, other) ** 2
        done = False
        for k, m in combinations(range(len(names)), 2):
            if max(left[k, m], left[m, k]) < min(CLEAR, min(left[k, k], left[m, m]) / factor):
                text = f"seems to be exchanged with {names[m]}: {1 - left[k, m]:.0%} of its "
                text += f"variance is that of the other in the twin, {1 - left[k, k]:.0%} its own"
                yield Finding(record, names[k], "exchanged", text)
                done = True
        if done and not record:
            return


def _units(names: list[str], y: NDArray, ideal: NDArray) -> Iterator[Finding]:
    """Outputs that move as far as their nominal ones times a power of ten."""
    seen = np.isfinite(y)
    for k, name in enumerate(names):
        a, b = y[..., k][seen[..., k]], ideal[..., k][seen[..., k]]
        if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0 or not np.isfinite(a.std() / b.std()):
            continue
        correlation = float(np.corrcoef(a, b)[0, 1])
        decades = float(np.log10(a.std() / b.std()))
        power = int(np.rint(decades))
        if correlation < -CLEAR:
            text = f"moves in the opposite direction (correlation {correlation:.2f}): check the "
            yield Finding("", name, "sign", f"{text}sign of the gain")
        elif power and correlation**2 > CLEAR and abs(decades - power) < POWERS[abs(power) > 1]:
            text = f"moves 10^{power} times as far as in the twin: is its unit the same?"
            yield Finding("", name, "unit", text)


def _time_base(records: Trajectories, y: NDArray, ideal: NDArray) -> Iterator[Finding]:
    """Records whose outputs fit their commands at another speed of the clock."""
    seen, here, one = np.isfinite(y), int(np.argmin(np.abs(STRETCHES - 1))), _unit_length(y, 1)
    time = np.arange(y.shape[1])
    errors = np.empty((len(STRETCHES), len(y)))
    for place, factor in enumerate(STRETCHES):
        at = np.minimum(time / factor, len(time) - 1)
        low = np.minimum(at.astype(int), len(time) - 2)
        share = (at - low)[:, None]
        moved = (1 - share) * ideal[:, low] + share * ideal[:, low + 1]
        fits = np.sum(one * _unit_length(np.where(seen, moved, np.nan), 1), axis=1)
        errors[place] = 1 - np.mean(fits**2, axis=1)
    for i, best in enumerate(errors.argmin(axis=0).tolist()):
        if best != here and errors[best, i] < min(1 - OWN, errors[here, i] / FASTER):
            text = f"fits its commands better when its times are divided by {STRETCHES[best]:g}"
            yield Finding(str(records.ids[i]), "", "time base", text)


def _unlike(
    records: Trajectories, names: list[str], y: NDArray, ideal: NDArray, *, moved: float = 0.1
) -> Iterator[Finding]:
    """Outputs that their nominal ones explain in most healthy records, and not in one.

    Parameters
    ----------
    moved : float, default 0.1
        Share of the largest motion of an output below which it counts as that much.

    """
    residual = np.nanmean((y - ideal) ** 2, axis=1)
    motion = np.maximum(np.nanvar(y, axis=1), moved**2 * np.nanvar(ideal, axis=1).max(axis=0))
    share = np.sum(_unit_length(y, 1) * _unit_length(ideal, 1), axis=1)
    moving = np.nanvar(ideal, axis=1) > moved**2 * np.nanvar(ideal, axis=1).max(axis=0)
    unlike = (np.where(moving, 1 - share, 0.0), 1 - CLEAR**0.5), (residual, (1 - CLEAR) * motion)
    for k, name in enumerate(names):
        own = np.flatnonzero(np.isfinite(residual[:, k]))
        if len(own) < 3:
            continue
        far = np.zeros(len(own), dtype=bool)
        for size, large in unlike:
            usual = FACTOR * np.quantile(size[own, k], 0.25)
            far |= size[own, k] > np.maximum(usual, np.broadcast_to(large, size.shape)[own, k])
        for i in own[far].tolist():
            text = f"differs from its twin by {residual[i, k] ** 0.5:.3g} (RMS), most others by "
            text += f"{np.quantile(residual[own, k], 0.25) ** 0.5:.3g}"
            yield Finding(str(records.ids[i]), name, UNLIKE, text)
