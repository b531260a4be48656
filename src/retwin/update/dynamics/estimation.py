"""The most probable parameters of state equations from outputs, by free simulation.

The residuals are those of a simulation from the commands alone, over whole trajectories. Parameters
are shared by all trajectories; unknown starts of the states are each trajectory's own. A
trust-region method with the Gauss-Newton curvature, from exact forward sensitivities, finds the
optimum of

    sum of (y - simulated)^2 / (2 variance) + sum of (x - mean)^2 / (2 deviation^2)

in nats (Nocedal and Wright, Numerical Optimization, 2006, chapters 4 and 10). The variance is that
of an effective sample, since residuals are autocorrelated. Sensitivities are computed for a few
trajectories at a time, and only sums of their products are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.dynamics.arrow import Arrow, bounded_step, trust_region_step
from retwin.update.dynamics.linearised import Linearised, Point
from retwin.update.dynamics.unknowns import Unknowns

__all__ = ["Estimation", "correlation_time", "estimate_starts", "root"]

MAX_STEPS = 60
"""Steps of the trust-region method at most."""
IDLE = (5, 0.03)
"""Number of successive steps, each of which gains less than so many nats, at which the search ends:
of inner coefficients of terms that hardly matter next to nothing is known."""
WIDEST = 1e6
"""Largest trust region, in posterior deviations at the start of the search."""
RESOLUTION = 1e-12
"""Smallest variance that counts, over that of an output: about that of single precision."""
CHUNK = 2**20
"""Number of derivatives that are computed at once, unless one trajectory has more: 8 MB."""


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
    absorbed : callable, optional
        From the shared coordinates (k,) to further errors (r,) of variance 1 and their derivatives
        (r, k), see `CorrectedEquations.absorbed`.

    """

    twin: StateTwin
    observed: Trajectories
    unknowns: Unknowns
    seen: NDArray
    variance: NDArray
    absorbed: Callable[[NDArray], tuple[NDArray, NDArray]] | None = None

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

    def acting(self, point: Point) -> NDArray:
        """Commands (n, T, d_u) as they act, after their dead times."""
        return self.twin.steps().acting(self.commands, self.theta(point))

    def residual(self, point: Point) -> NDArray:
        """Measured minus simulated outputs (n, T, d_y); 0 where a sample does not count."""
        return np.where(self.seen, self.measured - self.simulated(point)[0], 0.0)

    def derivatives(self, point: Point) -> Iterator[tuple[slice, NDArray, NDArray]]:
        """Some trajectories, their residual (c, T, d_y), and derivatives (c, T, d_y, P) of outputs.

        Both are 0 where a sample does not count.
        """
        theta, steps = self.theta(point), self.twin.steps()
        size = max(1, CHUNK // (self.seen[0].size * theta.shape[1]))
        for first in range(0, len(theta), size):
            rows = slice(first, first + size)
            outputs, slope = steps.sensitivities(self.commands[rows], theta[rows])
            seen = self.seen[rows]
            if not seen.all():
                slope[~seen] = 0.0
            yield rows, np.where(seen, self.measured[rows] - outputs, 0.0), slope

    def linearised(self, point: Point) -> Linearised:
        """The simulation at a point, with sums of products of derivatives."""
        starts = len(self.unknowns.offset) + self.unknowns.free
        width = len(self.unknowns.offset) + len(self.unknowns.start)
        residual = np.full(self.seen.shape, np.nan)
        products = np.zeros((len(self.variance), width, width + 1))
        own = np.zeros((len(self.variance), len(self.observed), len(starts), width + 1))
        for rows, error, slope in self.derivatives(point):
            residual[rows] = error
            with np.errstate(over="ignore", invalid="ignore"):
                for i in range(len(products)):
                    by_all = np.ascontiguousarray(slope[:, :, i])
                    flat, by_start = by_all.reshape(-1, width), by_all[..., starts].swapaxes(1, 2)
                    products[i, :, :-1] += flat.T @ flat
                    products[i, :, -1] += flat.T @ error[..., i].ravel()
                    own[i, rows, :, :-1] = by_start @ by_all
                    own[i, rows, :, -1:] = by_start @ error[..., i, None]
            if not np.isfinite(products).all():
                break
        return Linearised(point, residual, products, own)

    @cached_property
    def spread(self) -> NDArray:
        """Variances (d_y,) of the outputs; the mean square of one that does not vary, or 1."""
        values = np.where(self.seen, self.measured, np.nan)
        square = np.nanmean(values**2, axis=(0, 1))
        variance = np.nanvar(values, axis=(0, 1))
        constant = np.where(square > 0, square, 1.0)
        return np.where(variance > RESOLUTION * square, variance, constant)

    def power(self, residual: NDArray, seen: NDArray | None = None) -> NDArray:
        """Mean squares (d_y,), above 0, of a residual (n, T, d_y) that is 0 where not `seen`."""
        count = np.maximum((self.seen if seen is None else seen).sum(axis=(0, 1)), 1)
        return np.maximum(np.sum(residual**2, axis=(0, 1)) / count, RESOLUTION * self.spread)

    def rms(self, residual: NDArray, part: NDArray | None = None) -> float:
        """Root mean square of a residual, relative where the outputs have several units.

        It is that of a part (n, T) of the samples, if given, relative to all of them alike.
        """
        seen = self.seen if part is None else self.seen & part[..., None]
        power = self.power(np.where(seen, residual, 0.0), seen)
        if len(set(self.observed.outputs.units)) > 1:
            power = power / self.spread
        return float(np.sqrt(np.average(power, weights=seen.sum(axis=(0, 1)))))

    def minimised(self, at: Linearised, steps: int = MAX_STEPS) -> Linearised:
        """The most probable point, from a start at which the simulation is finite.

        The search ends after so many steps at most, none of which leaves the bounds.
        """
        flat = at.point.flat
        if not flat.size:
            return at
        value, gradient, curvature = self._expand(at)
        unit = curvature.unit
        radius, idle = WIDEST / 1e3, 0
        for _ in range(steps):
            # Norm of the gradient, in nats per prior or posterior deviation, at which the search
            # ends.
            if np.linalg.norm(unit * gradient) < 1e-2 or idle == IDLE[0]:
                break
            scaled = curvature.scaled(unit)
            ends = ((each - flat) / unit for each in self.bounds)
            step = bounded_step(scaled, unit * gradient, radius, *ends)
            expected = -float(step @ (unit * gradient + scaled.times(step) / 2))
            length = float(np.linalg.norm(step))
            if not expected > 0:  # or NaN
                break
            inside = np.clip(flat + unit * step, *self.bounds)
            tried = self.linearised(self.point(inside))
            found = self._expand(tried)
            ratio = (value - found[0]) / expected
            if ratio < 0.25:
                radius = length / 4
            elif ratio > 0.75:
                radius = max(radius, min(2 * length, WIDEST))
            # Ratio of the decrease of the objective to that of its quadratic approximation, from
            # which a step is made.
            if ratio > 0.15:
                idle = idle + 1 if value - found[0] < IDLE[1] else 0
                at, flat, (value, gradient, curvature) = tried, inside, found
                # What did not act at the start may act now, and its unit was without meaning.
                unit = np.where(unit > WIDEST * curvature.unit, curvature.unit, unit)
        return at

    def rest(self, at: Linearised) -> float:
        """The objective in nats that a Gauss-Newton step from a point would leave."""
        return self._expand(at)[0] - self.gain(at) if at.finite else np.inf

    def gain(self, at: Linearised) -> float:
        """The decrease of the objective, in nats, by a Gauss-Newton step from a point."""
        if not at.finite:
            return -np.inf
        _, gradient, curvature = self._expand(at)
        unit = curvature.unit
        scaled = curvature.scaled(unit)
        step = trust_region_step(scaled, unit * gradient, WIDEST)
        return -float(step @ (unit * gradient + scaled.times(step) / 2))

    def _expand(self, at: Linearised) -> tuple[float, NDArray, Arrow]:
        """The objective at a point, its gradient (k + n m,) and Gauss-Newton curvature.

        A coordinate at its bound is held where the objective would take it further. Where the
        simulation is not finite, the objective is infinite.
        """
        flat = at.point.flat
        mean, precision = self._prior
        prior = precision * (flat - mean)
        if not at.finite:
            with np.errstate(over="ignore", invalid="ignore"):
                return np.inf, prior, self._curvature(at)
        squares = np.sum(at.residual**2, axis=(0, 1))
        value = 0.5 * float((1 / self.variance) @ squares + prior @ (flat - mean))
        if self.absorbed is not None:
            value += 0.5 * float(np.sum(self.absorbed(at.point.shared)[0] ** 2))
        gradient = self._gradient(at)
        held = self._pressed(flat, gradient)
        gradient[held] = 0.0
        return value, gradient, self._curvature(at).scaled(1.0 - held).plus(1.0 * held)

    def _gradient(self, at: Linearised) -> NDArray:
        """The gradient (k + n m,) of the objective."""
        flat, (mean, precision) = at.point.flat, self._prior
        unknowns, weight = self.unknowns, 1 / self.variance
        shared = unknowns.matrix.T @ (weight @ at.products[:, : len(unknowns.offset), -1])
        own = np.tensordot(weight, at.own[..., -1], 1)
        made: NDArray = precision * (flat - mean) - np.concatenate([shared, own.ravel()])
        if self.absorbed is not None:
            error, slope = self.absorbed(at.point.shared)
            made[: unknowns.count] += slope.T @ error
        return made

    def _pressed(self, flat: NDArray, gradient: NDArray) -> NDArray:
        """Which coordinates (k + n m,) are at a bound beyond which the objective falls."""
        low, high = self.bounds
        return ((flat <= low) & (gradient > 0)) | ((flat >= high) & (gradient < 0))

    def _curvature(self, at: Linearised) -> Arrow:
        """The Gauss-Newton curvature of the objective."""
        unknowns, weight = self.unknowns, 1 / self.variance
        parameters = len(unknowns.offset)
        products, own = (np.tensordot(weight, each[..., :-1], 1) for each in (at.products, at.own))
        shared = unknowns.matrix.T @ products[:parameters, :parameters] @ unknowns.matrix
        if self.absorbed is not None:
            slope = self.absorbed(at.point.shared)[1]
            shared = shared + slope.T @ slope
        arrow = Arrow(
            shared, own[..., :parameters] @ unknowns.matrix, own[..., parameters + unknowns.free]
        )
        return arrow.plus(self._prior[1])

    def bounded_curvature(self, at: Linearised) -> Arrow:
        """The curvature of a Gaussian approximation to the posterior within its bounds.

        At a bound that is pressed by the gradient g > 0, with a curvature h, the density of the
        distance t is proportional to exp(-g t - h t^2 / 2). A precision h + g^2 / 2 gives its
        second moment about the bound for g = 0 and for large g, and at most 1.4 times it between.
        """
        gradient = self._gradient(at)
        return self._curvature(at).plus(
            np.where(self._pressed(at.point.flat, gradient), gradient**2 / 2, 0.0)
        )

    def covariance(self, at: Linearised) -> NDArray:
        """Posterior covariance (k + m, k + m) of coordinates and mean starts, by Laplace."""
        curvature = self.bounded_curvature(at)
        unit = curvature.unit
        complement, follow, inverse = curvature.scaled(unit).reduced()
        k = len(complement)
        own = unit[k:].reshape(follow.shape[:2])[..., None]
        by_shared = np.concatenate([np.diag(unit[:k]), -np.sum(own * follow, axis=0) / len(own)])
        limit = RESOLUTION * max(k, 1)
        shared = np.linalg.pinv(complement, limit, hermitian=True)
        made: NDArray = by_shared @ shared @ by_shared.T
        made[k:, k:] += np.sum(own * inverse * own.swapaxes(1, 2), axis=0) / len(own) ** 2
        return made

    def undetermined(self, at: Linearised) -> NDArray:
        """Which shared coordinates (k,) can change without a change of the objective."""
        curvature = self._curvature(at)
        values, directions = np.linalg.eigh(curvature.scaled(curvature.unit).reduced()[0])
        free = np.abs(directions[:, values <= RESOLUTION * len(values)])
        return (free > np.sqrt(RESOLUTION)).any(axis=1)

    def confounded(self, at: Linearised) -> NDArray:
        """Combinations (r, k) of shared coordinates, each of which acts, that act together on none.

        Such are the scale of a hidden state, or the ratio of two factors. They have norm 1 in the
        units in which each coordinate's own curvature is 1.
        """
        curvature = self._curvature(at)
        unit = curvature.unit[: self.unknowns.count]
        complement = curvature.scaled(curvature.unit).reduced()[0]
        acts = np.flatnonzero(np.diag(curvature.shared) > 0)
        values, directions = np.linalg.eigh(complement[np.ix_(acts, acts)])
        count = int(np.sum(values <= RESOLUTION * len(complement)))
        made = np.zeros((count, len(unit)))
        made[:, acts] = directions[:, :count].T
        made[np.abs(made) <= np.sqrt(RESOLUTION)] = 0.0
        return made / unit

    @cached_property
    def bounds(self) -> tuple[NDArray, NDArray]:
        """Lowest and highest values (k + n m,) of a flat point."""
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
    return directions * np.sqrt(np.maximum(values, 0.0))


def correlation_time(residual: NDArray, *, correlation_times: int = 5) -> float:
    """Samples per effective one: the integrated autocorrelation time of residuals (n, T, d_y).

    Unlike that of a first-order autoregression, it holds for residuals that oscillate. The sum over
    lags ends at five times its own value (Sokal, "Monte Carlo methods in statistical
    mechanics", in Functional Integration, 1997).

    Parameters
    ----------
    correlation_times : int, default 5
        Lags over which the autocorrelation is summed, in correlation times.

    """
    samples = residual.shape[1]
    scale = np.sqrt(np.mean(residual**2, axis=(0, 1)))
    scaled = residual / np.where(scale > 0, scale, 1.0)
    spectrum = np.abs(np.fft.rfft(scaled, 2 * samples, axis=1)) ** 2
    covariance = np.fft.irfft(spectrum, axis=1)[:, :samples].sum(axis=(0, 2))
    if covariance[0] <= 0:
        return 1.0
    times = 2 * np.cumsum(covariance / covariance[0]) - 1
    window = np.arange(samples) >= correlation_times * times
    return float(max(1.0, times[np.argmax(window)] if window.any() else times[-1]))


def estimate_starts(
    twin: StateTwin, record: Trajectories, unknowns: Unknowns, variance: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """The most probable starts (m,) of one record, and a root (m, m) of their covariance.

    Parameters
    ----------
    twin : StateTwin
        The equations.
    record : Trajectories
        One trajectory, by whose measured samples the starts are estimated.
    unknowns : Unknowns
        Starts alone, without shared coordinates.
    variance : NDArray, optional
        (d_y,), of the errors of samples, which count as independent; by default their mean square.

    Raises
    ------
    InputError
        Not one trajectory, nothing measured, no unknown start, or a simulation that diverges.

    """
    fits = len(record) == 1 and record.mask.any() and len(unknowns.free) > 0
    expected = "one trajectory with measured samples, for a twin with unknown starts"
    got = f"{len(record)} with {int(record.mask.sum())} samples, {len(unknowns.free)} starts"
    remedy = "give the first samples of one record; bounds make a start unknown"
    require(fits, "record", expected=expected, got=got, remedy=remedy)
    given = np.ones(len(record.outputs)) if variance is None else variance
    own = Estimation(twin, record, unknowns, record.mask, given)
    found = own.linearised(Point(np.zeros(0), unknowns.start[None, unknowns.free]))
    finite = bool(np.isfinite(found.products).all())
    expected = "commands with which the simulation of the equations stays finite"
    got = f"{record.ids[0]}, with which it diverges"
    remedy = "it leaves what the equations were corrected for: fit them to records like this "
    remedy += "one, or take the twin with identified parameters alone"
    require(finite, "record", expected=expected, got=got, remedy=remedy)
    # Estimates of the starts of a record, of which each takes the errors of the one before.
    for i in range(1 if variance is not None else 3):
        if variance is None:
            own = replace(own, variance=own.power(found.residual) if i else own.spread)
        found = own.minimised(found)
    return found.point.starts[0], root(own.covariance(found))
