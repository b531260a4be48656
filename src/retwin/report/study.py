"""The results and the arrays of a study, read and checked together."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import HEALTHY
from retwin.report.labels import order, quantities
from retwin.results import FidelityResults, Results, read_results
from retwin.results.sources import SourceResults
from retwin.scores.decisions import Decision, decide
from retwin.scores.histograms import Histogram, common_histogram
from retwin.scores.uses import uses_of
from retwin.serialisation.files import refusing

AGAIN = "run `retwin study` with this folder as --out again"
BANDS = ("nominal", "observed", "seen", "quantiles", "ids", "rate")
"""The arrays `bands/SOURCE/…`."""

Shape = tuple[int | None, ...]
"""The shape of an array; None stands for any length."""


@dataclass(frozen=True)
class Component:
    """A component of z: its values, measured (n,) and generated (m,), in the unit that is shown."""

    name: str
    unit: str
    observed: NDArray
    predicted: NDArray

    @cached_property
    def values(self) -> Histogram | None:
        """Both in common bins; None where there are none."""
        return common_histogram(self.observed, self.predicted)


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
        n, classes = len(self.results.data.test.labels), len(self.results.classes)
        for name in self.results.sources:
            self._require({f"probabilities/{name}": (None, n, classes)})
        for name, fidelity in self.results.fidelity.items():
            self._require(self._fidelity_shapes(name, fidelity))
        self._check_overlay()
        if "simulation/observed" in self.arrays:
            self._check_simulations()

    def _require(self, shapes: Mapping[str, Shape], *, needed: bool = False) -> None:
        """The arrays must have these shapes, in which None stands for any length."""
        for name, shape in shapes.items():
            found = self.arrays.get(name)
            if found is None and not needed:
                continue
            got = None if found is None else found.shape
            wanted = ", ".join("…" if length is None else str(length) for length in shape)
            require(
                got is not None
                and len(got) == len(shape)
                and all(w in (None, g) for w, g in zip(shape, got, strict=True)),
                name,
                expected=f"an array of shape ({wanted})",
                got="none" if got is None else f"shape {got}",
                remedy=AGAIN,
            )

    def _fidelity_shapes(self, source: str, fidelity: FidelityResults) -> dict[str, Shape]:
        """The shapes of the arrays on the draws of a source."""
        z, bands = self.arrays.get(f"z/{source}/observed"), self.bands(source)
        both = f"z/{source}/observed", f"z/{source}/predicted"
        shapes: dict[str, Shape] = dict.fromkeys(both, (None, len(fidelity.latents)))
        if z is not None:
            shapes[f"z/{source}/trajectory"] = z.shape[:1]
        shapes[f"pit/{source}"] = (3, None)
        if bands:
            count, samples = bands["seen"].shape
            full = (samples, len(fidelity.outputs))
            sizes = {"nominal": full, "observed": full, "quantiles": (5, *full), "ids": ()}
            shapes |= {f"bands/{source}/{name}": (count, *rest) for name, rest in sizes.items()}
            shapes[f"bands/{source}/rate"] = ()
        return shapes

    def _check_overlay(self) -> None:
        overlay, bands = self.results.overlay, self.arrays.get("portrait/bands")
        if overlay is None or bands is None:
            return
        n, outputs = len(self.results.overlaid), len(self.results.outputs.names)
        self._require({"portrait/bands": (n, 5, None, outputs)})
        wanted, got = "finite numbers", "numbers that are not"
        require(np.isfinite(bands).all(), "portrait/bands", expected=wanted, got=got, remedy=AGAIN)
        samples, latents = bands.shape[2], len(overlay.latents)
        values, chains = (n, samples, outputs), (n, samples, None, 3)
        shapes: dict[str, Shape] = {
            "portrait/commands": (n, samples, len(self.results.inputs.names)),
            **dict.fromkeys(("portrait/nominal", "portrait/observed"), values),
            **dict.fromkeys(("portrait/z", "portrait/deviation"), (n, None, latents)),
            "portrait/times": (n, None, 3),
            "portrait/rate": (),
        }
        if "pose/nominal" in self.arrays:
            shapes |= dict.fromkeys(("pose/nominal", "pose/observed"), chains)
        if "pose/updated" in self.arrays:
            shapes["pose/updated"] = chains
        self._require(shapes, needed=True)

    def _check_simulations(self) -> None:
        arrays = self.arrays
        self._require({"simulation/observed": (None, None, None)})
        full = arrays["simulation/observed"].shape
        self._require({"simulation/ids": full[:1], "simulation/rate": ()}, needed=True)
        for name in self.results.sources:
            bands = (full[0], 5, *full[1:])
            self._require({f"simulation/{name}/mean": full, f"simulation/{name}/bands": bands})
        if "simulation/commands" in arrays:
            self._require({"simulation/commands": (*full[:2], None)})
            channels = arrays["simulation/commands"].shape[2] + full[2]
            self._require({"simulation/range": (2, channels)})
        if "delta/values" in arrays:
            self._require({"delta/values": (None, None)})
            size = arrays["delta/values"].shape
            same = dict.fromkeys(("delta/discrepancy", "delta/deviation"), size)
            about: dict[str, Shape] = {"delta/range": (size[0], 2), "delta/about": (size[0], 4)}
            self._require(same | about, needed=True)
        if "delta/parameters" in arrays:
            self._require({"delta/parameters": (None, 3)})
            count = len(arrays["delta/parameters"])
            self._require({"delta/estimates": (count, 4)}, needed=True)

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
    def overlaid_healthy(self) -> NDArray:
        """Whether each trajectory of the overlay is healthy."""
        return self.healthy[self.results.overlaid]

    @property
    def output_quantities(self) -> list[tuple[float, str]]:
        """Factor and unit in which each output is shown."""
        return quantities(self.results.outputs.units, len(self.results.outputs.names))

    @property
    def portrait(self) -> dict[str, NDArray]:
        """The arrays `portrait/…` by the last part of the name; empty without predictions."""
        known = {
            name.split("/")[1]: each for name, each in self.arrays.items() if "portrait/" in name
        }
        return known if self.results.overlay is not None and "bands" in known else {}

    @property
    def diagnosing(self) -> list[str]:
        """The sources with finite probabilities of every test trajectory, in order."""
        known = {name: self.probabilities(name) for name in self.sources if self.results.classes}
        return [name for name, each in known.items() if each.size and np.isfinite(each).all()]

    @property
    def explorable(self) -> bool:
        """Whether there is what the explorer shows."""
        return bool(self.portrait and self.results.data.test.ids)

    def probabilities(self, source: str) -> NDArray:
        """Probabilities of shape (runs, n, classes); empty if there are none."""
        return self.arrays.get(f"probabilities/{source}", np.empty(0))

    def decision(self, source: str, rate: float) -> Decision:
        """The decision at a false-alarm rate of the first run: a threshold belongs to one model."""
        return decide(self.probabilities(source)[0], self.truth, self.results.classes, rate)

    def bands(self, source: str) -> dict[str, NDArray]:
        """The arrays `bands/SOURCE/…` by the last part of the name; empty if one is missing."""
        found = {name: self.arrays.get(f"bands/{source}/{name}") for name in BANDS}
        known = {name: each for name, each in found.items() if each is not None}
        return known if len(known) == len(BANDS) and known["seen"].ndim == 2 else {}

    def components(self, source: str) -> list[Component]:
        """The components of z of a source; none without measured and generated values."""
        both = [self.arrays.get(f"z/{source}/{name}") for name in ("observed", "predicted")]
        fidelity = self.results.fidelity.get(source)
        if fidelity is None or any(each is None for each in both):
            return []
        units = quantities(fidelity.latent_units, len(fidelity.latents))
        return [
            Component(name, unit, *(factor * each[:, i] for each in both if each is not None))
            for i, (name, (factor, unit)) in enumerate(zip(fidelity.latents, units, strict=True))
        ]


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
        refused = refusing(path, expected="arrays of a study", remedy=AGAIN)
        with refused, np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    study = Study(results, arrays)
    if results.uses:
        return study
    # A version that did not state the uses wrote these results.
    return replace(study, results=results.model_copy(update={"uses": uses_of(results, arrays)}))
