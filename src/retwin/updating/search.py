"""The search for the best parameters: least squares from several starts, or evolution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, differential_evolution, least_squares
from scipy.stats.qmc import LatinHypercube

from retwin.errors import InputError
from retwin.trajectories import Progress
from retwin.updating.misfit import Misfit

__all__ = ["EDGE", "Evolution", "LeastSquares", "Optimum", "Search"]

NUDGE = 1e-3
"""Step of the central differences, in widths of the bounds."""
FAILED = 1e3
"""Residual of what could not be simulated, in standard deviations of the output."""
EDGE = 1e-3
"""How near a bound counts as on it, in widths of the bounds."""
POLISH = 60
"""Greatest number of trial steps after a global search."""
ROBUST = ("linear", "soft_l1", "huber", "cauchy")

Loss = Literal["linear", "soft_l1", "huber", "cauchy"]


@dataclass(frozen=True)
class LeastSquares:
    """Trust-region least squares from several starts (scipy's `least_squares`).

    Parameters
    ----------
    starts: the present values, and a Latin hypercube within the bounds.
    loss: "linear" is Eq. 2. The others forgive outliers, such as glitches and missed movements,
        beyond 1.4826 times the median absolute residual of the linear optimum.
    evaluations: greatest number of trial steps per start.

    """

    starts: int = 8
    loss: Loss = "linear"
    evaluations: int = 60

    def __post_init__(self) -> None:
        _check_method(self.loss, starts=self.starts, evaluations=self.evaluations)


@dataclass(frozen=True)
class Evolution:
    """Differential evolution within the bounds (scipy's), polished by least squares.

    Parameters
    ----------
    population: members per parameter.
    generations: at most.
    loss: see `LeastSquares`; for the polish. The search itself minimises the plain norm.

    """

    population: int = 10
    generations: int = 50
    loss: Loss = "linear"

    def __post_init__(self) -> None:
        _check_method(self.loss, population=self.population, generations=self.generations)


def _check_method(loss: str, **counts: int) -> None:
    for name, value in counts.items():
        if not (isinstance(value, int | np.integer) and value >= 1):
            raise InputError(
                name,
                expected="a whole number of at least 1",
                got=repr(value),
                remedy="leave it out",
            )
    if loss not in ROBUST:
        raise InputError(
            "loss", expected=f"one of {', '.join(ROBUST)}", got=repr(loss), remedy="leave it out"
        )


@dataclass(frozen=True)
class Optimum:
    """Where one start ended.

    Attributes
    ----------
    start, values: parameters before and after.
    objective: ‖y_obs − f(θ, u)‖ there (under a robust loss, what that makes of it).
    reason: why it stopped.

    """

    start: tuple[float, ...]
    values: tuple[float, ...]
    objective: float
    reason: str


class Search:
    """Points are parameters in widths of their bounds, from 0 to 1."""

    def __init__(
        self, misfit: Misfit, method: LeastSquares | Evolution, progress: Progress | None
    ) -> None:
        self.misfit = misfit
        self.method = method
        self.progress = progress
        self.width = misfit.high - misfit.low
        self.free = np.ones(len(self.width), dtype=bool)
        self.held = np.zeros(len(self.width))
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
            starts = self._evolved(now, rng)[None]
        robust = self.method.loss != "linear"
        found = []
        for done, start in enumerate(starts, 1):
            found.append(self.descend(start))
            if self.progress is not None:
                self.progress(done / len(starts) * (0.5 if robust else 1.0))
        if robust:
            # One scale for all: optima under different ones could not be compared.
            best = min(found, key=lambda each: each.cost)
            middle = float(np.median(np.abs(best.fun[self.misfit.seen.ravel()])))
            self.loss = self.method.loss
            self.scale = max(1.4826 * middle, 1e-9 * self.misfit.spread)
            for done, each in enumerate(found, 1):
                found[done - 1] = self.descend(each.x)
                if self.progress is not None:
                    self.progress(0.5 + 0.5 * done / len(starts))
        optima = [self._optimum(*each) for each in zip(starts, found, strict=True)]
        return sorted(optima, key=lambda each: each[0].objective)

    def _evolved(self, now: NDArray, rng: np.random.Generator) -> NDArray:
        assert isinstance(self.method, Evolution)
        generations = self.method.generations

        def tell(intermediate_result: OptimizeResult) -> None:
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
            callback=tell,
        )
        return found.x

    def theta(self, points: NDArray) -> NDArray:
        """Parameters (m, k) at points (m, free ones); those that are held are added."""
        whole = np.tile(self.held, (len(points), 1))
        whole[:, self.free] = points
        return self.misfit.low + self.width * whole

    def residuals(self, points: NDArray) -> NDArray:
        """Residuals (m, everything) at points (m, k)."""
        flat = self.misfit.residuals(self.theta(points)).reshape(len(points), -1)
        return np.nan_to_num(flat, nan=FAILED * self.misfit.spread)

    def jacobian(self, point: NDArray) -> NDArray:
        """Derivative (everything, k) at a point (k,): central differences in one batch.

        One-sided at a bound, and beside what cannot be simulated: its residual is no slope.
        """
        step = NUDGE * np.eye(len(point))
        ahead, back = np.clip(point + step, 0, 1), np.clip(point - step, 0, 1)
        whole = self.theta(np.concatenate([ahead, back, point[None]]))
        residuals = self.misfit.residuals(whole).reshape(len(whole), -1)
        broken = np.isnan(residuals).any(axis=1)
        residuals[broken] = residuals[-1]
        ahead[broken[: len(point)]] = back[broken[len(point) : -1]] = point
        difference = residuals[: len(point)] - residuals[len(point) : -1]
        length = np.diag(ahead - back)[:, None]
        return np.divide(difference, length, out=np.zeros_like(difference), where=length > 0).T

    def descend(self, start: NDArray) -> OptimizeResult:
        """The optimum nearest to a start."""
        return least_squares(
            lambda point: self.residuals(point[None])[0],
            start,
            self.jacobian,
            bounds=(0.0, 1.0),
            loss=self.loss,
            f_scale=self.scale,
            max_nfev=getattr(self.method, "evaluations", POLISH),
        )

    def weights(self, residual: NDArray) -> NDArray:
        """What the loss leaves of each residual's square."""
        size = (residual / self.scale) ** 2
        if self.loss == "soft_l1":
            return (1 + size) ** -0.5
        if self.loss == "huber":
            return np.maximum(size, 1) ** -0.5
        return 1 / (1 + size) if self.loss == "cauchy" else np.ones_like(residual)

    def _optimum(self, start: NDArray, found: OptimizeResult) -> tuple[Optimum, NDArray]:
        begin, end = self.theta(np.stack([start, found.x]))
        # scipy's cost is half the sum of squares, or of what a robust loss makes of them.
        value = float(np.sqrt(2 * found.cost))
        reason = " ".join(found.message.replace("`", "").split()).rstrip(".")
        return Optimum(tuple(begin.tolist()), tuple(end.tolist()), value, reason), found.x
