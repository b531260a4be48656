"""Integrals over the size, the onset and the end of a fault, by a grid that refines itself.

The likelihood of a record is narrow in these quantities and can have several modes. The likelihood
is evaluated at the centres of the cells of a grid. The cells that contribute most, and those beside
the best one, are halved along each side until the integral changes no more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

CELLS = {1: 48, 2: 12, 3: 8}
"""Cells along each side at first, by the number of quantities that are open."""
OCTAVES = {1: 12, 2: 9, 3: 6}
"""Times that the cells of an effect are halved towards 0 at first, by the same number."""


@dataclass(frozen=True)
class Refinement:
    """Which cells are refined, and when there is no further round.

    Parameters
    ----------
    negligible : float
        How many nats below the largest contribution a cell is refined no further: 3e-4 of it.
    min_refined : int
        Number of cells that are refined at least, since a maximum may lie off all centres.
    max_refined : int
        Number of cells that are refined at most, for likelihoods that hardly depend on anything.
    tolerance : float
        Change of the log integral in nats, below which there is no further round.
    max_cell_share : float
        Share of one cell, below which there is no further round: intervals are no finer than a
        cell.
    rounds : int
        Rounds at most.

    """

    negligible: float = 8.0
    min_refined: int = 12
    max_refined: int = 500
    tolerance: float = 0.05
    max_cell_share: float = 0.03
    rounds: int = 30


@dataclass(frozen=True, eq=False)
class Integral:
    """The posterior of K quantities that are uniform between limits beforehand.

    Attributes
    ----------
    evidence : float
        Log of the likelihood's mean over the prior.
    best : NDArray
        (K,), where the likelihood is largest.
    low, mean, high : NDArray
        (K,), the mean of each quantity, and its central interval; NaN where nothing has a
        likelihood.

    """

    evidence: float
    best: NDArray
    low: NDArray
    mean: NDArray
    high: NDArray


def integrate(
    log_likelihood: Callable[[NDArray], NDArray],
    limits: NDArray,
    whole: NDArray,
    coverage: float,
    refinement: Refinement = Refinement(),
    effect: int | None = None,
) -> Integral:
    """Integrate a likelihood over a box.

    The centre of a first cell of an effect is between 3/4 and 3/2 of each value in it, unless that
    is next to 0: so an effect that is small beside its limits is closer to it than to none, and its
    cell is refined.

    Parameters
    ----------
    log_likelihood : callable
        From points (J, K) to logarithms (J,); minus infinity where there is no prior probability.
    limits : ndarray, shape (K, 2)
        Lowest and highest value of each quantity; equal ones are known.
    whole : ndarray of bool, shape (K,)
        Which quantities are whole numbers.
    coverage : float
        Probability of the intervals.
    refinement : Refinement
        Which cells are refined.
    effect : int, optional
        The quantity whose value 0 is no effect, if its limits include 0.

    """
    is_open = limits[:, 1] > limits[:, 0]
    # A whole number stands for the interval of length 1 about it.
    outer = limits + np.where((whole & is_open)[:, None], [-0.5, 0.5], 0.0)
    sides = outer[:, 1] - outer[:, 0]
    count = CELLS.get(int(is_open.sum()), 1)
    edges = [
        _edges(ends, count if free else 1, only)
        for ends, free, only in zip(outer, is_open, whole, strict=True)
    ]
    if effect is not None and is_open[effect] and limits[effect, 0] <= 0 <= limits[effect, 1]:
        parts = 0.5 ** np.arange(OCTAVES[int(is_open.sum())] + 1)
        edges[effect] = np.unique(np.append(np.outer(limits[effect], parts), 0.0))
    cells = np.array(list(product(*[pairwise(each) for each in edges])))

    def centre_of(of: NDArray) -> NDArray:
        """Points (..., K) in the middle of cells (..., K, 2)."""
        middle = of.mean(axis=-1)
        return np.where(whole, np.round(middle), middle)

    def volume(of: NDArray) -> NDArray:
        """Log shares (J,) of the box that cells (J, K, 2) fill."""
        share = np.where(is_open, of[..., 1] - of[..., 0], 1.0) / np.where(is_open, sides, 1.0)
        return np.log(share).sum(axis=1)

    def log_mass(of: NDArray) -> NDArray:
        """The log integrals (J,) over cells (J, K, 2)."""
        return log_likelihood(centre_of(of)) + volume(of)

    mass = log_mass(cells)
    total = _total(mass)
    for _ in range(refinement.rounds if is_open.any() and np.isfinite(total) else 0):
        best = cells[np.argmax(mass)]
        # The likelihood may end abruptly, so that a maximum lies at the edge of a poor cell.
        beside = ((cells[..., 0] <= best[:, 1]) & (cells[..., 1] >= best[:, 0])).all(axis=1)
        fewest = np.sort(mass)[-min(refinement.min_refined, len(mass))]
        lowest = min(fewest, mass.max() - refinement.negligible)
        order = np.argsort(np.where(beside, -np.inf, -mass))
        wanted = beside | ((mass >= lowest) & np.isfinite(mass))
        chosen = order[: min(int(wanted.sum()), refinement.max_refined)]
        parts = np.concatenate([_halves(each, whole) for each in cells[chosen]])
        if len(parts) == len(chosen):
            break
        cells = np.concatenate([np.delete(cells, chosen, axis=0), parts])
        mass = np.concatenate([np.delete(mass, chosen), log_mass(parts)])
        before, total = total, _total(mass)
        small = mass.max() < total + np.log(refinement.max_cell_share)
        if small and abs(total - before) < refinement.tolerance:
            break
    if not np.isfinite(total):
        return Integral(-np.inf, *[np.full(len(limits), np.nan)] * 4)
    weight = np.exp(mass - total)
    summaries = [_summary(weight, cells[:, k], coverage) for k in range(len(limits))]
    best = centre_of(cells[np.argmax(mass - volume(cells))])
    return Integral(total, best, *np.clip(np.array(summaries).T, *limits.T))


def _total(mass: NDArray) -> float:
    best = mass.max()
    return float(best + np.log(np.exp(mass - best).sum())) if np.isfinite(best) else -np.inf


def _edges(ends: NDArray, count: int, whole: bool) -> NDArray:
    """Edges of the cells of one side; a cell of whole numbers contains one at least."""
    made = np.linspace(ends[0], ends[1], count + 1)
    return np.unique(np.round(made - 0.5) + 0.5) if whole and ends[1] > ends[0] else made


def _halves(cell: NDArray, whole: NDArray) -> NDArray:
    """The parts (J, K, 2) of a cell (K, 2) that is halved along each side."""
    sides = []
    for (low, high), only in zip(cell, whole, strict=True):
        middle = np.floor((low + high) / 2) + 0.5 if only else (low + high) / 2
        inside = low < middle < high
        sides.append([(low, middle), (middle, high)] if inside else [(low, high)])
    return np.array(list(product(*sides)))


def _summary(weight: NDArray, ends: NDArray, coverage: float) -> tuple[float, float, float]:
    """Lower end, mean and upper end of a quantity that is uniform in each cell (J, 2)."""
    mean = float(weight @ ends.mean(axis=1))
    edges, place = np.unique(ends, return_inverse=True)
    if len(edges) == 1:  # of a known quantity
        return mean, mean, mean
    first, last = place.reshape(ends.shape).T
    density = weight / (ends[:, 1] - ends[:, 0])
    change = np.bincount(first, density, len(edges)) - np.bincount(last, density, len(edges))
    # The distribution function at each edge.
    below = np.append(0.0, np.cumsum(np.cumsum(change)[:-1] * np.diff(edges)))
    levels = (1 - coverage) / 2, (1 + coverage) / 2
    low, high = np.interp(levels, below, edges).tolist()
    return low, mean, high
