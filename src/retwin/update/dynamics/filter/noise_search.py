"""The noise with which corrected dynamics predict their record best: a search for the maximum.

A call of the filter over the record is dear, and the likelihood has plateaus and several maxima:
which state is noisy can have several answers. The search climbs from several points by Fisher's
scoring, with the expected information of Gaussian predictions. A simplex around the result then
shows whether the likelihood is smooth: where equations have kinks, it finds more, and the search
descends by simplices from several points, which takes several times as many calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import wilcoxon

from retwin.data.trajectories import Trajectories
from retwin.update.dynamics.filter.filtering import arrays_of
from retwin.update.dynamics.filter.prediction import Prediction, root_of, whitened
from retwin.update.dynamics.twin import DynamicsTwin

__all__ = ["CHANCE", "SMALLEST", "Search", "Visited", "noisy"]

SMALLEST = 1e-6
"""Lowest ratio of a deviation to its usual one (`noisy`), and the reciprocal of the highest."""
IMPOSSIBLE = 1e100
"""Cost where the filter is not finite."""
CHANCE = 0.05
"""Probability of the gain of held-out parts, if it were chance, below which noise in proportion to
the change is taken."""


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Settings of the search for the noise; lengths are those of logarithms of deviations.

    Attributes
    ----------
    lowest : (float, float, float)
        Lowest deviations with which the search begins, over the usual ones (`noisy`): of process
        noise, of measurement noise, and of noise in proportion. The highest ones are 1.
    points : int
        Number of points per dimension among which the search begins.
    climbs : tuple of (int, int)
        Rounds of scoring: the number of points from which it climbs, and of steps at most.
    difference : float
        Step of the differences by which derivatives are computed.
    longest : float
        Longest step of a coordinate.
    tries : int
        Steps of scoring that are tried, each shorter than the one before, until one is better.
    close : float
        Log likelihood that a step is expected to gain, below which a maximum is reached.
    simplex : (int, float)
        The simplex around the maximum: calls per dimension at most, and its size.
    rough : float
        Log likelihood that it gains beyond a maximum from which on the likelihood is not smooth.
    descents : tuple of (int, int, float)
        Rounds of simplices where it is not: the number of points, calls per dimension at most, and
        the size of the first steps.

    """

    lowest: tuple[float, float, float] = (1e-4, 1e-2, 1e-3)
    points: int = 8
    climbs: tuple[tuple[int, int], ...] = ((6, 3), (3, 20))
    difference: float = 1e-3
    longest: float = 2.0
    tries: int = 5
    close: float = 0.01
    simplex: tuple[int, float] = (12, 0.3)
    rough: float = 0.5
    descents: tuple[tuple[int, int, float], ...] = ((8, 15, 1.0), (3, 60, 0.5))


@dataclass(frozen=True, eq=False)
class Visited:
    """Points (V, w) of a search, and log densities (V, K) of each part."""

    points: NDArray
    scores: NDArray

    @property
    def best(self) -> NDArray:
        """The point (w,) with the highest likelihood."""
        return self.points[self.scores.sum(axis=1).argmax()]

    @property
    def held_out(self) -> NDArray:
        """Log densities (K,) of each part at the point that is the best one for the others."""
        others = self.scores.sum(axis=1, keepdims=True) - self.scores
        return np.take_along_axis(self.scores, others.argmax(axis=0)[None], axis=0)[0]

    def decided(self, other: Visited) -> bool:
        """Whether held-out parts are predicted better than by another search, beyond chance.

        The test is that of signed ranks, since one part of a record can gain more than all others.
        """
        gain = self.held_out - other.held_out
        return bool(gain.sum() > 0 and wilcoxon(gain, alternative="greater").pvalue < CHANCE)


