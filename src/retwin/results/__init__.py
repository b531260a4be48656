"""`results.json` of a study, schema 1: the one model that writes and reads it.

What it states of sources is in `retwin.results.sources`. Keys that the model does not have are
ignored, so that files of later versions of the schema open.

Belongs here: what study writes and report and command line read. Not here: how it is computed.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, model_validator

from retwin.checks import require
from retwin.errors import InputError
from retwin.results.sources import (
    Comparison,
    CurvePoint,
    Interval,
    Number,
    ResultsPart,
    SourceResults,
    finite_interval,
)
from retwin.serialisation.files import read_json, refusing

SCHEMA = 1
"""The version of the schema that every file states under `schema`."""


class Dataset(ResultsPart):
    """A data set: its file, its number of trajectories, and which of them have a role.

    `rate` is the sample rate of the data in Hz; None in files of versions that did not state it.
    """

    name: str = ""
    rate: float | None = None
    sha256: str = ""
    n: int | None = None
    used: list[str] | None = None
    ids: list[str] = Field(default=[])
    labels: list[str] = Field(default=[])

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

    names: list[str] = Field(default=[])
    units: list[str] = Field(default=[])


class FidelityFigure(ResultsPart):
    """A figure with its interval over trajectories, and its p-value under a perfect generator."""

    value: Number = math.nan
    interval: Interval | None = None
    p: float | None = None

    @property
    def ends(self) -> tuple[float, float] | None:
        """The interval; None if there is none."""
        return finite_interval(self.interval)


class FidelityResults(ResultsPart):
    """How close the draws of one source's twin are to measured trajectories.

    Attributes
    ----------
    trajectories, draws : int
        Held-out healthy trajectories, and draws for each of them.
    rate : float
        Sample rate of the comparison in Hz.
    outputs, units : list of str
        Names of the outputs, and their units.
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
    outputs: list[str] = Field(default=[])
    units: list[str] = Field(default=[])
    latents: list[str] = Field([], alias="movement")
    latent_units: list[str] = Field([], alias="movement_units")
    segments: int | None = Field(None, alias="movements")
    rivals: list[str] = Field(default=[])
    widening: float | None = None
    at_bound: float | None = None
    figures: dict[str, FidelityFigure] = Field(default={})

    @property
    def agreement(self) -> dict[str, FidelityFigure]:
        """KS distance between observed and generated, of every component of z that has one."""
        keys = {name: f"ks/{name}" for name in self.latents}
        return {name: self.figures[key] for name, key in keys.items() if key in self.figures}


class OverlayInfo(ResultsPart):
    """The source whose predictions stand beside test trajectories, and its components of z.

    `ids` are those trajectories, in the order of `data.test.ids`; empty in files of versions that
    simulated all of them.
    """

    source: str
    ids: list[str] = Field(default=[])
    latents: list[str] = Field([], alias="movement")
    latent_units: list[str] = Field([], alias="movement_units")


class Figure(ResultsPart):
    """A figure of a use, its interval, the original twin's on the same runs, and their number.

    `unit` is that of the outputs; "" of a share or a score.
    """

    value: Number = math.nan
    interval: Interval | None = None
    plain: Number = math.nan
    unit: str = ""
    n: int = 0

    @property
    def ends(self) -> tuple[float, float] | None:
        """The interval; None if there is none."""
        return finite_interval(self.interval)


class Missing(ResultsPart):
    """The one thing that a use lacks.

    `what` is "healthy" or "faulty" (runs), "test" (runs of any class), "records", "runs" (of
    training), "faults", "updated" (a twin), "correction", "source" or "real"; `count` is how many
    more, of "runs" how many in all, and None where it is not known.
    """

    what: str
    count: int | None = None


class Use(ResultsPart):
    """What an updated twin may be used for, see `retwin.scores.uses`.

    Attributes
    ----------
    use : str
        "simulate", "training", "diagnose" or "monitor".
    answer : str
        "yes", "likely", "cannot say" or "no".
    source, plain : str
        The best source, and the original twin beside it; "" without one.
    figures : dict of str to Figure
        What it reaches, by name.
    missing : Missing
        None if nothing is.

    """

    use: str
    answer: str
    source: str = ""
    plain: str = ""
    figures: dict[str, Figure] = Field(default={})
    missing: Missing | None = None

    def with_values(self, **values: object) -> Use:
        """The use with other values."""
        return self.model_copy(update=values)


class SurrogateError(ResultsPart):
    """Error of the surrogate against the twin, per output; `unit` is that of the RMSE."""

    rmse: dict[str, float] = Field(default={})
    nrmse: dict[str, float] = Field(default={})
    unit: str = ""


class Results(ResultsPart):
    """All that a study found, without the arrays in `arrays.npz`.

    Attributes
    ----------
    case, title : str
        The name of the case, and its title.
    preset, classifier : str
        By their keys in `retwin.catalog.PRESETS` and `retwin.catalog.CLASSIFIERS`.
    runs : int
        Runs of every source.
    classes : list of str
        Names of the classes in their fixed order; empty where nothing is diagnosed.
    inputs, outputs : ChannelNames
        Commands and outputs.
    emulated : bool
        Whether the real trajectories are those of an emulated system.
    data : Data
        The data sets and their roles.
    records : dict of str to Any
        What was found in the real records, see `retwin.data.Checked`; empty in files of versions
        that did not look.
    sources : dict of str to SourceResults
        By the source's key in `retwin.catalog.SOURCES`.
    published : dict of str to dict of str to str
        The paper's figures of a source, by metric.
    comparisons : list of Comparison
        Every pair of sources on every metric that is compared.
    surrogate : SurrogateError
        Mean over the runs that have one.
    fidelity : dict of str to FidelityResults
        By source.
    learning_curve : list of CurvePoint
        By source and number of healthy calibration trajectories; None if none was asked for.
    timing, provenance : dict of str to Any
        Seconds of each kind of job; and the command, the seed, versions and the machine.
    overlay : OverlayInfo
        The predictions beside the test trajectories; None if no twin was corrected.
    uses : list of Use
        What the best source may be used for; empty in files of versions that did not state it.

    """

    schema_version: Literal[1] = Field(1, alias="schema")
    case: str
    title: str = ""
    preset: str = ""
    classifier: str = ""
    runs: int
    classes: list[str] = Field(default=[])
    inputs: ChannelNames = ChannelNames()
    outputs: ChannelNames = ChannelNames()
    emulated: bool = False
    data: Data = Data()
    records: dict[str, Any] = Field(default={})
    sources: dict[str, SourceResults] = Field(min_length=1)
    published: dict[str, dict[str, str]] = Field(default={})
    comparisons: list[Comparison] = Field(default=[])
    surrogate: SurrogateError = SurrogateError()
    fidelity: dict[str, FidelityResults] = Field(default={})
    learning_curve: list[CurvePoint] | None = None
    timing: dict[str, Any] = Field(default={})
    provenance: dict[str, Any] = Field(default={})
    overlay: OverlayInfo | None = Field(None, alias="portrait")
    uses: list[Use] = Field(default=[])

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

    @property
    def overlaid(self) -> list[int]:
        """Places in `data.test` of the trajectories of the overlay; none without one."""
        if self.overlay is None:
            return []
        tested = self.data.test.ids
        known = set(self.overlay.ids or tested)
        return [place for place, name in enumerate(tested) if name in known]

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
    with refusing("results.json", expected="JSON", remedy=again):
        content = read_json(path)
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
