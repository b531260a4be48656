"""The search for the best parameters: least squares from several starts, or evolution."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, differential_evolution, least_squares
from scipy.stats.qmc import LatinHypercube

from retwin.errors import InputError
from retwin.progress import Progress
from retwin.update.identification.misfit import Misfit, check_counts

__all__ = ["EDGE", "Evolution", "LeastSquares", "Loss", "Optimum", "Search"]

NUDGE = 1e-3
"""Step of the differences, in widths of the bounds."""
EXACT = 1e-6
"""Share of the objective, and of the parameters, below which a step changes nothing: far below what
noise does to them."""
FAILED = 1e3
"""Residual of what could not be simulated, in standard deviations of the output."""
EDGE = 1e-3
"""How near a bound counts as on it, in widths of the bounds."""
POLISH = 60
"""Greatest number of trial steps after a global search."""
Loss = Literal["linear", "soft_l1", "cauchy"]


@dataclass(frozen=True)
class LeastSquares:
    """Trust-region least squares from several starts (scipy's `least_squares`).

    Parameters
    ----------
    starts: the present values, and a Latin hypercube within the bounds.
    loss: "linear" is Eq. 2. The others forgive outliers, such as glitches and missed movements,
        beyond 1.4826 times the median absolute residual of the linear optimum: "soft_l1" counts
        them by their size instead of its square, "cauchy" hardly at all.
    evaluations: greatest number of trial steps per start.

    """

    starts: int = 4
    loss: Loss = "soft_l1"
    evaluations: int = 60

    def __post_init__(self) -> None:
        check_counts(starts=self.starts, evaluations=self.evaluations)
        _check_loss(self.loss)


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
    loss: Loss = "soft_l1"

    def __post_init__(self) -> None:
        check_counts(population=self.population, generations=self.generations)
        _check_loss(self.loss)


def _check_loss(loss: str) -> None:
    known = get_args(Loss)
    if loss not in known:
        raise InputError(
            "loss", expected=f"one of {', '.join(known)}", got=repr(loss), remedy="leave it out"
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

    def jacobian(
        self, point: NDArray, *, sides: Literal[1, 2] = 2, there: NDArray | None = None
    ) -> NDArray:
        """Derivative (everything, k) at a point (k,): differences to one or both sides, one batch.

        One-sided at a bound, and beside what cannot be simulated: its residual is no slope. `there`
        are the residuals (everything,) at the point, where they are known.
        """
        step = np.diag(np.where(point > 0.5, -NUDGE, NUDGE))
        inward, outward = np.clip(point + step, 0, 1), np.clip(point - step, 0, 1)
        if there is None:
            there = self.residuals(point[None])[0]
        points = np.concatenate([inward, outward]) if sides == 2 else inward
        residuals = self.misfit.residuals(self.theta(points)).reshape(len(points), -1)
        broken = np.isnan(residuals).any(axis=1)
        points[broken], residuals[broken] = point, there
        size = len(point)
        length = np.diag(points[:size] - (points[size:] if sides == 2 else point))[:, None]
        difference = residuals[:size] - (residuals[size:] if sides == 2 else there)
        return np.divide(difference, length, out=np.zeros_like(difference), where=length != 0).T

    def descend(self, start: NDArray) -> OptimizeResult:
        """The optimum nearest to a start."""

        # A derivative is asked for where the residuals were asked for last.
        @lru_cache(maxsize=1)
        def residuals(point: tuple[float, ...]) -> NDArray:
            return self.residuals(np.array([point]))[0]

        return least_squares(
            lambda point: residuals(tuple(point)),
            start,
            lambda point: self.jacobian(point, sides=1, there=residuals(tuple(point))),
            bounds=(0.0, 1.0),
            ftol=EXACT,
            xtol=EXACT,
            loss=self.loss,
            f_scale=self.scale,
            max_nfev=getattr(self.method, "evaluations", POLISH),
        )

    def judged(self, residual: NDArray) -> tuple[float, NDArray, float]:
        """What the loss makes of all squares together, and how the optimum hangs on residuals.

        To first order it is that of least squares for residuals as the second says; the loss
        rises from there as the squares do, times the third (Huber 1981, section 7.6).
        """
        size = (residual / self.scale) ** 2
        if self.loss == "soft_l1":
            root = np.sqrt(1 + size)
            total, pull, slope = 2 * np.sum(root - 1), residual / root, root**-3
        elif self.loss == "cauchy":
            total, pull = np.sum(np.log1p(size)), residual / (1 + size)
            slope = (1 - size) / (1 + size) ** 2
        else:
            return float(np.sum(residual**2)), residual, 1.0
        mean = max(float(np.mean(slope[self.misfit.seen])), 0.05)
        return float(self.scale**2 * total), pull / mean, mean

    def _optimum(self, start: NDArray, found: OptimizeResult) -> tuple[Optimum, NDArray]:
        begin, end = self.theta(np.stack([start, found.x]))
        # scipy's cost is half the sum of squares, or of what a robust loss makes of them.
        value = float(np.sqrt(2 * found.cost))
        reason = " ".join(found.message.replace("`", "").split()).rstrip(".")
        return Optimum(tuple(begin.tolist()), tuple(end.tolist()), value, reason), found.x