@dataclass(frozen=True, eq=False)
class Search:
    """The likelihood of one-step predictions as a function of the noise; see `fit_noise`."""

    twin: DynamicsTwin
    observed: Trajectories
    indices: NDArray
    parts: Sequence[NDArray]
    moves: NDArray
    settings: SearchSettings = SearchSettings()

    def predict(self, logs: NDArray) -> tuple[Prediction, NDArray]:
        """One-step predictions, and log densities (K,) of the parts.

        One pass over the record has the parameters of each part in turn. Only the states at the
        first sample of a part are then those of other parameters.
        """
        made = noisy(self.twin, self.indices, logs)
        found = made.filter(*self._given, changes=self._changes, simulated=self._simulated)
        prediction = Prediction(self.observed, *found)
        density = prediction.log_density()
        sums = np.array([density[part].sum() for part in self.parts])
        return prediction, np.where(np.isfinite(sums), sums, -IMPOSSIBLE)

    @cached_property
    def counted(self) -> NDArray:
        """Samples (n, T) of the parts."""
        return np.any(np.stack(list(self.parts)), axis=0)

    @cached_property
    def _given(self) -> tuple[NDArray, NDArray, NDArray]:
        return arrays_of(self.observed)

    @cached_property
    def _changes(self) -> NDArray:
        """(n, T, q), what is added to the parameters."""
        own = self.moves[:, : len(self.twin.values) - len(self.twin.process)]
        made = np.zeros((*self.parts[0].shape, own.shape[1]))
        for part, move in zip(self.parts, own, strict=True):
            made[part] = move
        return made

    @cached_property
    def _simulated(self) -> NDArray:
        """States (n, T, d_x) without noise, the same for all noise that is tried."""
        commands, twin = self._given[0], self.twin
        theta = twin.filter.start(len(commands), known_start=True)[0]
        return twin.equations.steps().run(commands, theta, changes=self._changes)[1]

    def visit(self, constant: NDArray | None = None) -> Visited:
        """All points of a search for the maximum.

        Without `constant` the process noise is constant; with it, the best such noise, a part is in
        proportion to the change of the state.
        """
        widths = (len(self.indices), len(self.twin.noise), 1)
        number = sum(widths) if constant is not None else sum(widths[:2])
        settings, low = self.settings, np.log(np.repeat(self.settings.lowest, widths))[:number]
        process = np.repeat((True, False, True), widths)[:number]
        path = _Path(self)
        drawn = list(low * np.random.default_rng(0).random((settings.points * number, number)))
        if constant is not None:
            drawn.append(np.append(constant, low[len(constant) :]))
        # All noise in the states, and all in the measurements, are often two maxima.
        ends = [np.where(process, 0.0, low), np.where(process, low, 0.0)]
        tried = ends + sorted(drawn, key=path.cost)
        for count, steps in settings.climbs:
            tried = sorted((path.climb(each, steps) for each in tried[:count]), key=path.cost)
        best = path.descend(tried[0], *settings.simplex)
        if path.cost(tried[0]) - path.cost(best) > settings.rough:
            tried = [best, *tried, *drawn]
            for count, calls, size in settings.descents:
                nearest = sorted(tried, key=path.cost)[:count]
                tried = [path.descend(each, calls, size) for each in nearest]
        path.leave_out(path.visited.best)
        return path.visited


