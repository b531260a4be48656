"""The results and the arrays of a study, read and checked together."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import HEALTHY
from retwin.errors import InputError
from retwin.report.labels import order
from retwin.results import Results, read_results
from retwin.source_results import SourceResults

AGAIN = "run `retwin study` with this folder as --out again"
BANDS = ("nominal", "observed", "seen", "quantiles", "ids", "rate")
"""The arrays `bands/SOURCE/…`."""


@dataclass(frozen=True)
class Study:
    """The results of a study and the arrays beside them, in agreement with each other.

    Parameters
    ----------
    results : Results
        The contents of `results.json`.
    arrays : mapping of str to array
        The contents of `arrays.npz`; empty if there is none.

    Raises
    ------
    InputError
        If the shape of an array does not agree with the results.

    """

    results: Results
    arrays: Mapping[str, NDArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.results.sources:
            shape = (None, len(self.results.data.test.labels), len(self.results.classes))
            self._require(f"probabilities/{name}", shape)
        for name in self.results.fidelity:
            self._check_fidelity(name)
        self._check_overlay()
        self._check_simulations()

    def _require(self, name: str, shape: tuple[int | None, ...], *, needed: bool = False) -> None:
        """The array must have that shape, in which None stands for any length."""
        found = self.arrays.get(name)
        if found is None and not needed:
            return
        got = () if found is None else found.shape
        same = len(got) == len(shape) and all(
            w in (None, g) for w, g in zip(shape, got, strict=True)
        )
        wanted = ", ".join("…" if length is None else str(length) for length in shape)
        require(
            same and found is not None,
            name,
            expected=f"an array of shape ({wanted})",
            got="none" if found is None else f"shape {got}",
            remedy=AGAIN,
        )

    def _check_fidelity(self, source: str) -> None:
        fidelity = self.results.fidelity[source]
        for name in ("observed", "predicted"):
            self._require(f"z/{source}/{name}", (None, len(fidelity.latents)))
        observed = self.arrays.get(f"z/{source}/observed")
        if observed is not None:
            self._require(f"z/{source}/trajectory", (len(observed),))
        self._require(f"pit/{source}", (3, None))
        parts = self.bands(source)
        if parts:
            count, samples = parts["seen"].shape
            full = (count, samples, len(fidelity.outputs))
            for name in ("nominal", "observed"):
                self._require(f"bands/{source}/{name}", full)
            self._require(f"bands/{source}/quantiles", (count, 5, *full[1:]))
            self._require(f"bands/{source}/ids", (count,))
            self._require(f"bands/{source}/rate", ())

    def _check_overlay(self) -> None:
        overlay, bands = self.results.overlay, self.arrays.get("portrait/bands")
        if overlay is None or bands is None:
            return
        n, outputs = len(self.results.data.test.ids), len(self.results.outputs.names)
        self._require("portrait/bands", (n, 5, None, outputs))
        require(
            np.isfinite(bands).all(),
            "portrait/bands",
            expected="finite numbers",
            got="numbers that are not",
            remedy=AGAIN,
        )
        samples, latents = bands.shape[2], len(overlay.latents)
        shapes: dict[str, tuple[int | None, ...]] = {
            "portrait/commands": (n, samples, len(self.results.inputs.names)),
            "portrait/nominal": (n, samples, outputs),
            "portrait/observed": (n, samples, outputs),
            "portrait/z": (n, None, latents),
            "portrait/deviation": (n, None, latents),
            "portrait/times": (n, None, 3),
            "portrait/rate": (),
        }
        if "pose/nominal" in self.arrays:
            shapes |= dict.fromkeys(("pose/nominal", "pose/observed"), (n, samples, None, 3))
        if "pose/updated" in self.arrays:
            shapes["pose/updated"] = (n, samples, None, 3)
        for name, shape in shapes.items():
            self._require(name, shape, needed=True)

    def _check_simulations(self) -> None:
        observed = self.arrays.get("simulation/observed")
        if observed is None:
            return
        full = observed.shape
        self._require("simulation/observed", (None, None, None))
        self._require("simulation/ids", full[:1], needed=True)
        self._require("simulation/rate", (), needed=True)
        for name in self.results.sources:
            self._require(f"simulation/{name}/mean", full)
            self._require(f"simulation/{name}/bands", (full[0], 5, *full[1:]))
        commands = self.arrays.get("simulation/commands")
        if commands is not None:
            self._require("simulation/commands", (*full[:2], None))
            self._require("simulation/range", (2, commands.shape[2] + full[2]))
        values = self.arrays.get("delta/values")
        if values is not None:
            self._require("delta/values", (None, None))
            for name in ("discrepancy", "deviation"):
                self._require(f"delta/{name}", values.shape, needed=True)
            self._require("delta/range", (len(values), 2), needed=True)
            self._require("delta/about", (len(values), 4), needed=True)
        parameters = self.arrays.get("delta/parameters")
        if parameters is not None:
            self._require("delta/parameters", (None, 3))
            self._require("delta/estimates", (len(parameters), 4), needed=True)

    @property
    def sources(self) -> dict[str, SourceResults]:
        """The results of every source, in the catalog's order."""
        return {name: self.results.sources[name] for name in order(self.results.sources)}

    @property
    def word(self) -> str:
        """The kind of the measured data: "real" or "emulated"."""
        return "emulated" if self.results.emulated else "real"

    @property
    def truth(self) -> NDArray:
        """Class indices of the test trajectories, shape (n,)."""
        labels = self.results.data.test.labels
        return np.array([self.results.classes.index(label) for label in labels], dtype=int)

    @property
    def healthy(self) -> NDArray:
        """Whether each test trajectory is healthy, shape (n,); all are where there is no class."""
        labels = np.array(self.results.data.test.labels, dtype=str)
        if not (self.results.classes and len(labels)):
            test = self.results.data.test
            return np.ones(len(test.ids) or test.size, dtype=bool)
        return labels == HEALTHY

    @property
    def output_units(self) -> list[str]:
        """The unit of every output, "" where none is stated."""
        names, units = self.results.outputs.names, self.results.outputs.units
        return [*units[: len(names)], *[""] * (len(names) - len(units))]

    @property
    def diagnosing(self) -> list[str]:
        """The sources with finite probabilities of every test trajectory, in order."""
        known = {name: self.probabilities(name) for name in self.sources if self.results.classes}
        return [name for name, each in known.items() if each.size and np.isfinite(each).all()]

    @property
    def explorable(self) -> bool:
        """Whether there is what the explorer shows."""
        known = self.results.overlay is not None and "portrait/bands" in self.arrays
        return known and bool(self.results.data.test.ids)

    def probabilities(self, source: str) -> NDArray:
        """Probabilities of shape (runs, n, classes); empty if there are none."""
        return self.arrays.get(f"probabilities/{source}", np.empty(0))

    def bands(self, source: str) -> dict[str, NDArray]:
        """The arrays `bands/SOURCE/…` by the last part of the name; empty if one is missing."""
        found = {name: self.arrays.get(f"bands/{source}/{name}") for name in BANDS}
        known = {name: each for name, each in found.items() if each is not None}
        return known if len(known) == len(BANDS) and known["seen"].ndim == 2 else {}


def read_study(folder: str | os.PathLike[str]) -> Study:
    """The study in a folder.

    Raises
    ------
    InputError
        If results.json is missing, damaged or of another schema, or arrays.npz is damaged or does
        not agree with it. Without arrays.npz, everything that needs it is left out.

    """
    results = read_results(folder)
    path = Path(folder) / "arrays.npz"
    arrays: dict[str, Any] = {}
    if path.exists():
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except Exception as error:  # whatever zip, numpy or the disk raises
            raise InputError(
                "arrays.npz", expected="arrays of a study", got=f"{path} ({error})", remedy=AGAIN
            ) from error
    return Study(results, arrays)
