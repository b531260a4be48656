"""`Trials`: the fits of all candidates without each part of the records that is left out."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.evaluation.choice.candidates import Candidates
from retwin.evaluation.choice.comparison import Comparison, predict
from retwin.evaluation.choice.folds import Fold
from retwin.progress import Progress
from retwin.twins.collected import SimulationError
from retwin.update.forecasts import begin_of, unknown_starts
from retwin.workers.jobs import each
from retwin.workers.threads import one_thread

FAILURES = (InputError, SimulationError, RuntimeError, ArithmeticError, np.linalg.LinAlgError)
"""What ends a candidate, and not the comparison: refused records, diverging fits and trainings."""


@dataclass(eq=False)
class Trials:
    """The fits of some models without each fold.

    Attributes
    ----------
    records : Trajectories
        All records.
    folds : sequence of Fold
        What is left out in turn.
    names : sequence of str
        The models, the simplest first.
    fits : callable
        From the records without a fold to functions by name that fit the models to these.
    progress : callable, optional
        Called with the share that is done.
    models : dict of str to list
        By name, the model of each fold, as far as all were fitted.
    reasons : dict of str to str
        Why others were not.
    seconds : dict of str to float
        Processor time of all fits.

    """

    records: Trajectories
    folds: Sequence[Fold]
    names: Sequence[str]
    fits: Callable[[Trajectories], Mapping[str, Callable[[], Any]]]
    progress: Progress | None = None
    models: dict[str, list[Any]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def run(self, workers: int = 1) -> None:
        """Fit all, in this process or in so many others, to which `fits` is then sent."""
        count, done = len(self.folds), 0

        def report(share: float) -> None:
            if self.progress is not None:
                self.progress((done + share) / count)

        made: list[tuple[dict[str, Any], dict[str, str]]] = [({}, {})] * count
        fits = each(
            _fit_without,
            replace(self, progress=None),  # a worker cannot send progress
            range(count),
            workers=min(workers, count),
            scheduler=None,
            progress=report,
        )
        for number, models, reasons, seconds in fits:
            made[number], done = (models, reasons), done + 1
            self.reasons.update(reasons)
            for name, own in seconds.items():
                self.seconds[name] = self.seconds.get(name, 0.0) + own
            report(0.0)
        for _, reasons in reversed(made):  # that of the first fold, whichever came first
            self.reasons.update(reasons)
        for name in self.names:
            if name not in self.reasons:
                self.models[name] = [models[name] for models, _ in made]

    @property
    def begin(self) -> float:
        """Time in s at the begin of records that gives their starts; 0 where these are known.

        One record alone has the start that was identified with it.
        """
        unknown = any(unknown_starts(made[0]) for made in self.models.values())
        return begin_of(self.records) if unknown and len(self.records) > 1 else 0.0

    def compare(
        self, horizon: float | None, begin: float = 0.0
    ) -> tuple[Comparison, dict[str, str]]:
        """Of the models whose predictions stay finite, and why others have none; see `predict`."""
        records, reasons, predicted = self.records, dict(self.reasons), {}
        for name in (own for own in self.names if own not in reasons):
            pairs = zip(self.models[name], self.folds, strict=True)
            try:
                made = [predict(model, records, fold, horizon, begin) for model, fold in pairs]
            except FAILURES as error:
                reasons[name] = str(error)
                continue
            if not all(np.isfinite(each.mean[np.isfinite(each.last)]).all() for each in made):
                reasons[name] = "its simulation is not finite"
            elif Comparison(records, self.folds, {name: made}).diverged(name):
                reasons[name] = "its simulation diverges"
            else:
                predicted[name] = made
        return Comparison(records, self.folds, predicted), reasons


def _fit_without(
    trials: Trials, number: int, progress: Progress = lambda _: None
) -> tuple[int, dict[str, Any], dict[str, str], dict[str, float]]:
    """The models without a fold by its number, why others failed, and the time of each in s."""
    fits = trials.fits(trials.folds[number].training(trials.records))
    models, reasons, seconds = dict[str, Any](), dict[str, str](), dict[str, float]()
    for done, name in enumerate(trials.names, 1):
        if name in trials.reasons:  # it failed without another fold
            continue
        began, fit = time.process_time(), fits.get(name)
        try:
            with one_thread(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the final fit states them
                if fit is None:
                    raise InputError("records", expected="such records", got="none", remedy="")
                models[name] = fit()
        except FAILURES as error:
            reasons[name] = str(error)
        seconds[name] = time.process_time() - began
        progress(done / len(trials.names))
    return number, models, reasons, seconds


def unstable(comparison: Comparison, whole: Candidates) -> bool:
    """Whether free simulation is no way to judge candidates.

    All diverge, or none is better than the means of the outputs where already the parameters were
    identified over a shorter time.
    """
    errors = [
        float(np.mean(comparison.rmse(name) / comparison.spread)) for name in comparison.predicted
    ]
    if not errors or min(errors) < 1.0 or set(comparison.predicted) == {"none"}:
        return not errors
    return whole.updated is not None and bool(np.isfinite(whole.updated.horizon))


def shorter(whole: Candidates, *, short: float = 0.05) -> float:
    """Time in s over which candidates are judged that are unstable in free simulation.

    Parameters
    ----------
    short : float, default 0.05
        Part of the length of the records over which candidates are judged that are unstable.

    """
    records, updated = whole.records, whole.updated
    if updated is not None and np.isfinite(updated.horizon):
        return updated.horizon
    return max(1, round(short * records.steps)) / records.rate
