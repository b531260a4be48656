"""`Trials`: the fits of all candidates without each part of the records that is left out."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from retwin.checks import require
from retwin.errors import InputError
from retwin.evaluation.choice.candidates import Candidates, Model
from retwin.evaluation.choice.comparison import Comparison, predict
from retwin.evaluation.choice.folds import Fold
from retwin.progress import Progress
from retwin.twins.collected import SimulationError

FAILURES = (InputError, SimulationError, RuntimeError, ArithmeticError, np.linalg.LinAlgError)
"""What ends a candidate, and not the comparison: refused records, diverging fits and trainings."""
SHORT = 0.05
"""Part of the length of the records over which candidates are judged that are unstable."""


@dataclass(eq=False)
class Trials:
    """The fits of all candidates without each fold."""

    whole: Candidates
    folds: Sequence[Fold]
    names: Sequence[str]
    progress: Progress
    models: dict[str, list[Model]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def run(self) -> None:
        """Fit all."""
        total, done = len(self.names) * len(self.folds) + len(self.names), 0
        for fold in self.folds:
            training = fold.training(self.whole.records)
            own = replace(self.whole, records=training, settings=self.whole.settings.lighter)
            fits = own.fits
            for name in self.names:
                if name not in self.reasons:
                    self._try(name, fits.get(name), fold)
                done += 1
                self.progress(done / total)
        require(
            len(self.reasons) < len(self.names),
            "records",
            expected="records to which a candidate can be fitted without a part of them",
            got="; ".join(f"{name}: {reason}" for name, reason in self.reasons.items()),
            remedy="give longer or more records",
        )

    def _try(self, name: str, fit: Callable[[], Model] | None, fold: Fold) -> None:
        began = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the final fit states them
                if fit is None:
                    raise InputError("records", expected="such records", got="none", remedy="")
                self.models.setdefault(name, []).append(fit())
        except FAILURES as error:
            self.reasons[name] = str(error)
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - began

    def compare(self, horizon: float | None) -> tuple[Comparison, dict[str, str]]:
        """Of the candidates whose predictions stay finite, and why others have none."""
        records, reasons, predicted = self.whole.records, dict(self.reasons), {}
        for name in (each for each in self.names if each not in reasons):
            pairs = zip(self.models[name], self.folds, strict=True)
            try:
                made = [predict(model, records, fold, horizon) for model, fold in pairs]
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

    def final(self, name: str) -> Model:
        """The candidate, fitted to all records."""
        return self.whole.fits[name]()


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


def shorter(whole: Candidates) -> float:
    """Time in s over which candidates are judged that are unstable in free simulation."""
    records, updated = whole.records, whole.updated
    if updated is not None and np.isfinite(updated.horizon):
        return updated.horizon
    return max(1, round(SHORT * records.steps)) / records.rate
