"""Estimates of parameters with their uncertainty, and what the measurements leave open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from retwin.twins.wrappers.parametric import Parameter, ParametricTwin
from retwin.update.identification.identifiability import UNIFORM
from retwin.update.identification.identify import Updated
from retwin.update.identification.posterior import Posterior

NEAR = 0.01
"""Distance from a bound, in widths of the range, within which draws count as on it."""
WIDEST = 0.5
"""Share of a range that the 95 % interval of an identified parameter covers at most: the
measurements then halve what was known before."""
MARGIN, SMALLEST = 5.0, 0.2
"""Width of what simulations of a state surrogate cover, over that of an interval, since corrected
dynamics move parameters by more than their errors; and the least share of a range."""
Basis = Literal["trajectories", "samples", "posterior", "none"]
"""What standard errors rest on: differences between trajectories, samples whose residuals correlate
as those of a first-order autoregression, or draws from the posterior."""


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter before and after identification.

    Attributes
    ----------
    name, unit : str
        Its name and unit.
    low, high : float
        The range within which it was searched.
    start, value : float
        Value before and after; for a posterior its mean.
    error : float
        Standard error, or posterior standard deviation; NaN where it is not defined, as at a
        bound, and infinite where no output depends on the parameter.
    interval : (float, float) or None
        The 95 % interval, None where there is no error.
    identified : bool
        Whether the measurements determine it: its 95 % interval lies within its range, of which it
        covers half at most, it neither is at a bound nor depends on one, and starts that fit
        equally well agree. A range of positive values ends at 0 or above, so that the interval then
        excludes 0.
    at_bound : "low", "high" or ""
        The bound on which it lies; the true value may be beyond it.
    depends : bool
        Whether its value depends on the bound of another parameter: without bounds it would move by
        more than half of its 95 % interval.
    own : bool
        Whether it is a start of which each record has its own: `value` is their mean, and `error`
        their standard deviation.

    """

    name: str
    unit: str
    low: float
    high: float
    start: float
    value: float
    error: float
    interval: tuple[float, float] | None
    identified: bool
    at_bound: Literal["low", "high", ""]
    depends: bool = False
    own: bool = False

    @property
    def covered(self) -> float | None:
        """The share of its range that its 95 % interval covers; None where there is no interval.

        Parts of the interval beyond the range do not count.
        """
        if self.interval is None:
            return None
        low, high = max(self.interval[0], self.low), min(self.interval[1], self.high)
        return max(0.0, high - low) / (self.high - self.low)

    @property
    def leaves(self) -> bool:
        """Whether its 95 % interval reaches an end of its range."""
        return self.interval is not None and not (
            self.low < self.interval[0] and self.interval[1] < self.high
        )


def spread_of(parameters: Sequence[ParameterEstimate]) -> float:
    """Share of the ranges, about the values, that is `MARGIN` times as wide as each interval.

    It is 1 where a parameter is not identified, so that its whole range has to be simulated.
    """
    shares = [SMALLEST]
    for each in parameters:
        if each.at_bound or each.own:
            continue
        if not each.identified or each.interval is None:
            return 1.0
        shares.append(MARGIN * (each.interval[1] - each.interval[0]) / (each.high - each.low))
    return min(1.0, max(shares))


