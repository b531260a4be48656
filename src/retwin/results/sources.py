"""What `results.json` states of sources: scores, costs, learning curves, and comparisons of pairs.

JSON has no NaN: a number that is not defined is null in the file and NaN in the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, model_serializer, model_validator

from retwin.catalog import METRICS

Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number; NaN where it is not defined, which the file states as null."""
Interval = tuple[Number, Number]
"""Lower and upper end."""


def finite_interval(interval: Interval | None) -> tuple[float, float] | None:
    """The interval, if both ends are defined; None otherwise."""
    known = interval is not None and all(map(math.isfinite, interval))
    return interval if known else None


class ResultsPart(BaseModel):
    """What all parts of the file have in common."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    @model_validator(mode="before")
    @classmethod
    def _null_is_absent(cls, values: Any) -> Any:
        """A null counts as absent where the field does not take it."""
        if not isinstance(values, Mapping):
            return values
        defaults = {each.alias or name: each.default for name, each in cls.model_fields.items()}
        nullable = {
            key
            for key, each in defaults.items()
            if each is None or (isinstance(each, float) and math.isnan(each))
        }
        return {key: v for key, v in values.items() if v is not None or key in nullable}


class Scored(ResultsPart):
    """A part whose scores stand beside its other keys in the file, by their names.

    Attributes
    ----------
    scores : mapping of str to list of float
        The values over runs by the metric's name in `retwin.catalog.METRICS`; a plain number where
        there is one value for all runs.

    """

    scores: Mapping[str, list[Number] | float] = {}
    intervals: dict[str, Interval | None] = {}

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, values: Any) -> Any:
        if not isinstance(values, Mapping) or "scores" in values:
            return values
        found = {name: values[name] for name in METRICS if values.get(name) not in (None, [])}
        return {**{key: v for key, v in values.items() if key not in METRICS}, "scores": found}

    @model_serializer(mode="wrap")
    def _spread(self, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        made = handler(self)
        return {**made.pop("scores"), **made}

    def interval(self, metric: str) -> tuple[float, float] | None:
        """The interval of a metric; None if there is none."""
        return finite_interval(self.intervals.get(metric))

    def runs(self, metric: str) -> list[float]:
        """The values of a metric over runs; empty if there are none."""
        values = self.scores.get(metric, [])
        return values if isinstance(values, list) else [values]

    def mean(self, metric: str) -> float:
        """The mean of a metric over the runs in which it is defined; NaN if there is none."""
        finite = [value for value in self.runs(metric) if math.isfinite(value)]
        return sum(finite) / len(finite) if finite else math.nan


class SourceResults(Scored):
    """Scores and costs of one source of training data.

    Attributes
    ----------
    title : str
        The name in tables.
    confusion : list of list of int
        Counts (true class, predicted class), summed over runs.
    predictions : list of list of int
        Predicted class indices (runs, test trajectories).
    real_data : str
        What the source may learn from, see `retwin.catalog.SourceEntry`.
    fault_protocol_known : bool
        Whether the training faults follow the published onset and sizes.
    twin_runs : int
        Simulations by the twin in one run of the study.
    update_s, generate_s, train_s, predict_s : float
        Seconds for the update of the twin, for the `generated` trajectories, for training the
        diagnoser, and per diagnosed trajectory; None where there is no such stage.
    generated : int
        Trajectories in the training set.
    notes : list of str
        Warnings of the stages.

    """

    confusion: list[list[int]] | None = None
    predictions: list[list[int]] | None = None
    fault_protocol_known: bool | None = None
    title: str = ""
    real_data: str | None = None
    update_s: float | None = None
    generate_s: float | None = None
    generated: int | None = None
    train_s: float | None = None
    predict_s: float | None = None
    twin_runs: int | None = None
    notes: list[str] = []

    def generation_seconds(self, trajectories: int) -> float | None:
        """Seconds for so many trajectories, in proportion to the time of those generated."""
        if self.generate_s is None or not self.generated:
            return None
        return self.generate_s * trajectories / self.generated


class CurvePoint(Scored):
    """Scores of a source that was calibrated on `healthy` healthy trajectories.

    The interval of a metric stands under `METRIC_interval` in the file.
    """

    source: str
    healthy: int

    @model_validator(mode="before")
    @classmethod
    def _gather_intervals(cls, values: Any) -> Any:
        if not isinstance(values, Mapping) or "intervals" in values:
            return values
        keys = {f"{name}_interval": name for name in METRICS}
        intervals = {keys[key]: each for key, each in values.items() if key in keys}
        return {**{k: v for k, v in values.items() if k not in keys}, "intervals": intervals}

    @model_serializer(mode="wrap")
    def _spread(self, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        made = handler(self)
        intervals = {f"{name}_interval": each for name, each in made.pop("intervals").items()}
        return {**made.pop("scores"), **made, **intervals}


class Comparison(ResultsPart):
    """A pair of sources on one metric.

    Attributes
    ----------
    a, b : str
        The sources, by their keys in `retwin.catalog.SOURCES`.
    metric : str
        By its name in `retwin.catalog.METRICS`.
    mean_diff : float
        The mean of `a` over runs minus that of `b`.
    t, df, p : float
        Welch's test over runs.
    p_holm : float
        The same adjusted over the family of metrics.
    bootstrap_ci95 : Interval
        The paired bootstrap interval over test trajectories and, from five runs on, over runs.
    p_bootstrap : float
        The two-sided p-value of these draws.
    p_verdict : float
        The same adjusted over all pairs on this metric; None for a pair without a verdict.
    no_verdict : str
        Why there is none, see `retwin.scores.comparison.no_verdict`; "" for a pair that has one,
        and None in files of versions that did not state it.

    """

    a: str
    b: str
    metric: str
    mean_diff: Number = math.nan
    t: float | None = None
    df: float | None = None
    p: float | None = None
    p_holm: float | None = None
    bootstrap_ci95: Interval | None = None
    p_bootstrap: float | None = None
    p_verdict: float | None = None
    no_verdict: str | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The bootstrap interval of the difference; None if there is none."""
        return finite_interval(self.bootstrap_ci95)

    def with_first(self, name: str) -> Comparison:
        """The same comparison with the source `name` as `a`."""
        if self.a == name:
            return self
        ends = self.interval
        opposite = {
            "a": self.b,
            "b": self.a,
            "mean_diff": -self.mean_diff,
            "t": None if self.t is None else -self.t,
            "bootstrap_ci95": None if ends is None else (-ends[1], -ends[0]),
        }
        return self.model_copy(update=opposite)
