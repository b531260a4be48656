"""What a study left behind: `results.json` and `arrays.npz`, read and checked."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from retwin.errors import InputError

__all__ = [
    "SCHEMA",
    "Comparison",
    "CurvePoint",
    "Dataset",
    "Fidelity",
    "Figure",
    "Results",
    "Source",
    "read_results",
]

SCHEMA = 1
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
    """A part of results.json: read-only, and unknown keys are left to later versions."""

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


class Results(Part):
    """results.json, with the arrays beside it (empty when there are none)."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    case: str
    title: str = ""
    preset: str = ""
    classifier: str = ""
    runs: int
    classes: list[str] = []
    inputs: Channels = Channels()
    outputs: Channels = Channels()
    emulated: bool = False
    data: Data = Data()
    sources: dict[str, Source] = Field(min_length=1)
    published: dict[str, dict[str, str]] = {}
    comparisons: list[Comparison] = []
    surrogate: Surrogate = Surrogate()
    fidelity: dict[str, Fidelity] = {}
    portrait: Portrait | None = None
    learning_curve: list[CurvePoint] = []
    timing: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    arrays: dict[str, NDArray] = {}

    @model_validator(mode="before")
    @classmethod
    def _drop_none(cls, values: Any) -> Any:
        """A key that is null counts as absent."""
        if isinstance(values, dict):
            return {key: value for key, value in values.items() if value is not None}
        return values

    @model_validator(mode="after")
    def _consistent(self) -> Results:
        size = len(self.classes)
        for name, source in self.sources.items():
            rows = source.confusion
            if rows is not None and [len(row) for row in rows] != [size] * size:
                raise ValueError(f"confusion of {name} is not {size} × {size}")
            shape = self.probabilities(name).shape
            wanted = (len(self.data.test.labels), size)
            if shape != (0,) and shape[1:] != wanted:
                raise ValueError(f"probabilities/{name} has shape {shape}, not (runs, *{wanted})")
        for name in self.fidelity:
            self._check_latents(name)
            self._check_bands(name)
        self._check_portrait()
        self._check_simulations()
        strange = set(self.data.test.labels) - set(self.classes)
        if strange and self.classes:
            raise ValueError(f"test label {min(strange)!r} is none of the classes")
        return self

    def _check_latents(self, source: str) -> None:
        names = [f"z/{source}/{which}" for which in ("observed", "predicted")]
        width = len(self.fidelity[source].movement)
        for name in names:
            found = self.arrays.get(name)
            if found is not None and (found.ndim != 2 or found.shape[1] != width):
                raise ValueError(f"{name} has shape {found.shape}, not (movements, {width})")

    def _check_bands(self, source: str) -> None:
        pit = self.arrays.get(f"pit/{source}")
        if pit is not None and (pit.ndim != 2 or len(pit) != 3 or pit.shape[1] < 1):
            raise ValueError(f"pit/{source} has shape {pit.shape}, not (3, bins)")
        parts = self.bands(source)
        if not parts:
            return
        count, moments = parts["seen"].shape
        full = (count, moments, len(self.fidelity[source].outputs))
        shapes = {
            "nominal": full,
            "observed": full,
            "quantiles": (count, 5, *full[1:]),
            "ids": (count,),
            "rate": (),
        }
        for name, shape in shapes.items():
            if parts[name].shape != shape:
                raise ValueError(f"bands/{source}/{name} has {parts[name].shape}, not {shape}")

    def bands(self, source: str) -> dict[str, NDArray]:
        """What `bands/SOURCE/…` hold, by the last part of the name; empty if one is missing."""
        names = ("nominal", "observed", "seen", "quantiles", "ids", "rate")
        found = {name: self.arrays.get(f"bands/{source}/{name}") for name in names}
        there = {name: each for name, each in found.items() if each is not None}
        return there if len(there) == len(names) and there["seen"].ndim == 2 else {}

    def _check_simulations(self) -> None:
        full = self.arrays.get("simulation/observed", np.empty(0)).shape
        if full == (0,):
            return
        shapes = {"ids": full[:1], "rate": ()}
        for name in self.sources:
            shapes |= {f"{name}/mean": full, f"{name}/bands": (*full[:1], 5, *full[1:])}
        for name, shape in shapes.items():
            found = self.arrays.get(f"simulation/{name}")
            if (found is None and "/" not in name) or (found is not None and found.shape != shape):
                got = "missing" if found is None else f"of shape {found.shape}"
                raise ValueError(f"simulation/{name} is {got}, not of shape {shape}")

    def _check_portrait(self) -> None:
        """Arrays of the explorer must fit each other, or be told apart from those that are not."""
        if self.portrait is None or "portrait/bands" not in self.arrays:
            return
        bands = self.arrays["portrait/bands"]
        if bands.ndim != 4 or bands.shape[1] != 5 or not np.isfinite(bands).all():
            raise ValueError(
                f"portrait/bands has shape {bands.shape}, not (n, 5, moments, outputs)"
            )
        n, _, moments, outputs = bands.shape
        k = len(self.portrait.movement)
        wanted: dict[str, tuple[int | None, ...]] = {
            "portrait/commands": (n, moments, len(self.inputs.names)),
            "portrait/nominal": (n, moments, outputs),
            "portrait/observed": (n, moments, outputs),
            "portrait/z": (n, None, k),
            "portrait/deviation": (n, None, k),
            "portrait/times": (n, None, 3),
            "portrait/rate": (),
        }
        if "pose/nominal" in self.arrays:
            wanted |= dict.fromkeys(("pose/nominal", "pose/observed"), (n, moments, None, 3))
        for name, shape in wanted.items():
            found = self.arrays.get(name, np.empty(0)).shape
            same = [w in (None, f) for w, f in zip(shape, found, strict=False)]
            if len(found) != len(shape) or not all(same):
                raise ValueError(f"{name} has shape {found}, which does not fit portrait/bands")
        if (n, outputs) != (len(self.data.test.ids), len(self.outputs.names)):
            raise ValueError(f"portrait/bands has shape {bands.shape}, not of the test's outputs")

    def probabilities(self, source: str) -> NDArray:
        """(runs, n_test, classes), or empty."""
        return self.arrays.get(f"probabilities/{source}", np.empty(0))

    @property
    def truth(self) -> NDArray:
        """Class index of every test trajectory."""
        return np.array([self.classes.index(label) for label in self.data.test.labels], dtype=int)


