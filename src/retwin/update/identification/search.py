"""The search for the optimum: least squares from several starts, or differential evolution."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, differential_evolution, least_squares
from scipy.stats.qmc import LatinHypercube

from retwin.checks import one_of, require, whole
from retwin.progress import Progress, part_of, tracked
from retwin.twins.equations.interpolation import delays_tried
from retwin.update.identification.misfit import Misfit

DIFFERENCE = 1e-3
"""Step of the finite differences, in widths of the bounds."""
TOLERANCE = 1e-6
"""Relative change of the objective, and of the parameters, at which the search stops. It is far
below the effect of noise on them."""
FAILED = 1e3
"""Residual of a simulation that fails, and the largest of others, in standard deviations of the
output or RMS errors at the present values, whichever is larger."""
AT_BOUND = 1e-3
"""Distance from a bound that counts as on it, in widths of the bounds."""
MIN_CURVATURE = 0.05
"""Smallest mean curvature of a loss, which is negative where most residuals are outliers."""
POLISH = 60
"""Largest number of trial steps after a global search."""
Loss = Literal["linear", "soft_l1", "cauchy"]
"""Loss functions of scipy's `least_squares`: the squares of Eq. 2, and two robust ones."""


@dataclass(frozen=True)
class LeastSquares:
    """Trust-region least squares from several starts (scipy's `least_squares`).

    Parameters
    ----------
    starts : int
        The present values, and the others from a Latin hypercube within the bounds; at least 1.
    loss : str
        "linear" is Eq. 2. The others are robust to outliers such as glitches and missed segments,
        beyond 1.4826 times the median absolute residual of the linear optimum: "soft_l1" grows
        linearly with their size, "cauchy" with its logarithm.
    evaluations : int
        Largest number of trial steps per start, at least 1.

    Raises
    ------
    InputError
        An unknown loss, or a count below 1.

    """

    starts: int = 4
    loss: Loss = "soft_l1"
    evaluations: int = 60

    def __post_init__(self) -> None:
        whole("starts", self.starts, at_least=1)
        whole("evaluations", self.evaluations, at_least=1)
        one_of("loss", self.loss, get_args(Loss))


@dataclass(frozen=True)
class Evolution:
    """Differential evolution within the bounds (scipy's), polished by least squares.

    Parameters
    ----------
    population : int
        Members of the population per parameter, at least 1.
    generations : int
        Largest number of generations, at least 1.
    loss : str
        Loss of the final least squares, see `LeastSquares`. The evolution minimises Eq. 2.

    Raises
    ------
    InputError
        An unknown loss, or a count below 1.

    """

    population: int = 10
    generations: int = 50
    loss: Loss = "soft_l1"

    def __post_init__(self) -> None:
        whole("population", self.population, at_least=1)
        whole("generations", self.generations, at_least=1)
        one_of("loss", self.loss, get_args(Loss))


@dataclass(frozen=True)
class Optimum:
    """The optimum from one start.

    Attributes
    ----------
    start, values : tuple of float
        Parameters before and after the search.
    objective : float
        ‖y_obs − f(θ, u)‖ there; under a robust loss the square root of the sum of losses.
    reason : str
        Why the search stopped.

    """

    start: tuple[float, ...]
    values: tuple[float, ...]
    objective: float
    reason: str


