"""Profile likelihood: how well the others can make up for one parameter that is held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.update.identification.identifiability import PLAUSIBLE, noise_of
from retwin.update.identification.identify import Updated
from retwin.update.identification.misfit import misfit_of
from retwin.update.identification.search import LeastSquares, Search

__all__ = ["Profile", "profile"]


@dataclass(frozen=True, eq=False)
class Profile:
    """How well the best of all others fits when one parameter is held (profile likelihood).

    Attributes
    ----------
    name: of the parameter.
    values: (g,) where it was held.
    objective: (g,) of Eq. 2 there (or what a robust loss makes of it), all others fitted anew.
    rise: (g,) of twice the negative log-likelihood over the best; neighbouring residuals are alike,
        and the noise is what the best fit leaves. Below 3.84 the value is plausible at 95 %.
    interval: least and greatest plausible value; at a bound, it may go on beyond.

    """

    name: str
    values: NDArray
    objective: NDArray
    rise: NDArray

    @property
    def interval(self) -> tuple[float, float]:
        """See above; between the grid's points it is linear."""
        inside = self.rise <= PLAUSIBLE
        first, last = np.flatnonzero(inside)[[0, -1]]
        low, high = self.values[first], self.values[last]
        if first > 0:
            low = np.interp(
                PLAUSIBLE, self.rise[[first, first - 1]], self.values[[first, first - 1]]
            )
        if last < len(self.values) - 1:
            high = np.interp(PLAUSIBLE, self.rise[[last, last + 1]], self.values[[last, last + 1]])
        return float(low), float(high)


def profile(
    updated: Updated,
    observed: Trajectories,
    name: str,
    *,
    points: int = 15,
    rate: float | None = None,
    processes: int = 1,
) -> Profile:
    """The profile likelihood of one parameter about its optimum, under the loss that found it.

    Parameters
    ----------
    updated, observed, rate, processes: as they were in `identify`.
    name: of the parameter.
    points: where to hold it: across four standard errors to each side, within the bounds, and at
        the optimum itself.

    Raises
    ------
    InputError: no such parameter, fewer than three points.

    """
    names = updated.twin.names
    if name not in names or points < 3:
        raise InputError(
            "name" if name not in names else "points",
            expected=f"one of {', '.join(names)}" if name not in names else "at least 3",
            got=repr(name) if name not in names else repr(points),
            remedy="check the spelling" if name not in names else "15 serve well",
        )
    which = names.index(name)
    with misfit_of(updated.twin, observed, seed=0, rate=rate, processes=processes) as misfit:
        search = Search(misfit, LeastSquares(starts=1), None)
        search.loss, search.scale = updated.loss, updated.scale
        best = (np.array(updated.twin.values) - misfit.low) / search.width
        reach = 4 * updated.errors[name] / search.width[which]
        low, high = max(best[which] - reach, 0.0), min(best[which] + reach, 1.0)
        grid = np.unique(np.append(np.linspace(low, high, points), best[which]))
        sums = _held(search, which, grid, best)
        _, residual, rise = search.judged(misfit.residuals(search.theta(best[None]))[0])
        noise = rise * noise_of(residual, int(misfit.seen.sum()), len(names))
    return Profile(
        name,
        misfit.low[which] + search.width[which] * grid,
        np.sqrt(sums),
        (sums - sums.min()) / max(noise, 1e-300),
    )


def _held(search: Search, which: int, grid: NDArray, best: NDArray) -> NDArray:
    """Sums of squares with one parameter held on a grid, from the optimum outwards."""
    others = np.arange(len(best)) != which
    search.free = others
    sums = np.empty(len(grid))
    middle = int(np.argmin(np.abs(grid - best[which])))
    for order in (range(middle, len(grid)), range(middle - 1, -1, -1)):
        point = best[others]
        for i in order:
            search.held = np.where(others, 0.0, grid[i])
            if others.any():
                point = search.descend(point).x
            residual = search.residuals(point[None]).reshape(search.misfit.seen.shape)
            sums[i] = search.judged(residual)[0]
    search.free, search.held = np.ones(len(best), dtype=bool), np.zeros(len(best))
    return sums