def read_results(folder: str | os.PathLike[str]) -> Results:
    """The results of a study from its folder.

    Raises
    ------
    InputError: results.json is missing, damaged, of another schema, or does not agree with
        arrays.npz. A missing arrays.npz is no error: what needs it is left out.

    """
    path = Path(folder) / "results.json"
    if not path.is_file():
        raise _bad("folder", "a folder with results.json", f"{folder}, which has none")
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, OSError) as error:
        raise _bad("results.json", "JSON", f"{path} ({error})") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise InputError(
            "results.json",
            expected=f"schema {SCHEMA}",
            got=f"schema {schema!r}",
            remedy="make the report with the retwin that made the results",
        )
    try:
        return Results.model_validate({**content, "arrays": _read_arrays(path.parent)})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "results.json"
        raise _bad(where, "what schema 1 says", first["msg"]) from error


def _read_arrays(folder: Path) -> dict[str, NDArray]:
    path = folder / "arrays.npz"
    if not path.exists():
        return {}
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as error:  # whatever zip, numpy or the disk finds wrong with it
        raise _bad("arrays.npz", "arrays of a study", f"{path} ({error})") from error


def _finite(interval: Interval | None) -> tuple[float, float] | None:
    low, high = interval or (None, None)
    if low is None or high is None or not math.isfinite(low) or not math.isfinite(high):
        return None
    return low, high


def _bad(argument: str, expected: str, got: str) -> InputError:
    remedy = "run `retwin study` with this folder as --out again"
    return InputError(argument, expected=expected, got=got, remedy=remedy)
