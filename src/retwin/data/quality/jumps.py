"""`find_jumps`: spikes and dropouts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.finding import Finding
from retwin.data.quality.readings import Readings

FAR, AGAIN = 3.0, 1.5
"""Factor by which a jump must be larger than all other changes from one sample to the next, and
that of jumps to one value, again and again."""
SHORT = 3
"""Samples of a spike at most, and jumps to one value from which on they are dropouts."""
ALIKE = 1 / 3
"""Distance of the values before and after a jump over its size, at most."""


def find_jumps(every: Sequence[Readings], *, rare: float = 0.1) -> Iterator[Finding]:
    """Short excursions of an output that are far larger than all other changes in all records.

    Parameters
    ----------
    rare : float, default 0.1
        Share of the samples that jumps are at most; what is more frequent is motion.

    """
    steps = [np.abs(np.diff(each.values)) for each in every]
    jumps = np.concatenate([_excursions(place, each) for place, each in enumerate(every)])
    values, counts = np.unique(jumps[:, VALUE], return_counts=True)
    taken = [np.empty((0, 5))]
    # Dropouts have one value, and jumps of all sizes; spikes are larger than all that remains.
    for value in values[counts >= SHORT]:
        own = jumps[:, VALUE] == value
        taken.append(_take_far(jumps[own], steps, AGAIN, together=True))
        if len(taken[-1]):
            jumps = jumps[~own]
    found = np.concatenate([*taken, _take_far(jumps, steps, FAR, together=False)])
    if np.sum(found[:, END] - found[:, START]) <= rare * sum(map(len, steps)):
        for place in np.unique(found[:, PLACE]):
            yield _describe(every[int(place)], found[found[:, PLACE] == place])


PLACE, START, END, SIZE, VALUE = range(5)
"""Columns of an array of jumps: record, begin and end of its samples, size, and value."""


def _excursions(place: int, each: Readings, *, distinct: int = 10) -> NDArray:
    """Jumps (m, 5): values that leave those before and after, which are alike.

    Parameters
    ----------
    distinct : int, default 10
        Values of an output, at least; one with fewer is a switch, which jumps.

    """
    y, step = each.values, np.diff(each.values)
    if len(np.unique(y)) <= distinct:
        return np.empty((0, 5))
    pairs = [
        np.stack([t, t + n], axis=1)
        for n in range(1, SHORT + 1)
        for t in [np.arange(1, len(y) - n)]
    ]
    # Share of a record that a dropout lasts, at most.
    long = np.diff(each.stretches)[:, 0] <= 0.05 * len(y)
    inside = (each.stretches[:, 0] > 0) & (each.stretches[:, 1] < len(y))
    both = np.concatenate([*pairs, each.stretches[long & inside]])
    # As one number each, of which equal ones are found in a tenth of the time.
    start, end = np.divmod(np.unique(both @ [len(y) + 1, 1]), len(y) + 1)
    out, back = step[start - 1], step[end - 1]
    size = np.minimum(np.abs(out), np.abs(back))
    kept = (out * back < 0) & (np.abs(y[end] - y[start - 1]) <= ALIKE * size)
    if each.ideal:
        kept &= np.abs(np.diff(each.drive[:, 0]))[start - 1] <= ALIKE * size
    found = np.stack([np.full(len(start), place), start, end, size, y[start]], axis=1)
    return np.asarray(found[kept])


def _take_far(jumps: NDArray, steps: list[NDArray], factor: float, *, together: bool) -> NDArray:
    """The jumps that are far larger than all other steps, which are then taken out of `steps`.

    `together` takes all of them out first, else only those that are as large.
    """
    jumps = jumps[np.argsort(-jumps[:, SIZE])]
    spans = [(int(each[PLACE]), slice(int(each[START]) - 1, int(each[END]))) for each in jumps]
    rank = [np.full(len(each), len(jumps)) for each in steps]
    for number in range(len(jumps) - 1, -1, -1):
        place, span = spans[number]
        rank[place][span] = 0 if together else number
    # The largest step that is left when the jumps up to each one are taken out.
    left = np.zeros(len(jumps) + 1)
    np.maximum.at(left, np.concatenate(rank), np.concatenate(steps))
    left = np.maximum.accumulate(left[::-1])[::-1][1:]
    far = np.flatnonzero(jumps[:, SIZE] >= factor * left)
    count = far[-1] + 1 if len(far) else 0
    for place, span in spans[:count]:
        steps[place][span] = 0.0
    return jumps[:count]


def _describe(each: Readings, jumps: NDArray) -> Finding:
    """A finding for the jumps of one record."""
    largest = jumps[np.argmax(jumps[:, SIZE]), VALUE]
    count = int(np.sum(jumps[:, END] - jumps[:, START]))
    text = f"{largest:.6g} at {count} sample{'s' * (count > 1)}, far from those around"
    if len(jumps) > 1 and np.ptp(jumps[:, VALUE]) == 0:
        text += ": replace it by NaN if it stands for a missing measurement"
    kind = "spikes" if jumps[:, VALUE].any() else "dropouts"
    return each.finding(kind, text, int(jumps[:, START].min()), int(jumps[:, END].max()))
