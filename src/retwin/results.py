"""`results.json` of a study, schema 1: the one model that writes and reads it.

JSON has no NaN: a number that is not defined is null in the file and NaN in the model. Keys that
the model does not have are ignored, so that files of later versions of the schema open.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_serializer,
    model_validator,
)

from retwin.catalog import METRICS
from retwin.checks import require
from retwin.errors import InputError
from retwin.serialisation.files import read_json

SCHEMA = 1
"""The version of the schema that every file states under `schema`."""

Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number; NaN where it is not defined, which the file states as null."""
Interval = tuple[Number, Number]
"""Lower and upper end."""


def _finite(interval: Interval | None) -> tuple[float, float] | None:
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
    intervals : dict of str to Interval
        The 95 % interval over test trajectories of a metric's mean over the runs at hand; of a
        study without classes with few records, over other stretches of these.
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

    intervals: dict[str, Interval | None] = {}
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

    def interval(self, metric: str) -> tuple[float, float] | None:
        """The interval of a metric; None if there is none."""
        return _finite(self.intervals.get(metric))

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
    intervals: dict[str, Interval | None] = {}

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

    def interval(self, metric: str) -> tuple[float, float] | None:
        """The interval of a metric; None if there is none."""
        return _finite(self.intervals.get(metric))


class Dataset(ResultsPart):
    """A data set: its file, its number of trajectories, and which of them have a role.

    `rate` is the sample rate of the data in Hz; None in files of versions that did not state it.
    """

    name: str = ""
    rate: float | None = None
    sha256: str = ""
    n: int | None = None
    used: list[str] | None = None
    ids: list[str] = []
    labels: list[str] = []

    @property
    def size(self) -> int:
        """The number of trajectories; 0 if it is not known."""
        return self.n or len(self.labels)


class Data(ResultsPart):
    """The data in their three roles."""

    twin: Dataset = Dataset()
    calibration: Dataset = Dataset()
    test: Dataset = Dataset()
    protocol: str = ""


class ChannelNames(ResultsPart):
    """Names and units of the commands or of the outputs."""

    names: list[str] = []
    units: list[str] = []


