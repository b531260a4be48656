"""The most probable parameters of state equations from outputs, by free simulation.

The residuals are those of a simulation from the commands alone, over whole trajectories. Parameters
are shared by all trajectories; unknown starts of the states are each trajectory's own. A
trust-region method with the Gauss-Newton curvature, from exact forward sensitivities, finds the
optimum of

    sum of (y - simulated)^2 / (2 variance) + sum of (x - mean)^2 / (2 deviation^2)

in nats (Nocedal and Wright, Numerical Optimization, 2006, chapters 4 and 10). The variance is that
of an effective sample, since residuals are autocorrelated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import minimize

from retwin.data.trajectories import Trajectories
from retwin.twins.state_twin import StateTwin
from retwin.update.dynamics.unknowns import Unknowns

__all__ = ["Estimation", "HeldOut", "Point", "correlation_time", "root"]

MAX_STEPS = 60
"""Steps of the trust-region method at most."""
TOLERANCE = 1e-2
"""Norm of the gradient, in nats per prior or posterior deviation, at which the search ends."""
WIDEST = 1e6
"""Largest trust region, in posterior deviations at the start of the search."""
RESOLUTION = 1e-12
"""Smallest variance that counts, over that of an output: about that of single precision."""
WINDOW = 5
"""Lags over which the autocorrelation is summed, in correlation times."""


@dataclass(frozen=True, eq=False)
class Point:
    """Values of the unknowns.

    Attributes
    ----------
    shared : NDArray
        (k,).
    starts : NDArray
        (n, m).

    """

    shared: NDArray
    starts: NDArray

    @property
    def flat(self) -> NDArray:
        """(k + n m,)."""
        return np.concatenate([self.shared, self.starts.ravel()])


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Estimates without each of K parts of the samples.

    Attributes
    ----------
    errors, variances : NDArray
        (n, T, d_y), the errors of each sample without the part to which it belongs, and their
        variances by the uncertainty of the unknowns.
    moves : NDArray
        (K, k), by how much the shared coordinates differ without each part.

    """

    errors: NDArray
    variances: NDArray
    moves: NDArray

    @property
    def variance(self) -> NDArray:
        """Variances (k,) of the shared coordinates by the jackknife over the parts.

        They hold for errors that are correlated in any way within a part.
        """
        count = len(self.moves)
        made: NDArray = (count - 1) * np.var(self.moves, axis=0)
        return made


