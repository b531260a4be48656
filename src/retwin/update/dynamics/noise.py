"""How wide the distributions of corrected dynamics are, one step ahead and in free simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ndtri
from scipy.stats import wilcoxon

from retwin.data.trajectories import Trajectories
from retwin.update.dynamics.estimation import Estimation, correlation_time
from retwin.update.dynamics.linearised import HeldOut
from retwin.update.dynamics.prediction import Prediction
from retwin.update.dynamics.twin import DynamicsTwin

__all__ = ["edges", "fit_noise", "folds", "widening"]

LOWEST = (1e-4, 1e-2, 1e-3)
"""Lowest deviations with which the search begins: of process noise over the usual step of a sample,
of measurement noise over the error of free simulation, of process noise over the present change.
The highest ones are 1."""
SMALLEST = 1e-6
"""Lowest of these ratios, and the reciprocal of the highest."""
DRAWN = 16
"""Number of points per dimension among which the search begins."""
DESCENTS = ((8, 15, 1.0), (3, 60, 0.5))
"""Rounds of the search: the number of points from which it descends, calls of the filter per
dimension at most, and the size of the first steps. The likelihood has plateaus and several maxima:
which state is noisy can have several answers."""
IMPOSSIBLE = 1e100
"""Cost where the filter is not finite."""
CHANCE = 0.05
"""Probability of the gain of held-out parts, if it were chance, below which noise in proportion to
the change is taken."""
LEVEL = 0.9
"""Probability of the intervals that are calibrated."""
ENOUGH = 10_000
"""Number of samples from which the likelihood is computed, unless one trajectory has more. They
determine a variance to 1.4 %, and bands are scaled to all samples."""


def fit_noise(
    twin: DynamicsTwin,
    observed: Trajectories,
    corrected: Sequence[int],
    parts: Sequence[NDArray],
    moves: NDArray,
) -> DynamicsTwin:
    """The twin with the variances of w and v that maximise the likelihood of one-step predictions.

    Process noise acts on the corrected states, whose equations may be wrong. Each part of the
    record is predicted with the parameters that are estimated without it: with those that are
    fitted to it, it would seem to have less noise than other records. Noise in proportion to the
    change of a state is taken if nearly all parts are predicted better with it, where the noise is
    that of the other parts.

    Parameters
    ----------
    twin : DynamicsTwin
        The twin; its process noise is ignored.
    observed : Trajectories
        The n trajectories.
    corrected : sequence of int
        Indices of the corrected states.
    parts : sequence of NDArray
        K parts (n, T) of the samples, which do not overlap.
    moves : NDArray
        (K, q + d_x), by how much the values of the twin differ without each part; starts do not.

    """
    indices = np.array(corrected, dtype=int)
    number = max(1, min(len(observed), ENOUGH // observed.steps))
    some = np.linspace(0, len(observed) - 1, number).round().astype(int)
    if not observed[some].mask.any(axis=(0, 1)).all():  # an output that few trajectories have
        some = np.arange(len(observed))
    # A linear step to the parameters without a part may lead where the equations diverge.
    usual = _noisy(twin, indices, np.zeros(len(indices) + len(twin.noise)))
    finite = [
        np.isfinite(_predicted(usual, observed, [part], move[None]).mean[part]).all()
        for part, move in zip(parts, moves, strict=True)
    ]
    kept = np.where(np.array(finite)[:, None], moves, 0.0)
    search = _Search(twin, observed[some], indices, [part[some] for part in parts], kept)

    def scaled(logs: NDArray) -> DynamicsTwin:
        # A common scale changes no prediction, but all intervals.
        made = _noisy(twin, indices, logs)
        error = np.abs(_predicted(made, observed, parts, kept).standardised())
        scale = (np.nanquantile(error, LEVEL) / ndtri((1 + LEVEL) / 2)) ** 2
        return replace(
            made,
            process=scale * made.process,
            proportional=scale * made.proportional,
            free_process=scale * made.process,
            noise=np.maximum(scale * made.noise, SMALLEST**2 * twin.noise),
        )

    found = search.visited()
    made = scaled(found.best)
    if 0.5 ** len(parts) < CHANCE:  # fewer parts cannot show it
        more = search.visited(found.best)
        if more.decided(found):
            return replace(scaled(more.best), free_process=made.free_process)
    return made


@dataclass(frozen=True, eq=False)
class _Visited:
    """Points (V, w) of a search, and log densities (V, K) of each part."""

    points: NDArray
    scores: NDArray

    @property
    def best(self) -> NDArray:
        """The point (w,) with the highest likelihood."""
        made: NDArray = self.points[self.scores.sum(axis=1).argmax()]
        return made

    @property
    def held_out(self) -> NDArray:
        """Log densities (K,) of each part at the point that is the best one for the others."""
        others = self.scores.sum(axis=1, keepdims=True) - self.scores
        return np.take_along_axis(self.scores, others.argmax(axis=0)[None], axis=0)[0]

    def decided(self, other: _Visited) -> bool:
        """Whether held-out parts are predicted better than by another search, beyond chance.

        The test is that of signed ranks, since one part of a record can gain more than all others.
        """
        gain = self.held_out - other.held_out
        return bool(gain.sum() > 0 and wilcoxon(gain, alternative="greater").pvalue < CHANCE)


@dataclass(frozen=True, eq=False)
class _Search:
    """The likelihood of one-step predictions as a function of the noise; see `fit_noise`."""

    twin: DynamicsTwin
    observed: Trajectories
    indices: NDArray
    parts: Sequence[NDArray]
    moves: NDArray

    def scores(self, logs: NDArray) -> NDArray:
        """Log densities (K,) of the parts.

        One pass over the record has the parameters of each part in turn. Only the states at the
        first sample of a part are then those of other parameters.
        """
        made = _noisy(self.twin, self.indices, logs)
        commands, measured, seen = self._given
        found = made.filter(
            commands, measured, seen, changes=self._changes, simulated=self._simulated
        )
        density = Prediction(self.observed, *found).log_density()
        sums = np.array([density[part].sum() for part in self.parts])
        return np.where(np.isfinite(sums), sums, -IMPOSSIBLE)

    @cached_property
    def _given(self) -> tuple[NDArray, NDArray, NDArray]:
        seen = self.observed.mask
        return (
            self.observed.commands.astype(np.float64),
            np.where(seen, self.observed.observed, 0.0),
            seen,
        )

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
        theta = twin.start(len(commands), known_start=True)[0]
        return twin.equations.steps().run(commands, theta, changes=self._changes)[1]

    def visited(self, constant: NDArray | None = None) -> _Visited:
        """All points of a search for the maximum.

        Without `constant` the process noise is constant; with it, the best such noise, a part is in
        proportion to the change of the state.
        """
        widths = (len(self.indices), len(self.twin.noise), 1)
        low = np.log(np.repeat(LOWEST, widths))[: None if constant is not None else sum(widths[:2])]
        points, scores = [], []

        def cost(logs: NDArray) -> float:
            points.append(np.array(logs))
            scores.append(self.scores(logs))
            return -float(scores[-1].sum())

        def descended(start: NDArray, calls: int, size: float) -> NDArray:
            simplex = start + size * np.vstack([np.zeros(len(low)), np.eye(len(low))])
            found: NDArray = minimize(
                cost,
                start,
                method="Nelder-Mead",
                bounds=[(np.log(SMALLEST), -np.log(SMALLEST))] * len(low),
                options={
                    "initial_simplex": simplex,
                    "maxfev": calls * len(low),
                    "xatol": 0.02,
                    "fatol": 0.1,
                },
            ).x
            return found

        tried = list(low * np.random.default_rng(0).random((DRAWN * len(low), len(low))))
        if constant is not None:
            tried.append(np.append(constant, low[len(constant) :]))
        for count, calls, size in DESCENTS:
            best = sorted(tried, key=cost)[:count]
            tried = [descended(each, calls, size) for each in best]
        return _Visited(np.array(points), np.array(scores))


def _noisy(twin: DynamicsTwin, indices: NDArray, logs: NDArray) -> DynamicsTwin:
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


def _predicted(
    twin: DynamicsTwin, observed: Trajectories, parts: Sequence[NDArray], moves: NDArray
) -> Prediction:
    """One-step predictions of each part with the parameters that are estimated without it."""
    commands = observed.commands.astype(np.float64)
    measured = np.where(observed.mask, observed.observed, 0.0)
    mean, covariance = (np.zeros((*measured.shape, *more)) for more in ((), measured.shape[2:]))
    for part, move in zip(parts, moves, strict=True):
        found = twin.filter(commands, measured, observed.mask, moves=move)
        mean[part], covariance[part] = found[0][part], found[1][part]
    return Prediction(observed, mean, covariance, found[2])


def folds(seen: NDArray, count: int) -> list[NDArray]:
    """Parts (n, T) of the record: each trajectory is cut into `count` blocks of samples.

    A fold has one block of each trajectory, another one in each, so that it holds all phases of a
    record without holding out the start of all trajectories.
    """
    trajectories, samples, _ = seen.shape
    block = np.arange(samples) * count // samples
    own = (block + np.arange(trajectories)[:, None]) % count
    return [own == fold for fold in range(count)]


def edges(states: NDArray, commands: NDArray, count: int) -> list[NDArray]:
    """Parts (n, T) of the record that hold what is at one end of the range of a variable.

    Without such a part, what is learned has to be extrapolated to it. For each end of each state
    and command it is the share 1 / count of the blocks that reach furthest. A block is as long as
    the variable's distance from its mean is correlated.

    Parameters
    ----------
    states, commands : NDArray
        (n, T, d_x) and (n, T, d_u).
    count : int
        The number of parts of that size.

    """
    parts = []
    trajectories, samples = states.shape[:2]
    for variable in np.moveaxis(np.concatenate([states, commands], axis=2), 2, 0):
        distance = (variable - variable.mean()) ** 2
        length = correlation_time((distance - distance.mean())[..., None])
        blocks = int(np.clip(samples / length, 2, samples))
        first = np.arange(blocks) * samples // blocks
        block = np.searchsorted(first, np.arange(samples), side="right") - 1
        for reached in (
            np.maximum.reduceat(variable, first, axis=1),
            -np.minimum.reduceat(variable, first, axis=1),
        ):
            furthest = np.argsort(-reached, axis=None, kind="stable")
            own = np.isin(np.arange(reached.size), furthest[: max(1, reached.size // count)])
            parts.append(own.reshape(trajectories, blocks)[:, block])
    return parts


def widening(twin: DynamicsTwin, estimation: Estimation, held_out: HeldOut) -> float:
    """Factor of deviations, with which bands hold as many held-out samples as they should."""
    deviation = np.sqrt(held_out.variances + twin.noise_variance(estimation.commands))
    ratio = (np.abs(held_out.errors) / deviation)[estimation.seen]
    return max(float(np.quantile(ratio, LEVEL) / ndtri((1 + LEVEL) / 2)), SMALLEST)