class Comparison(ResultsPart):
    """A pair of sources on one metric: `mean_diff` is the mean of `a` minus that of `b`.

    Attributes
    ----------
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
        return _finite(self.bootstrap_ci95)

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


class FidelityFigure(ResultsPart):
    """A figure with its interval over trajectories, and its p-value under a perfect generator."""

    value: Number = math.nan
    interval: Interval | None = None
    p: float | None = None

    @property
    def ends(self) -> tuple[float, float] | None:
        """The interval; None if there is none."""
        return _finite(self.interval)


class FidelityResults(ResultsPart):
    """How close the draws of one source's twin are to measured trajectories.

    Attributes
    ----------
    trajectories, draws : int
        Held-out healthy trajectories, and draws for each of them.
    rate : float
        In Hz.
    latents, latent_units : list of str
        The components of z per segment.
    segments : int
        The segments in which z is identified.
    rivals : list of str
        The simpler generators beside it.
    widening : float
        The factor by which split conformal prediction widens the 90 % band.
    at_bound : float
        The share of the delays at a bound of their range when the twins were calibrated.
    figures : dict of str to FidelityFigure
        By name, see `retwin.evaluation.fidelity.Fidelity`.

    """

    trajectories: int | None = None
    draws: int | None = None
    rate: float | None = None
    outputs: list[str] = []
    units: list[str] = []
    latents: list[str] = Field([], alias="movement")
    latent_units: list[str] = Field([], alias="movement_units")
    segments: int | None = Field(None, alias="movements")
    rivals: list[str] = []
    widening: float | None = None
    at_bound: float | None = None
    figures: dict[str, FidelityFigure] = {}

    @property
    def agreement(self) -> dict[str, FidelityFigure]:
        """KS distance between observed and generated, of every component of z that has one."""
        keys = {name: f"ks/{name}" for name in self.latents}
        return {name: self.figures[key] for name, key in keys.items() if key in self.figures}


class OverlayInfo(ResultsPart):
    """The source whose predictions stand beside the test trajectories, and its components of z."""

    source: str
    latents: list[str] = Field([], alias="movement")
    latent_units: list[str] = Field([], alias="movement_units")


class SurrogateError(ResultsPart):
    """Error of the surrogate against the twin, per output; `unit` is that of the RMSE."""

    rmse: dict[str, float] = {}
    nrmse: dict[str, float] = {}
    unit: str = ""


class Results(ResultsPart):
    """All that a study found, arrays apart.

    Attributes
    ----------
    sources : dict of str to SourceResults
        By the source's key in `retwin.catalog.SOURCES`.
    published : dict of str to dict of str to str
        The paper's figures of a source, by metric.
    comparisons : list of Comparison
        Every pair of sources on every metric that is compared.
    fidelity : dict of str to FidelityResults
        By source.

    """

    schema_version: Literal[1] = Field(1, alias="schema")
    case: str
    title: str = ""
    preset: str = ""
    classifier: str = ""
    runs: int
    classes: list[str] = []
    inputs: ChannelNames = ChannelNames()
    outputs: ChannelNames = ChannelNames()
    emulated: bool = False
    data: Data = Data()
    sources: dict[str, SourceResults] = Field(min_length=1)
    published: dict[str, dict[str, str]] = {}
    comparisons: list[Comparison] = []
    surrogate: SurrogateError = SurrogateError()
    fidelity: dict[str, FidelityResults] = {}
    learning_curve: list[CurvePoint] | None = None
    timing: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    overlay: OverlayInfo | None = Field(None, alias="portrait")

    @model_validator(mode="after")
    def _consistent(self) -> Results:
        size = len(self.classes)
        for name, source in self.sources.items():
            rows = source.confusion
            if rows is not None and [len(row) for row in rows] != [size] * size:
                raise ValueError(f"confusion of {name} is not {size} × {size}")
        unknown = set(self.data.test.labels) - set(self.classes)
        if unknown and self.classes:
            raise ValueError(f"test label {min(unknown)!r} is none of the classes")
        pairs = [name for each in self.comparisons for name in (each.a, each.b)]
        curve = [point.source for point in self.learning_curve or ()]
        for name in (*pairs, *self.fidelity, *curve):
            if name not in self.sources:
                raise ValueError(f"{name!r} is none of the sources")
        return self

    def has(self, metric: str) -> bool:
        """Whether any source has the metric."""
        return any(metric in each.scores for each in self.sources.values())

    def compared(self, a: str, b: str) -> dict[str, Comparison]:
        """The comparisons of this pair by metric, as a minus b."""
        pair = [each for each in self.comparisons if {each.a, each.b} == {a, b}]
        return {each.metric: each.with_first(a) for each in pair}

    def to_json(self) -> str:
        """The text of `results.json`."""
        return self.model_dump_json(by_alias=True, exclude_unset=True, indent=1)


def read_results(folder: str | os.PathLike[str]) -> Results:
    """The results of the study in `folder`.

    Raises
    ------
    InputError
        If results.json is missing, damaged, or of another schema.

    """
    path = Path(folder) / "results.json"
    again = "run `retwin study` with this folder as --out again"
    require(
        path.is_file(),
        "folder",
        expected="a folder with results.json",
        got=f"{folder}, which has none",
        remedy=again,
    )
    try:
        content = read_json(path)
    except InputError:
        raise
    except (ValueError, OSError) as error:
        raise InputError(
            "results.json", expected="JSON", got=f"{path} ({error})", remedy=again
        ) from error
    schema = content.get("schema") if isinstance(content, dict) else None
    require(
        schema == SCHEMA,
        "results.json",
        expected=f"schema {SCHEMA}",
        got=f"schema {schema!r}",
        remedy="make the report with the retwin that made the results",
    )
    try:
        return Results.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "results.json"
        raise InputError(
            where, expected="a value of schema 1", got=first["msg"], remedy=again
        ) from error