@dataclass(frozen=True, eq=False)
class Estimation:
    """The unknowns of a twin, and the outputs from which they are estimated.

    Attributes
    ----------
    twin : StateTwin
        The equations.
    observed : Trajectories
        The n measured trajectories.
    unknowns : Unknowns
        What is estimated.
    seen : NDArray
        (n, T, d_y) bool, the samples that count.
    variance : NDArray
        (d_y,), of the error of an effective sample.

    """

    twin: StateTwin
    observed: Trajectories
    unknowns: Unknowns
    seen: NDArray
    variance: NDArray

    @cached_property
    def commands(self) -> NDArray:
        """(n, T, d_u) in double precision."""
        return self.observed.commands.astype(np.float64)

    @cached_property
    def measured(self) -> NDArray:
        """(n, T, d_y) in double precision."""
        return self.observed.observed.astype(np.float64)

    def point(self, flat: NDArray) -> Point:
        """The point of a flat vector."""
        k = self.unknowns.count
        return Point(flat[:k], flat[k:].reshape(len(self.observed), -1))

    def theta(self, point: Point) -> NDArray:
        """The parameters and starts (n, q + d_x) that the twin's simulation takes."""
        unknowns, count = self.unknowns, len(self.observed)
        starts = np.tile(unknowns.start, (count, 1))
        starts[:, unknowns.free] = point.starts
        parameters = unknowns.offset + unknowns.matrix @ point.shared
        return np.concatenate([np.tile(parameters, (count, 1)), starts], axis=1)

    def simulated(self, point: Point) -> tuple[NDArray, NDArray]:
        """Outputs (n, T, d_y) and states (n, T, d_x)."""
        return self.twin.steps().run(self.commands, self.theta(point))

    def residual(self, point: Point) -> NDArray:
        """Measured minus simulated outputs (n, T, d_y); 0 where a sample does not count."""
        return np.where(self.seen, self.measured - self.simulated(point)[0], 0.0)

    def linearised(self, point: Point) -> tuple[NDArray, NDArray]:
        """The residual, and its derivatives (n, T, d_y, k + m) by coordinates and own starts."""
        outputs, by_all = self.twin.steps().sensitivities(self.commands, self.theta(point))
        unknowns, parameters = self.unknowns, len(self.unknowns.offset)
        by_shared = by_all[..., :parameters] @ unknowns.matrix
        by_start = by_all[..., parameters + unknowns.free]
        slope = -np.concatenate([by_shared, by_start], axis=-1)
        seen = self.seen[..., None]
        return np.where(self.seen, self.measured - outputs, 0.0), np.where(seen, slope, 0.0)

    @cached_property
    def spread(self) -> NDArray:
        """Variances (d_y,) of the outputs; the mean square of one that does not vary, or 1."""
        values = np.where(self.seen, self.measured, np.nan)
        square = np.nanmean(values**2, axis=(0, 1))
        variance = np.nanvar(values, axis=(0, 1))
        constant = np.where(square > 0, square, 1.0)
        made: NDArray = np.where(variance > RESOLUTION * square, variance, constant)
        return made

    def power(self, residual: NDArray) -> NDArray:
        """Mean squares (d_y,) of a residual (n, T, d_y), above 0."""
        count = np.maximum(self.seen.sum(axis=(0, 1)), 1)
        made: NDArray = np.maximum(
            np.sum(residual**2, axis=(0, 1)) / count, RESOLUTION * self.spread
        )
        return made

    def rms(self, residual: NDArray) -> float:
        """Root mean square of a residual, relative where the outputs have several units."""
        power = self.power(residual)
        if len(set(self.observed.outputs.units)) > 1:
            power = power / self.spread
        return float(np.sqrt(np.average(power, weights=self.seen.sum(axis=(0, 1)))))

    def expanded(self, flat: NDArray) -> tuple[float, NDArray, NDArray]:
        """The objective at a flat point, its gradient (P,) and Gauss-Newton curvature (P, P).

        Where the simulation is not finite, the objective is infinite, and the others are 0 and the
        identity.
        """
        inside = np.clip(flat, *self._bounds)
        residual, slope = self.linearised(self.point(inside))
        k, m, size = self.unknowns.count, len(self.unknowns.free), len(flat)
        if not (np.isfinite(residual).all() and np.isfinite(slope).all()):
            return np.inf, np.zeros(size), np.eye(size)
        mean, precision = self._prior
        value = 0.5 * float(np.sum(residual**2 / self.variance))
        value += 0.5 * float(np.sum(precision * (flat - mean) ** 2))
        gradient, curvature = precision * (flat - mean), np.diag(precision)
        scale = 1 / np.sqrt(self.variance)
        for i, (error, by_own) in enumerate(zip(residual, slope, strict=True)):
            own = np.r_[0:k, k + i * m : k + (i + 1) * m]
            jacobian = (by_own * scale[:, None]).reshape(error.size, k + m)
            curvature[np.ix_(own, own)] += jacobian.T @ jacobian
            gradient[own] += jacobian.T @ (error * scale).ravel()
        # A coordinate at its bound is held where the objective would take it further.
        held = (inside != flat) & (gradient * (flat - inside) < 0)
        gradient[held] = 0.0
        curvature[held] = curvature[:, held] = 0.0
        curvature[held, held] = 1.0
        return value, gradient, curvature

    def minimised(self, point: Point) -> Point:
        """The most probable point, from a start at which the simulation is finite."""
        start = point.flat
        if not start.size:
            return point
        unit = self._scaled_curvature(point)[1]

        @lru_cache(maxsize=2)
        def expanded(z: bytes) -> tuple[float, NDArray, NDArray]:
            value, gradient, curvature = self.expanded(start + unit * np.frombuffer(z))
            return value, unit * gradient, unit[:, None] * curvature * unit

        found = minimize(
            lambda z: expanded(z.tobytes())[0],
            np.zeros(len(start)),
            method="trust-exact",
            jac=lambda z: expanded(z.tobytes())[1],
            hess=lambda z: expanded(z.tobytes())[2],
            options={
                "initial_trust_radius": WIDEST / 1e3,
                "max_trust_radius": WIDEST,
                "gtol": TOLERANCE,
                "maxiter": MAX_STEPS,
            },
        )
        return self.point(np.clip(start + unit * found.x, *self._bounds))

    def covariance(self, point: Point) -> NDArray:
        """Posterior covariance (k + m, k + m) of coordinates and mean starts, by Laplace."""
        curvature, unit = self._scaled_curvature(point)
        scaled = np.linalg.pinv(curvature, hermitian=True)
        count, k, m = len(self.observed), self.unknowns.count, len(self.unknowns.free)
        mean = block_diag(np.eye(k), np.tile(np.eye(m), count) / count)
        made: NDArray = mean @ (unit[:, None] * scaled * unit) @ mean.T
        return made

    def undetermined(self, point: Point) -> NDArray:
        """Which shared coordinates (k,) can change without a change of the objective."""
        values, directions = np.linalg.eigh(self._scaled_curvature(point)[0])
        free = np.abs(directions[:, values <= RESOLUTION * len(values)])
        made: NDArray = (free > np.sqrt(RESOLUTION)).any(axis=1)[: self.unknowns.count]
        return made

    def held_out(self, point: Point, folds: Sequence[NDArray]) -> HeldOut:
        """The errors of each fold, and the estimates, without that fold.

        One Gauss-Newton step from the optimum of all samples leads to that without a fold. The
        starts stay: without the first samples of a trajectory hardly anything determines them.

        Parameters
        ----------
        point : Point
            The optimum.
        folds : sequence of NDArray
            Parts (n, T) of the samples.

        """
        residual, slope = self.linearised(point)
        k = self.unknowns.count
        curvature, unit = (each[..., :k] for each in self._scaled_curvature(point))
        scaled = curvature[:k]
        scale = 1 / np.sqrt(self.variance)
        errors, variances = residual.copy(), np.zeros(residual.shape)
        moves = []
        for fold in folds:
            jacobian = slope[fold][..., :k] * unit
            weighted = (jacobian * scale[:, None]).reshape(residual[fold].size, k)
            covariance = np.linalg.pinv(scaled - weighted.T @ weighted, hermitian=True)
            step = covariance @ (weighted.T @ (residual[fold] * scale).ravel())
            errors[fold] += jacobian @ step
            moves.append(unit * step)
            variances[fold] = np.sum((jacobian @ covariance) * jacobian, axis=-1)
        return HeldOut(np.where(self.seen, errors, 0.0), variances, np.array(moves))

    def _scaled_curvature(self, point: Point) -> tuple[NDArray, NDArray]:
        """The curvature (P, P) in units (P,) in which its diagonal is 1, and these units."""
        curvature = self.expanded(point.flat)[2]
        unit = 1 / np.sqrt(np.maximum(np.diag(curvature), 1e-300))
        return unit[:, None] * curvature * unit, unit

    @cached_property
    def _bounds(self) -> tuple[NDArray, NDArray]:
        k, count = self.unknowns.count, len(self.observed)
        low, high = (
            np.concatenate([each[:k], np.tile(each[k:], count)])
            for each in (self.unknowns.low, self.unknowns.high)
        )
        return low, high

    @cached_property
    def _prior(self) -> tuple[NDArray, NDArray]:
        """Mean and precision of the prior of a flat point."""
        unknowns, count = self.unknowns, len(self.observed)
        mean = np.concatenate([unknowns.mean, np.tile(unknowns.start[unknowns.free], count)])
        own = np.tile(unknowns.start_deviation, count)
        return mean, 1 / np.concatenate([unknowns.deviation, own]) ** 2


def root(covariance: NDArray) -> NDArray:
    """A matrix whose product with its transpose is a covariance."""
    values, directions = np.linalg.eigh(covariance)
    made: NDArray = directions * np.sqrt(np.maximum(values, 0.0))
    return made


def correlation_time(residual: NDArray) -> float:
    """Samples per effective one: the integrated autocorrelation time of residuals (n, T, d_y).

    Unlike that of a first-order autoregression, it holds for residuals that oscillate. The sum over
    lags ends at five times its own value (Sokal, "Monte Carlo methods in statistical
    mechanics", in Functional Integration, 1997).
    """
    samples = residual.shape[1]
    scale = np.sqrt(np.mean(residual**2, axis=(0, 1)))
    scaled = residual / np.where(scale > 0, scale, 1.0)
    spectrum = np.abs(np.fft.rfft(scaled, 2 * samples, axis=1)) ** 2
    covariance = np.fft.irfft(spectrum, axis=1)[:, :samples].sum(axis=(0, 2))
    if covariance[0] <= 0:
        return 1.0
    times = 2 * np.cumsum(covariance / covariance[0]) - 1
    window = np.arange(samples) >= WINDOW * times
    return float(max(1.0, times[np.argmax(window)] if window.any() else times[-1]))
