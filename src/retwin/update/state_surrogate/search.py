"""The weights of a state surrogate on free simulation, and the number of its states.

The search follows the optimum from a strong prior about the linear model to a weak one, as that of
a black-box model does; but simulations have no noise, so that it goes on as long as simulations
that are held out are predicted better.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.dynamics.estimation import Estimation
from retwin.update.dynamics.linearised import Point
from retwin.update.dynamics.unknowns import unknowns_of
from retwin.update.state_surrogate.equations import Equations


@dataclass(frozen=True, eq=False)
class Found:
    """Equations, and the error of simulations that were held out.

    Attributes
    ----------
    equations : Equations
        With the best weights.
    error : float
        See `relative_error`; infinite where a simulation diverges.

    """

    equations: Equations
    error: float

    @property
    def order(self) -> int:
        """The number of states."""
        return len(self.equations.speed)


def relative_error(error: NDArray, seen: NDArray, deviation: NDArray) -> NDArray:
    """Root mean squares (d_y,) of errors (n, T, d_y) that count, over deviations (d_y,).

    Infinite where an error is not finite.
    """
    counted = np.where(seen, error, 0.0)
    count = np.maximum(seen.sum(axis=(0, 1)), 1)
    with np.errstate(over="ignore", invalid="ignore"):
        rms = np.sqrt(np.sum(counted**2, axis=(0, 1)) / count)
    return np.nan_to_num(rms, nan=np.inf) / deviation


@dataclass(frozen=True, kw_only=True)
class StateSearch:
    """The search for equations, with the number of states that predicts simulations best.

    Attributes
    ----------
    orders : iterable of int
        Numbers of states in the order in which they are tried; none for those from the number of
        components of the outputs on.
    hidden : int
        Width of the network; twice that is tried too if the error stays above the accuracy.
    accuracy : float
        No more states are tried once the error is below.
    enough : float
        The error from which on nothing is searched any more.
    strongest, weakest, ratio : float
        Variances of the error that are assumed first and last, in those of the outputs, and the
        ratio of one to the next: from a prior so strong that the network begins near 0 to nearly
        none.
    steps, few_steps : int
        Steps of the search with each variance at most, and the same on whole simulations, where it
        ends as soon as the error is small enough.
    max_passes : int
        Number of searches at most, those with the last variance included.
    worth : float
        Ratio of errors below which a further search, or another state, is worth its time.
    patience : int
        Searches, or numbers of states, that are tried beyond the best one.
    max_samples, min_steps : int
        Samples on which the search begins, the first ones of all simulations, and of each at least;
        it ends on whole simulations.
    more : int
        Largest number of states beyond the first that is tried.
    component : float
        Standard deviation of a component of the outputs, over that of the first, which counts.

    """

    orders: Iterable[int]
    hidden: int
    accuracy: float
    enough: float = 0.0
    strongest: float = 0.1
    weakest: float = 1e-8
    ratio: float = 10.0
    steps: int = 15
    few_steps: int = 5
    max_passes: int = 16
    worth: float = 0.95
    patience: int = 2
    max_samples: int = 30_000
    min_steps: int = 100
    more: int = 8
    component: float = 0.01

    def run(
        self, training: Trajectories, held_out: Trajectories, *, seed: int, progress: Progress
    ) -> tuple[Found, dict[int, float]]:
        """The equations with the number of states that predicts held-out simulations best.

        Parameters
        ----------
        training, held_out : Trajectories
            Simulations whose inputs are the commands and the parameters.
        seed : int
            Of the first weights.
        progress : callable
            Called with the share of the work that is done.

        Returns
        -------
        Found
            The best.
        dict of int to float
            The error by the number of states, over the samples on which the search begins.

        """
        first, rng = self._count_components(training.observed), np.random.SeedSequence(seed)
        steps = min(training.steps, max(self.min_steps, self.max_samples // len(training)))
        part, other = (each.between(0, steps / each.rate) for each in (training, held_out))

        def fit_order(order: int, width: int) -> Found:
            equations = Equations.begun(part, order, width, np.random.default_rng(rng))
            return self.fit(part, other, equations, self.strongest, self.steps)

        best: Found | None = None
        history: dict[int, float] = {}
        worse, target = 0, max(self.accuracy, self.enough)
        for order in tuple(self.orders) or range(first, first + self.more + 1):
            found = fit_order(order, self.hidden)
            history[order] = found.error
            worse += 1
            if best is None or found.error < self.worth * best.error:
                best, worse = found, 0
            progress(0.6 * (1 - 0.7 ** len(history)))
            if best.error < target or (worse == self.patience and np.isfinite(best.error)):
                break
        assert best is not None
        if best.error >= target:
            wider = fit_order(best.order, 2 * self.hidden)
            best = min(best, wider, key=lambda each: each.error)
            history[best.order] = best.error
        progress(0.7)
        if steps < training.steps and np.isfinite(best.error):
            whole = _error_of(best.equations, held_out) if self.enough else np.inf
            if whole > self.enough:
                steps = self.few_steps if self.enough else self.steps
                best = self.fit(training, held_out, best.equations, self.weakest, steps)
            else:
                best = Found(best.equations, whole)
        return best, history

    def fit(
        self,
        training: Trajectories,
        held_out: Trajectories,
        equations: Equations,
        variance: float,
        steps: int,
    ) -> Found:
        """The equations whose search begins at some weights, with an assumed variance.

        It ends where the error of held-out simulations is `enough`.
        """
        twin = equations.trainable(training)
        starts = dict.fromkeys((f"start_{each.name}" for each in twin.states), 0.0)
        weights = dict(zip(twin.names, equations.flat, strict=False))
        unknowns = unknowns_of(twin, twin.parameters, starts | weights)
        unknowns = replace(unknowns, deviation=np.ones(unknowns.count))
        power = equations.outputs.deviation**2
        estimation = Estimation(twin, training, unknowns, training.mask, power)
        best, worse = Found(equations, np.inf), 0
        now = estimation.linearised(Point(equations.flat, np.zeros((len(training), 0))))
        for _ in range(self.max_passes):
            if not now.finite:
                break
            now = replace(estimation, variance=variance * power).minimised(now, steps)
            tried = equations.with_weights(now.point.shared)
            error = _error_of(tried, held_out, twin)
            worse = 0 if error < self.worth * best.error else worse + 1
            if error < best.error:
                best = Found(tried, error)
            if worse == self.patience or best.error < self.enough:
                break
            variance = max(variance / self.ratio, self.weakest)
        return best

    def _count_components(self, outputs: NDArray) -> int:
        """How many components outputs (n, T, d_y) have: fewer states cannot tell them apart."""
        values = outputs.reshape(-1, outputs.shape[2])
        deviation = values.std(axis=0)
        scaled = (values - values.mean(axis=0)) / np.where(deviation > 0, deviation, 1.0)
        size = np.linalg.svd(scaled, compute_uv=False)
        return int(np.sum(size > self.component * size[0]))


def _error_of(equations: Equations, made: Trajectories, twin: StateTwin | None = None) -> float:
    """The largest relative error of an output in simulations; `twin` is `trainable` if it is known.

    Its present weights do not matter.
    """
    twin = twin or equations.trainable(made)
    theta = np.tile(np.append(equations.flat, np.zeros(len(twin.states))), (len(made), 1))
    simulated = twin.steps().run(made.commands.astype(np.float64), theta)[0]
    deviation = equations.outputs.deviation
    return float(relative_error(made.observed - simulated, made.mask, deviation).max())