@dataclass(frozen=True)
class Direction:
    """A combination of parameters, in widths of their ranges.

    Attributes
    ----------
    components : dict of str to float
        The larger components of its unit vector, by the name of the parameter.
    error : float
        Standard error along it, in widths of the ranges; infinite where no output depends on it.
    open : bool
        Whether the measurements leave it open: its error is not smaller than that of a uniform
        distribution over the range.

    """

    components: dict[str, float]
    error: float
    open: bool


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Estimates, their correlation (k, k), directions from best to least determined, and basis."""

    parameters: tuple[ParameterEstimate, ...]
    correlation: NDArray
    directions: tuple[Direction, ...]
    basis: Basis


def uncertainty_of(before: ParametricTwin, found: Updated | Posterior) -> Uncertainty:
    """The estimates of a result of `rt.identify`, for a twin at its values before."""
    return _of_posterior(before, found) if isinstance(found, Posterior) else _of_fit(before, found)


def _of_fit(before: ParametricTwin, found: Updated) -> Uncertainty:
    """By the curvature at the optimum; starts that each record has for itself are no part of it."""
    local, names = found.identifiability, before.names
    pairs = list(zip(before.parameters, before.values, strict=True))
    starts = [each for each in pairs if each[0].name in found.own_starts]
    shared, known = zip(*(each for each in pairs if each not in starts), strict=True)
    before = replace(before, parameters=shared, values=known)
    errors = np.array(list(found.errors.values()))
    values = np.array([found.values[name] for name in local.names])
    intervals = np.array(list(found.intervals.values())).reshape(-1, 2)
    basis: Basis = "trajectories"
    if np.isnan(errors).any():
        basis, errors = "samples", np.asarray(local.errors, dtype=float)
        half = stats.t.ppf(0.975, local.freedom) * errors
        intervals = np.stack([values - half, values + half], axis=1)
    singular = np.asarray(local.singular_values, dtype=float)
    with np.errstate(divide="ignore"):
        along = np.where(singular > 0, 1 / singular, np.inf)
    directions = _directions(before.names, local.directions, along, UNIFORM)
    ends = [_end(each, low, high) for each, low, high in zip(values, *before.bounds, strict=True)]
    # A search leaves a parameter without effect where it began, which may be a bound.
    bound = local.at_bound & np.isfinite(local.errors)
    sides = [end if at else "" for end, at in zip(ends, bound, strict=True)]
    about = values, errors, intervals, local.identified, sides
    made = {each.name: each for each in estimates(before, *about, depends=local.depends)}
    made |= {each.name: _own_start(each, at, found) for each, at in starts}
    places = [names.index(name) for name in local.names]
    correlation = np.full((len(names), len(names)), np.nan)
    correlation[np.ix_(places, places)] = local.correlation
    return Uncertainty(tuple(made[name] for name in names), correlation, directions, basis)


def _own_start(parameter: Parameter, before: float, found: Updated) -> ParameterEstimate:
    """A start of which each record has its own."""
    name = parameter.name
    about = name, parameter.unit, parameter.low, parameter.high, before
    error = found.own_starts[name]
    return ParameterEstimate(*about, found.values[name], error, None, True, "", own=True)


def _of_posterior(
    before: ParametricTwin, found: Posterior, *, crowded: float = 0.1, open_from: float = 0.8
) -> Uncertainty:
    """By the draws.

    Parameters
    ----------
    crowded : float, default 0.1
        Share of the draws near a bound from which a parameter counts as at the bound; of a uniform
        distribution it is 0.01.
    open_from : float, default 0.8
        Posterior standard deviation, over that of the prior, from which a direction counts as open.

    """
    low, high = before.bounds
    width = high - low
    scaled = (found.samples - low) / width
    deviation = scaled.std(axis=0)
    near = np.stack([(scaled < NEAR).mean(axis=0), (scaled > 1 - NEAR).mean(axis=0)])
    sides = [
        ("low", "high")[int(share.argmax())] if share.max() > crowded else "" for share in near.T
    ]
    variances, vectors = np.linalg.eigh(np.atleast_2d(np.cov(scaled.T)))
    along = np.sqrt(np.maximum(variances, 0.0))
    directions = _directions(before.names, vectors.T, along, open_from * UNIFORM)
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.atleast_2d(np.corrcoef(scaled.T))
    intervals = np.quantile(found.samples, [0.025, 0.975], axis=0).T
    about = (
        found.samples.mean(axis=0),
        deviation * width,
        intervals,
        deviation < open_from * UNIFORM,
    )
    made = estimates(before, *about, sides, bounded=True)
    return Uncertainty(made, correlation, directions, "posterior")


def _end(value: float, low: float, high: float) -> Literal["low", "high"]:
    return "low" if value - low < high - value else "high"


def estimates(
    before: ParametricTwin,
    values: NDArray,
    errors: NDArray,
    intervals: NDArray,
    agreed: NDArray,
    sides: Sequence[str],
    *,
    bounded: bool = False,
    depends: Sequence[bool] | NDArray = (),
) -> tuple[ParameterEstimate, ...]:
    """One estimate per parameter; at a bound a fit has no error, whose theory ends there.

    `agreed` states which may be identified by what is known beside their intervals, and `depends`
    which depend on the bound of another one: none by default.
    """
    made = []
    for i, each in enumerate(before.parameters):
        lost = (bool(sides[i]) and not bounded) or np.isnan(errors[i])
        known = not lost and np.isfinite(intervals[i]).all()
        about = each.name, each.unit, each.low, each.high, before.values[i], float(values[i])
        error = float("nan") if lost else float(errors[i])
        interval = (float(intervals[i][0]), float(intervals[i][1])) if known else None
        side, depending = sides[i], bool(len(depends) and depends[i])
        estimate = ParameterEstimate(*about, error, interval, False, side, depending)  # type: ignore[arg-type]
        narrow = estimate.covered is not None and estimate.covered <= WIDEST
        inside = narrow and not estimate.leaves and not sides[i]
        made.append(replace(estimate, identified=bool(agreed[i]) and inside))
    return tuple(made)


def _directions(
    names: Sequence[str], vectors: NDArray, along: NDArray, limit: float, *, small: float = 0.1
) -> tuple[Direction, ...]:
    """Directions in rows, the best determined first.

    Parameters
    ----------
    small : float, default 0.1
        Least component of a direction that is listed.

    """
    made = []
    for i in np.argsort(along, kind="stable"):
        vector = vectors[i] * (1.0 if vectors[i][np.argmax(np.abs(vectors[i]))] >= 0 else -1.0)
        shown = [j for j in np.argsort(-np.abs(vector)) if abs(vector[j]) > small]
        components = {names[j]: float(vector[j]) for j in shown}
        made.append(Direction(components, float(along[i]), bool(along[i] >= limit)))
    return tuple(made)
