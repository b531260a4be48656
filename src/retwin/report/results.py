"""What a study left behind: `results.json` and `arrays.npz`, read and checked."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from retwin.errors import InputError
from retwin.report.parts import (
    Channels,
    Comparison,
    CurvePoint,
    Data,
    Fidelity,
    Portrait,
    Source,
    Surrogate,
)

__all__ = ["SCHEMA", "Results", "read_results"]

SCHEMA = 1


class Results(BaseModel):
    """results.json, with the arrays beside it (empty when there are none)."""

    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True)

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
    def answered(self) -> list[str]:
        """Sources whose probabilities of every test trajectory are known."""
        known = {name: self.probabilities(name) for name in self.sources if self.classes}
        return [name for name, each in known.items() if each.size and np.isfinite(each).all()]

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


def _bad(argument: str, expected: str, got: str) -> InputError:
    remedy = "run `retwin study` with this folder as --out again"
    return InputError(argument, expected=expected, got=got, remedy=remedy)