@dataclass(frozen=True, eq=False)
class _Path:
    """Ways to a maximum of a search, and all points on them."""

    search: Search
    scores: dict[bytes, tuple[NDArray, NDArray]] = field(default_factory=dict)
    """By the bytes of a point: the point (w,), and log densities (K,) of the parts."""

    @property
    def visited(self) -> Visited:
        """All points."""
        points, scores = zip(*self.scores.values(), strict=True)
        return Visited(np.array(points), np.array(scores))

    def at(self, logs: NDArray) -> tuple[Prediction, NDArray]:
        """The predictions at a point, and log densities (K,) of the parts."""
        prediction, scores = self.search.predict(logs)
        self.scores[logs.tobytes()] = np.array(logs), scores
        return prediction, scores

    def cost(self, logs: NDArray) -> float:
        """The negative log likelihood; a point is computed once."""
        known = self.scores.get(logs.tobytes())
        return -float((self.at(logs)[1] if known is None else known[1]).sum())

    def descend(self, start: NDArray, calls: int, size: float) -> NDArray:
        """The best point of a simplex of Nelder and Mead, which needs no derivatives."""
        return minimize(
            self.cost,
            start,
            method="Nelder-Mead",
            bounds=[(np.log(SMALLEST), -np.log(SMALLEST))] * len(start),
            options={
                "initial_simplex": start + size * np.eye(len(start) + 1, len(start), -1),
                "maxfev": calls * len(start),
                "xatol": 0.02,
                "fatol": 0.1,
            },
        ).x

    def climb(self, start: NDArray, steps: int) -> NDArray:
        """The point after some steps of scoring, each damped until it is better."""
        point, damping = start, 1e-2
        prediction, scores = self.at(start)
        for _ in range(steps):
            if scores.sum() <= -IMPOSSIBLE / 2:
                break
            gradients, information = self._derivatives(point, prediction, scores)
            gradient = gradients.sum(axis=1)
            edge = -np.log(SMALLEST)
            free = ~(((point <= -edge) & (gradient < 0)) | ((point >= edge) & (gradient > 0)))
            own, slope = information[np.ix_(free, free)], gradient[free]
            if (
                not free.any()
                or slope @ np.linalg.solve(own, slope) / 2 < self.search.settings.close
            ):
                break
            for _ in range(self.search.settings.tries):
                step = np.zeros(len(point))
                step[free] = np.linalg.solve(own + damping * np.diag(np.diag(own)), slope)
                step *= min(1.0, self.search.settings.longest / np.abs(step).max())
                new = np.clip(point + step, -edge, edge)
                found = self.at(new)
                if found[1].sum() > scores.sum():
                    break
                damping *= 8
            else:
                break
            point, (prediction, scores) = new, found
            damping = max(damping / 8, 1e-6)
        return point

    def leave_out(self, point: NDArray) -> None:
        """Visit the maxima (K,) without each part, by a step of scoring from that of all."""
        gradients, information = self._derivatives(point, *self.at(point))
        steps = -np.linalg.solve(information, gradients)
        edge, longest = -np.log(SMALLEST), self.search.settings.longest
        for step in np.clip(steps, -longest, longest).T:
            self.at(np.clip(point + step, -edge, edge))

    def _derivatives(
        self, point: NDArray, prediction: Prediction, scores: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Gradients (w, K) of the log densities of the parts, and expected information (w, w).

        A Gaussian N(m, S) has the information dm' S^-1 dm + tr(S^-1 dS S^-1 dS) / 2 (Kay,
        Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, section 3.9).
        """
        seen, counted = self.search.observed.mask, self.search.counted
        root = root_of(prediction.covariance, seen)
        both = seen[..., :, None] & seen[..., None, :]
        gradient, rows = np.zeros((len(point), len(scores))), []
        size = self.search.settings.difference
        for i in range(len(point)):
            step = np.zeros(len(point))
            step[i] = size if point[i] + size <= -np.log(SMALLEST) else -size
            other, own = self.at(point + step)
            gradient[i] = (own - scores) / step[i]
            mean = whitened(other.mean - prediction.mean, root, seen)
            spread = np.where(both, other.covariance - prediction.covariance, 0.0)
            spread = np.linalg.solve(root, np.linalg.solve(root, spread).swapaxes(-1, -2))
            parts = (mean[counted].ravel(), spread[counted].ravel() / np.sqrt(2))
            rows.append(np.concatenate(parts) / step[i])
        jacobian = np.nan_to_num(np.array(rows))
        information = jacobian @ jacobian.T
        floor = 1e-6 * max(float(np.diag(information).max()), 1.0)  # on a plateau it is 0
        return gradient, information + floor * np.eye(len(point))


def noisy(twin: DynamicsTwin, indices: NDArray, logs: NDArray) -> DynamicsTwin:
    """The twin with noise of which the logarithms of the ratios to the usual ones are given.

    They are those of process noise, of measurement noise, and of process noise over the change of
    the state, one for all states, which may be left out.
    """
    count, step = len(indices), twin.domain.speed
    if not twin.equations.step:
        step = step / twin.rate
    process, proportional = np.zeros((2, len(step)))
    process[indices] = (step[indices] * np.exp(logs[:count])) ** 2
    own, over = np.split(logs[count:], [len(twin.noise)])
    if len(over):
        proportional[indices] = np.exp(2 * over)
    noise = twin.noise * np.exp(2 * own)
    return replace(twin, process=process, proportional=proportional, noise=noise)