class Search:
    """The search over points, which are parameters in widths of their bounds, from 0 to 1.

    Parameters
    ----------
    misfit : Misfit
        Twin and measured data.
    method : LeastSquares or Evolution
        Settings.
    progress : callable or None
        Called with the share of the starts that are done.

    Attributes
    ----------
    free : NDArray
        (k,) bool, the parameters that are searched.
    held : NDArray
        (k,), the point of the others, 0 where a parameter is free.
    limit : float
        Largest absolute residual: of a simulation that runs away the square would be infinite.
    loss, scale
        The loss of the last search, and the residual beyond which a robust one grows slower.

    """

    def __init__(
        self, misfit: Misfit, method: LeastSquares | Evolution, progress: Progress | None
    ) -> None:
        self.misfit = misfit
        self.method = method
        self.progress = progress
        self.width = misfit.high - misfit.low
        self.free = np.ones(len(self.width), dtype=bool)
        self.held = np.zeros(len(self.width))
        self.limit = FAILED * max(misfit.spread, misfit.rms)
        self.loss: Loss = "linear"
        self.scale = 1.0

    def run(self, rng: np.random.Generator) -> list[tuple[Optimum, NDArray]]:
        """All starts' optima, each with its point, best first."""
        size = len(self.width)
        now = np.clip((np.array(self.misfit.twin.values) - self.misfit.low) / self.width, 0, 1)
        if isinstance(self.method, LeastSquares):
            others = LatinHypercube(size, rng=rng).random(self.method.starts - 1)
            starts = np.concatenate([now[None], others])
        else:
            starts = self._evolve(now, rng)[None]
        robust = self.method.loss != "linear"
        first, second = (part_of(self.progress, done, 1 + robust) for done in (0, 1))
        found = [self._search_from(each) for each in tracked(starts, len(starts), first)]
        if robust:
            # All starts share one scale, so that their optima are comparable.
            best = min(found, key=lambda each: each.cost)
            sizes = np.abs(best.fun[self.misfit.seen.ravel()])
            # Exactly 0 is what agrees with a reading at a limit of its sensor.
            middle = float(np.median(sizes[sizes > 0])) if sizes.any() else 0.0
            self.loss = self.method.loss
            self.scale = max(1.4826 * middle, 1e-9 * self.misfit.spread)
            require(
                self.scale > 0,
                "observed",
                expected="outputs that change, or that the twin does not predict exactly",
                got="outputs, measured and simulated, that never change and are equal",
                remedy="give a record in which the system moves, and check its columns",
            )
            found = [self.descend(each.x) for each in tracked(found, len(starts), second)]
        optima = [self._optimum(*each) for each in zip(starts, found, strict=True)]
        return sorted(optima, key=lambda each: each[0].objective)

    def _search_from(self, start: NDArray) -> OptimizeResult:
        """The optimum from a start, whose dead times are the best before and after the search."""
        found = self.descend(self._with_best_delays(start))
        again = self._with_best_delays(found.x)
        return self.descend(again) if (again != found.x).any() else found

    def _with_best_delays(self, point: NDArray) -> NDArray:
        """A point (k,) with the dead times from which a step of the others leaves least."""
        twin = self.misfit.twin
        delays = set(getattr(twin.twin, "delays", {}).values())

        def rest(tried: NDArray, place: int) -> float:
            residual = self.residuals(tried[None])[0]
            by_others = np.delete(self.jacobian(tried, sides=1, residual=residual), place, axis=1)
            step = np.linalg.lstsq(by_others, residual)[0]
            return float(np.sum((residual - by_others @ step) ** 2))

        for place, each in enumerate(twin.parameters):
            if delays & set(each.places):
                values = delays_tried(each.low, each.high, twin.rate) - each.low
                tried = np.tile(point, (len(values) + 1, 1))
                tried[1:, place] = values / self.width[place]
                point = min(tried, key=lambda each: rest(each, place))
        return point

    def _evolve(self, now: NDArray, rng: np.random.Generator) -> NDArray:
        assert isinstance(self.method, Evolution)
        generations = self.method.generations

        def report(intermediate_result: OptimizeResult) -> None:
            if self.progress is not None:
                self.progress(min(0.95, intermediate_result.nit / generations))

        def objective(points: NDArray) -> NDArray:
            return np.sum(self.residuals(points.T) ** 2, axis=1)

        found = differential_evolution(
            objective,
            [(0.0, 1.0)] * len(now),
            popsize=self.method.population,
            maxiter=generations,
            rng=rng,
            x0=now,
            init="latinhypercube",
            vectorized=True,
            updating="deferred",
            polish=False,
            callback=report,
        )
        return found.x

    def theta(self, points: NDArray) -> NDArray:
        """Parameters (m, k) at points (m, number of free ones), completed by those held."""
        whole = np.tile(self.held, (len(points), 1))
        whole[:, self.free] = points
        return self.misfit.low + self.width * whole

    def residuals(self, points: NDArray) -> NDArray:
        """Residuals (m, n P d_y) at points (m, number of free ones)."""
        flat = self.misfit.residuals(self.theta(points)).reshape(len(points), -1)
        return np.clip(np.nan_to_num(flat, nan=self.limit), -self.limit, self.limit)

    def jacobian(
        self, point: NDArray, *, sides: Literal[1, 2] = 2, residual: NDArray | None = None
    ) -> NDArray:
        """Derivative (n P d_y, k) at a point (k,), the twin's own or by differences.

        Differences are one-sided, or central but at a bound and next to a simulation that fails.
        `residual` (n P d_y,) is that at the point, if it is known. It is 0 where a residual is at
        its limit.
        """
        if residual is None:
            residual = self.residuals(point[None])[0]
        limited = np.abs(residual) >= self.limit
        exact = self.misfit.derivatives(self.theta(point[None])[0])
        if exact is not None:
            largest = self.limit / DIFFERENCE
            own = np.clip((exact * self.width)[:, self.free], -largest, largest)
            return np.where(limited[:, None], 0.0, own)
        step = np.diag(np.where(point > 0.5, -DIFFERENCE, DIFFERENCE))
        inward, outward = np.clip(point + step, 0, 1), np.clip(point - step, 0, 1)
        points = np.concatenate([inward, outward]) if sides == 2 else inward
        residuals = self.residuals(points)
        failed = ((np.abs(residuals) >= self.limit) & ~limited).any(axis=1)
        residuals[:, limited] = residual[limited]
        points[failed], residuals[failed] = point, residual
        size = len(point)
        length = np.diag(points[:size] - (points[size:] if sides == 2 else point))[:, None]
        difference = residuals[:size] - (residuals[size:] if sides == 2 else residual)
        return np.divide(difference, length, out=np.zeros_like(difference), where=length != 0).T

    def descend(self, start: NDArray) -> OptimizeResult:
        """The local optimum from a start."""
        unit = self.misfit.spread or 1.0  # scipy compares the gradient with a constant

        # The derivative is computed at the point of the last residuals.
        @lru_cache(maxsize=1)
        def residuals(point: tuple[float, ...]) -> NDArray:
            return self.residuals(np.array([point]))[0]

        def jacobian(point: NDArray) -> NDArray:
            return self.jacobian(point, sides=1, residual=residuals(tuple(point))) / unit

        found = least_squares(
            lambda point: residuals(tuple(point)) / unit,
            start,
            jacobian,
            bounds=(0.0, 1.0),
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            loss=self.loss,
            f_scale=self.scale / unit,
            max_nfev=getattr(self.method, "evaluations", POLISH),
        )
        found.fun, found.cost = found.fun * unit, found.cost * unit**2
        return found

    def linearised(self, residual: NDArray) -> tuple[float, NDArray, NDArray]:
        """The sum of losses of residuals (n, P, d_y), half its gradient by them, and curvature.

        Samples with larger noise than others, such as those of another output, have less of both.
        The curvature of "cauchy" may be negative, so that it is averaged over each output.

        References
        ----------
        Huber, "Robust Statistics", 1981, section 7.6.

        """
        square = (residual / self.scale) ** 2
        if self.loss == "soft_l1":
            root = np.sqrt(1 + square)
            total, gradient, curvature = 2 * np.sum(root - 1), residual / root, root**-3
        elif self.loss == "cauchy":
            total, gradient = np.sum(np.log1p(square)), residual / (1 + square)
            curvature = self.average_curvature((1 - square) / (1 + square) ** 2)
        else:
            return float(np.sum(residual**2)), residual, np.ones_like(residual)
        return float(self.scale**2 * total), gradient, curvature

    def average_curvature(self, curvature: NDArray) -> NDArray:
        """The mean curvature over the samples of each output, in the place of each (n, P, d_y)."""
        seen = np.broadcast_to(self.misfit.seen, curvature.shape)
        count = np.maximum(seen.sum(axis=(0, 1)), 1)
        mean = np.sum(curvature, axis=(0, 1), where=seen) / count
        return np.broadcast_to(np.maximum(mean, MIN_CURVATURE), curvature.shape)

    def _optimum(self, start: NDArray, found: OptimizeResult) -> tuple[Optimum, NDArray]:
        begin, end = self.theta(np.stack([start, found.x]))
        # scipy's cost is half the sum of losses.
        value = float(np.sqrt(2 * found.cost))
        reason = " ".join(found.message.replace("`", "").split()).rstrip(".")
        return Optimum(tuple(begin.tolist()), tuple(end.tolist()), value, reason), found.x
