"""Scores of candidates on the parts that each did not see, and the simplest that is good enough."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.evaluation.choice.folds import Fold, block_length, independent_means
from retwin.scores.distributions import crps_normal
from retwin.update.dynamics import DynamicsTwin
from retwin.update.forecast_errors import LEVEL, USUAL
from retwin.update.forecasts import forecasts, free_moments, started_moments

HARDLY = 0.02
"""Share of an error below which a difference counts as none, however sure it is."""


@dataclass(frozen=True, eq=False)
class Predicted:
    """Predictions of the records of which a fold leaves something out.

    Attributes
    ----------
    mean, deviation : NDArray
        (r, T, d_y).
    last : NDArray
        (r, T, d_y), see `Forecasts`; 0 in free simulation.
    propagated : bool
        Whether deviations are those of uncertainty that the model propagates in time, so that a
        constant may describe errors better.

    """

    mean: NDArray
    deviation: NDArray
    last: NDArray
    propagated: bool = False


def predict(
    model: object, records: Trajectories, fold: Fold, horizon: float | None, begin: float = 0.0
) -> Predicted:
    """Predictions of a fold by a model that was not fitted to it, free or `horizon` s ahead.

    Free simulations begin where the first `begin` s of each record say, and are scored after that.
    """
    own = records[fold.rows]
    if horizon is None and begin:
        mean, deviation = started_moments(model, own, begin)  # type: ignore[arg-type]
    else:
        mean, deviation = free_moments(model, own.commands)  # type: ignore[arg-type]
    if horizon is None:
        last = np.zeros_like(mean)
        mean[:, : round(begin * records.rate)] = last[:, : round(begin * records.rate)] = np.nan
        return Predicted(mean, deviation, last, isinstance(model, DynamicsTwin))
    lead = max(1, round(horizon * records.rate))
    made = forecasts(model, own, [lead])  # type: ignore[arg-type]
    return Predicted(made.mean[0], np.ones_like(mean), made.last[0])


@dataclass(frozen=True, eq=False)
class Comparison:
    """The predictions of some models on the same folds.

    Attributes
    ----------
    records : Trajectories
        The records.
    folds : sequence of Fold
        What was left out in turn.
    predicted : mapping of str to sequence of Predicted
        By model, one for each fold; the simplest model first.

    """

    records: Trajectories
    folds: Sequence[Fold]
    predicted: Mapping[str, Sequence[Predicted]]

    @cached_property
    def spread(self) -> NDArray:
        """Standard deviations (d_y,) of the outputs."""
        values = np.where(self.records.mask, self.records.observed, np.nan).astype(np.float64)
        found = np.nanstd(values, axis=(0, 1))
        return np.where(found > 0, found, 1.0)

    def errors(self, name: str, i: int) -> NDArray:
        """Errors (r, T, d_y) in a fold of what it leaves out; NaN elsewhere.

        The share of the last error that is added is that of the other folds.
        """
        made = self.predicted[name][i]
        return self._raw(name, i) - self._persistence(name, i) * made.last

    def _raw(self, name: str, i: int) -> NDArray:
        fold = self.folds[i]
        own = self.records[fold.rows]
        seen = own.mask & fold.held[fold.rows][..., None]
        return np.where(seen, own.observed - self.predicted[name][i].mean, np.nan)

    def _others(self, i: int) -> list[int]:
        return [j for j, fold in enumerate(self.folds) if j != i and not fold.edge]

    def _persistence(self, name: str, i: int) -> NDArray:
        products, powers = np.zeros(len(self.spread)), np.zeros(len(self.spread))
        for j in self._others(i):
            raw, last = self._raw(name, j), self.predicted[name][j].last
            last = np.where(np.isfinite(raw), last, np.nan)
            products += np.nansum(raw * last, axis=(0, 1))
            powers += np.nansum(last**2, axis=(0, 1))
        return np.clip(products / np.maximum(powers, 1e-300), 0.0, 1.0)

    def deviation(self, name: str, i: int) -> NDArray:
        """Deviations (r, T, d_y) of a fold, scaled to hold what the other folds show."""
        return self._deviation(name, i, self.constant[name])

    @cached_property
    def constant(self) -> dict[str, NDArray]:
        """By model, outputs (d_y,) whose deviation is the same at all times.

        They are those where that predicts the parts that were left out better, by CRPS.
        """
        found = {}
        for name, made in self.predicted.items():
            neither, scores = np.zeros(len(self.spread), dtype=bool), []
            for shape in (neither, ~neither):
                each = [self._crps(name, i, shape).reshape(-1, len(shape)) for i in self._all]
                scores.append(np.nanmean(np.concatenate(each), axis=0))
            found[name] = (scores[1] < scores[0]) & made[0].propagated
        return found

    def _deviation(self, name: str, i: int, constant: NDArray) -> NDArray:
        ratios = []
        for j in self._others(i):
            ratio = np.abs(self.errors(name, j)) / self._width(name, j, constant)
            ratios.append(ratio.reshape(-1, len(self.spread)))
        factor = np.nanquantile(np.concatenate(ratios), LEVEL, axis=0) / USUAL
        return np.asarray(self._width(name, i, constant) * factor)

    def _width(self, name: str, i: int, constant: NDArray) -> NDArray:
        own = np.maximum(self.predicted[name][i].deviation, 1e-9 * self.spread)
        return np.where(constant, self.spread, own)

    def _crps(self, name: str, i: int, constant: NDArray) -> NDArray:
        """CRPS (r, T, d_y) of a fold in standard deviations of the outputs."""
        error = self.errors(name, i)
        deviation = self._deviation(name, i, constant)
        return np.asarray(crps_normal(error, np.zeros_like(error), deviation) / self.spread)

    def diverged(self, name: str, *, large: float = 1e6) -> bool:
        """Whether a simulation left any reasonable range.

        Parameters
        ----------
        large : float, default 1e6
            Error, in standard deviations of an output, from which on a simulation has diverged.

        """
        return any(
            not np.nanmax(np.abs(self.errors(name, i)) / self.spread, initial=0.0) < large
            for i in self._all
        )

    def scores(self, name: str, i: int) -> NDArray:
        """CRPS (r, T) of a fold in standard deviations of the outputs, averaged over these."""
        each = self._crps(name, i, self.constant[name])
        seen = np.isfinite(each)
        count = seen.sum(axis=2)
        total = np.where(seen, each, 0.0).sum(axis=2)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def independent_scores(self, name: str) -> NDArray:
        """Mean scores (B,) of records or blocks, see `independent_means`; those of all models."""
        folds, shape = len(self.folds), self.records.mask.shape[:2]
        values = np.full((shape[0], folds, shape[1]), np.nan)
        for i, fold in enumerate(self.folds):
            values[fold.rows, i] = self.scores(name, i)
        return independent_means(values, self._lengths)

    @cached_property
    def _lengths(self) -> list[int]:
        first = next(iter(self.predicted))
        scores = [self.scores(first, i) for i in self._all]
        return [block_length(np.nan_to_num(each), np.isfinite(each)) for each in scores]

    def rmse(self, name: str) -> NDArray:
        """Root mean square errors (d_y,) of the parts that were left out."""
        squares = [self.errors(name, i).reshape(-1, len(self.spread)) ** 2 for i in self._all]
        return np.asarray(np.sqrt(np.nanmean(np.concatenate(squares), axis=0)))

    def coverage(self, name: str) -> NDArray:
        """Share (d_y,) of the samples inside 90 % bands that the other folds calibrate."""
        hits = []
        for i in self._all:
            error = self.errors(name, i)
            inside = np.abs(error) <= USUAL * self.deviation(name, i)
            hits.append(np.where(np.isfinite(error), inside, np.nan).reshape(-1, len(self.spread)))
        return np.asarray(np.nanmean(np.concatenate(hits), axis=0))

    @property
    def best(self) -> float:
        """The lowest mean score of a model."""
        return min(float(self.independent_scores(name).mean()) for name in self.predicted)

    @property
    def _all(self) -> range:
        return range(len(self.folds))

    def joined(self, parts: Callable[[int], NDArray]) -> NDArray:
        """What `parts` (r, T, d_y) gives for each part in time, as one array (n, T, d_y).

        It is NaN where nothing was left out.
        """
        made = np.full(self.records.observed.shape, np.nan)
        for i, fold in enumerate(self.folds):
            if not fold.edge:
                held = fold.held[fold.rows][..., None]
                made[fold.rows] = np.where(held, parts(i), made[fold.rows])
        return made

    def simplest(self) -> tuple[str, dict[str, tuple[float, float]]]:
        """The simplest model than which none is clearly better, see `is_behind`.

        One after the other, a model takes the place of a simpler one where it is clearly better
        than that: as in the rule of one standard error (Breiman et al., 1984), but a model that is
        not better than a simpler one is not taken because it is as good as a third one.

        Returns
        -------
        chosen : str
            Its name.
        differences : dict of str to (float, float)
            Of each model, the mean difference of its scores from the best one's, and the standard
            error of that.

        """
        scores = {name: self.independent_scores(name) for name in self.predicted}
        best = min(scores, key=lambda name: float(scores[name].mean()))
        differences = {name: _difference(own, scores[best]) for name, own in scores.items()}
        chosen = next(iter(scores))
        for name, own in scores.items():
            if is_behind(*_difference(scores[chosen], own), float(own.mean())):
                chosen = name
        return chosen, differences


def _difference(scores: NDArray, others: NDArray) -> tuple[float, float]:
    """Mean difference of scores (B,) from others, and its standard error."""
    change = scores - others
    error = change.std(ddof=1) / np.sqrt(len(change)) if len(change) > 1 else 0.0
    return float(change.mean()), float(error)


def is_behind(difference: float, error: float, other: float) -> bool:
    """Whether a score is above another by more than a standard error, and than HARDLY of that."""
    return difference > max(error, HARDLY * other)
