"""Profile likelihood: the best fit of the other parameters as a function of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from retwin.checks import one_of, whole
from retwin.data.measured import measured_only
from retwin.data.quality.sensors import limits_of
from retwin.data.trajectories import Trajectories
from retwin.twins.wrappers.sensor_limits import limit_outputs
from retwin.update.identification.identify import Updated
from retwin.update.identification.misfit import misfit_of
from retwin.update.identification.search import LeastSquares, Search
from retwin.update.score_covariance import variance_of


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile likelihood of one parameter.

    Attributes
    ----------
    name : str
        Name of the parameter.
    values : NDArray
        (g,), the values at which it is held.
    objective : NDArray
        (g,), Eq. 2 (or the root of the sum of robust losses) there, with all others fitted anew.
    rise : NDArray
        (g,), twice the negative log-likelihood minus its minimum, with the noise with which its
        curvature is that of the standard error; where that is not known, the noise that the best
        fit leaves and its autocorrelation.
    limit : float
        A value is in the 95 % interval where `rise` is below it: the square of the quantile of
        Student's t distribution that belongs to the standard error.

    """

    name: str
    values: NDArray
    objective: NDArray
    rise: NDArray
    limit: float

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval, by linear interpolation; at a bound it may extend beyond it."""
        inside = self.rise <= self.limit
        first, last = np.flatnonzero(inside)[[0, -1]]
        low, high = self.values[first], self.values[last]
        if first > 0:
            ends = [first, first - 1]
            low = np.interp(self.limit, self.rise[ends], self.values[ends])
        if last < len(self.values) - 1:
            ends = [last, last + 1]
            high = np.interp(self.limit, self.rise[ends], self.values[ends])
        return float(low), float(high)


def profile(
    updated: Updated,
    observed: Trajectories,
    name: str,
    *,
    points: int = 15,
    rate: float | None = None,
    processes: int = 1,
    margin: float = 2.0,
) -> Profile:
    """The profile likelihood of one parameter about its optimum, under the loss that found it.

    Parameters
    ----------
    updated : Updated
        Result of `identify`.
    observed, rate, processes
        As in `identify`.
    name : str
        Name of the parameter.
    points : int
        Values at which it is held, at least 3, within the bounds and up to twice the half of the
        95 % interval to either side, in addition to the optimum.
    margin : float, default 2.0
        Distance of the outermost values from the optimum, in halves of the 95 % interval.

    Returns
    -------
    Profile

    Raises
    ------
    InputError
        No such parameter, or fewer than three points.

    """
    names, local = updated.twin.names, updated.identifiability
    one_of("name", name, local.names)
    whole("points", points, at_least=3)
    which, observed = names.index(name), measured_only(observed)
    own, shared = bool(updated.own_starts), local.names.index(name)
    error, limit = local.errors[shared], stats.t.ppf(0.975, local.freedom[shared]) ** 2
    if np.isfinite(updated.errors[name]):
        error = updated.errors[name]
        limit = stats.t.ppf(0.975, len(observed) - 1) ** 2
    read = limit_outputs(updated.twin, limits_of(observed))
    begin = misfit_of(read, observed, seed=0, rate=rate, processes=processes, own=own)
    with begin as misfit:
        search = Search(misfit, LeastSquares(starts=1), None)
        search.loss, search.scale = updated.loss, updated.scale
        best = (np.array(updated.twin.values) - misfit.low) / search.width
        distance = margin * np.sqrt(limit) * error / search.width[which]
        low, high = max(best[which] - distance, 0.0), min(best[which] + distance, 1.0)
        grid = np.unique(np.append(np.linspace(low, high, points), best[which]))
        sums = _profile_sums(search, which, grid, best)
        _, gradient, curvature = search.linearised(misfit.residuals(search.theta(best[None]))[0])
        residual = gradient / np.sqrt(search.average_curvature(curvature))
        noise = variance_of(residual, int(misfit.seen.sum()), len(names))
        noise *= (error / local.white[shared]) ** 2 if np.isfinite(error) else 1.0
    return Profile(
        name,
        misfit.low[which] + search.width[which] * grid,
        np.sqrt(sums),
        (sums - sums.min()) / max(noise, 1e-300),
        float(limit),
    )


def _profile_sums(search: Search, which: int, grid: NDArray, best: NDArray) -> NDArray:
    """Sums of losses with one parameter held on a grid, from the optimum outwards."""
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
            sums[i] = search.linearised(residual)[0]
    search.free, search.held = np.ones(len(best), dtype=bool), np.zeros(len(best))
    return sums
