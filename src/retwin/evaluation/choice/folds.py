"""Parts of records that are left out of a fit: whole records, blocks of time, and edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.update.dynamics.estimation import correlation_time
from retwin.update.forecast_errors import channel_excess, value_range
from retwin.update.forecasts import values_of

RECORDS = 4
"""Records from which on whole ones are left out, in so many groups at most."""


@dataclass(frozen=True, eq=False)
class Fold:
    """A part of the records that is left out.

    Attributes
    ----------
    name : str
        What it is, in words.
    held : NDArray
        (n, T) bool, the samples that are left out.
    edge : bool
        Whether it holds the largest commands and outputs, so that a model has to extrapolate.

    """

    name: str
    held: NDArray
    edge: bool = False

    @property
    def rows(self) -> NDArray:
        """Indices of the records of which something is left out."""
        return np.flatnonzero(self.held.any(axis=1))

    def training(self, records: Trajectories) -> Trajectories:
        """The records without it: whole ones are dropped, of others the outputs are masked."""
        kept = np.flatnonzero(~self.held.all(axis=1))
        mask = records.mask & ~self.held[..., None]
        return records.replace(mask=mask)[kept]

    def excess(self, records: Trajectories) -> NDArray:
        """How far its values (d_u + d_y,) leave the range of the others, in widths of that."""
        values = values_of(records)
        others = np.where(self.held[..., None], np.nan, values)
        held = np.where(self.held[..., None], values, np.nan)
        return np.asarray(channel_excess(held, *value_range(others)).max(axis=(0, 1)))


def folds_of(records: Trajectories, *, blocks: int = 4) -> list[Fold]:
    """The parts of the records that are left out in turn.

    Whole records where there are four or more, else the last three of four blocks of time of every
    record; and the quarter of all blocks in which outputs or commands reach furthest.

    Parameters
    ----------
    blocks : int, default 4
        Blocks of time of fewer records. The first one is always fitted, so that the start of a
        record is known; each of the others is left out once.

    """
    count, steps = records.mask.shape[:2]
    seen = np.asarray(records.mask.any(axis=2))
    if count >= RECORDS:
        group = np.arange(count) % RECORDS
        made = [
            Fold("whole records", np.tile((group == i)[:, None], (1, steps)) & seen)
            for i in range(RECORDS)
        ]
    else:
        block = np.minimum(_position(seen) * blocks, blocks - 1).astype(int)
        made = [
            Fold(f"block {i + 1} of {blocks} in time", (block == i) & seen)
            for i in range(1, blocks)
        ]
    return [*made, Fold("largest commands and outputs", _edges(records), edge=True)]


def _position(seen: NDArray) -> NDArray:
    """The place (n, T) of each sample in the measured part of its record, from 0 to 1."""
    number = np.cumsum(seen, axis=1)
    return np.asarray((number - seen) / np.maximum(number[:, -1:], 1))


def _edges(records: Trajectories, *, reaching: float = 0.25, short: int = 24) -> NDArray:
    """The samples (n, T) of the blocks that reach furthest from the means.

    Parameters
    ----------
    reaching : float, default 0.25
        Share of the blocks that reach furthest from the mean, which are left out together.
    short : int, default 24
        Blocks of time among which these are searched, per record.

    """
    seen = np.asarray(records.mask.any(axis=2))
    measured = np.where(records.mask, records.observed, np.nan).astype(np.float64)
    values = np.concatenate([records.commands.astype(np.float64), measured], axis=2)
    values = np.where(seen[..., None], values, np.nan)
    spread = np.nanstd(values, axis=(0, 1))
    distance = np.abs(values - np.nanmean(values, axis=(0, 1))) / np.where(spread > 0, spread, 1.0)
    far = np.nan_to_num(np.nanmax(np.where(spread > 0, distance, 0.0), axis=2, initial=0.0))
    if len(records) >= RECORDS:
        block, count = np.zeros(seen.shape, dtype=int), 1
    else:
        count = short
        block = np.minimum(_position(seen) * count, count - 1).astype(int)
    number = block + count * np.arange(len(records))[:, None]
    reached = np.zeros(count * len(records))
    np.maximum.at(reached, number[seen], far[seen])
    if count > 1:  # the start of a record is known
        reached[::count] = -1.0
    chosen = np.argsort(-reached, kind="stable")[: max(1, int(reaching * len(reached)))]
    return np.asarray(np.isin(number, chosen) & seen)


def independent_means(values: NDArray, lengths: Sequence[int]) -> NDArray:
    """Means of what is nearly independent in scores (n, F, T) of F parts, without those of NaN.

    Where whole records are left out, it is a record, whichever parts it belongs to: records differ
    as other days do, which blocks within them do not show. Else it is a block of `lengths` (F,).
    """
    if len(values) >= RECORDS:
        return block_means(values.reshape(len(values), -1), values.size)
    return np.concatenate(
        [block_means(own, e) for own, e in zip(values.swapaxes(0, 1), lengths, strict=True)]
    )


def block_means(values: NDArray, length: int) -> NDArray:
    """Means of consecutive samples (n, T) that are no NaN, of `length` each, within records."""
    made = []
    for row in values:
        own = row[np.isfinite(row)]
        if len(own):
            made += [each.mean() for each in np.array_split(own, max(1, len(own) // length))]
    return np.array(made)


def block_length(
    values: NDArray, held: NDArray, *, independent: float = 5.0, scored: int = 12
) -> int:
    """Samples of a block of scores (n, T), by the correlation time of these where they are held.

    Parameters
    ----------
    independent : float, default 5.0
        Length of a block of scores in correlation times, so that blocks are nearly independent.
    scored : int, default 12
        Blocks of scores per part that is left out, at most.

    """
    centred = np.where(held, values - values[held].mean(), 0.0)
    longest = max(1, int(held.sum(axis=1).max()))
    shortest = max(1, int(held.sum()) // scored)
    return int(np.clip(independent * correlation_time(centred[..., None]), shortest, longest))
