"""The parts of `results.json`: read-only, and unknown keys are left to later versions."""

from __future__ import annotations

import math
from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator

__all__ = [
    "Channels",
    "Comparison",
    "CurvePoint",
    "Data",
    "Dataset",
    "Fidelity",
    "Figure",
    "Interval",
    "Part",
    "Portrait",
    "Source",
    "Surrogate",
]

SCORES = (
    "macro_f1",
    "balanced_accuracy",
    "auroc",
    "healthy_recall",
    "accuracy",
    "auroc_micro",
    "ece",
    "ece_classwise",
    "rmse",
    "nrmse",
    "crps",
    "coverage50",
    "coverage90",
)
"""Every score of a source that the page knows, in the order in which it is shown."""


Interval = tuple[float | None, float | None]


class Part(BaseModel):
    """What all parts have in common."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Dataset(Part):
    """One of the data sets: where from, how much, and which trajectories."""

    name: str = ""
    sha256: str = ""
    n: int | None = None
    used: list[str] | None = None
    ids: list[str] = []
    labels: list[str] = []


class Data(Part):
    """The three roles that data play."""

    twin: Dataset = Dataset()
    calibration: Dataset = Dataset()
    test: Dataset = Dataset()
    protocol: str = ""


class Source(Part):
    """Scores (one value per run) and costs of one source of training data."""

    scores: dict[str, list[float]]
    intervals: dict[str, Interval | None] = {}
    confusion: list[list[int]] | None = None
    real_data: str | None = None
    fault_protocol_known: bool | None = None
    twin_runs: int | None = None
    update_s: float | None = None
    generate_s: float | None = None
    generated: int | None = None
    train_s: float | None = None
    predict_s: float | None = None
    notes: list[str] = []

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, values: Any) -> Any:
        """Scores stand beside the other keys in the file; None stands for a missing value."""
        if not isinstance(values, dict):
            return values
        found = {name: values[name] for name in SCORES if values.get(name)}
        scores = {
            name: [math.nan if run is None else run for run in runs]
            if isinstance(runs, list)
            else runs
            for name, runs in found.items()
        }
        given = {key: value for key, value in values.items() if value is not None}
        return {**given, "scores": scores}

    def mean(self, metric: str) -> float:
        """Over the runs that have the score; NaN when none has."""
        finite = [run for run in self.scores.get(metric, []) if math.isfinite(run)]
        return sum(finite) / len(finite) if finite else math.nan

    def interval(self, metric: str) -> tuple[float, float] | None:
        """Bootstrap interval, if there is one."""
        return _finite(self.intervals.get(metric))


class Comparison(Part):
    """One pair of sources on one score: a minus b."""

    a: str
    b: str
    metric: str
    mean_diff: float
    t: float | None = None
    df: float | None = None
    p: float | None = None
    p_holm: float | None = None
    bootstrap_ci95: Interval | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Bootstrap interval of the difference, if there is one."""
        return _finite(self.bootstrap_ci95)

    def seen_from(self, name: str) -> Comparison:
        """The same comparison with `name` first."""
        if self.a == name:
            return self
        interval = self.interval
        turned = {
            "a": self.b,
            "b": self.a,
            "mean_diff": -self.mean_diff,
            "t": None if self.t is None else -self.t,
            "bootstrap_ci95": None if interval is None else (-interval[1], -interval[0]),
        }
        return self.model_copy(update=turned)


class Figure(Part):
    """A figure with its bootstrap interval, and the share of perfect generators as bad."""

    value: float | None = None
    interval: Interval | None = None
    p: float | None = None

    @property
    def ends(self) -> tuple[float, float] | None:
        """The interval, if there is one."""
        return _finite(self.interval)


class Fidelity(Part):
    """How real the draws of one source's twin are."""

    trajectories: int | None = None
    draws: int | None = None
    rate: float | None = None
    outputs: list[str] = []
    units: list[str] = []
    movement: list[str] = []
    movement_units: list[str] = []
    movements: int | None = None
    rivals: list[str] = []
    widening: float | None = None
    figures: dict[str, Figure] = {}

    @property
    def agreement(self) -> dict[str, Figure]:
        """KS distance between observed and generated, of every component of z that has one."""
        keys = {name: f"ks/{name}" for name in self.movement}
        return {name: self.figures[key] for name, key in keys.items() if key in self.figures}


class Channels(Part):
    """What is commanded or measured."""

    names: list[str] = []
    units: list[str] = []


class CurvePoint(Part):
    """Scores of a source calibrated on so many healthy trajectories."""

    source: str
    healthy: int
    macro_f1: list[float] = []
    rmse: list[float] = []
    rmse_interval: Interval | None = None
    macro_f1_interval: Interval | None = None
    healthy_recall: list[float] = []
    healthy_recall_interval: Interval | None = None
    coverage90: float | None = None
    coverage90_interval: Interval | None = None


class Portrait(Part):
    """Beside whose twin the test trajectories stand, and what is inferred of their movements."""

    source: str
    movement: list[str] = []
    movement_units: list[str] = []


class Surrogate(Part):
    """Error of the surrogate against the twin."""

    rmse: dict[str, float] = {}
    unit: str = ""
    nrmse: dict[str, float] = {}


def _finite(interval: Interval | None) -> tuple[float, float] | None:
    low, high = interval or (None, None)
    if low is None or high is None or not math.isfinite(low) or not math.isfinite(high):
        return None
    return low, high
