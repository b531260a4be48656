"""`Fitted`: the twin that was chosen, and all that it was chosen from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.check import Checked
from retwin.data.quality.copies import fingerprints
from retwin.data.trajectories import Trajectories
from retwin.serialisation.files import write_atomically, write_json
from retwin.update.corrected import CorrectedTwin
from retwin.update.dynamics import DynamicsTwin, FittedDynamics

FILE, PAGE = "choice.json", "report.html"
"""The comparison and its page, in the folder of the model."""
HOLDS = ("model.json", "weights.safetensors", "surrogate", "residual", FILE, PAGE)
"""What the folder of a fitted twin may hold, whatever its correction is."""


@dataclass(frozen=True)
class CandidateScore:
    """How a candidate predicts what was left out of its fits.

    Attributes
    ----------
    name, title : str
        Key and words.
    rmse : dict of str to float
        By output, in its unit; empty where the candidate failed.
    nrmse : float
        The same over the outputs' standard deviations, averaged.
    crps : float
        In standard deviations of the outputs, averaged over blocks.
    difference, standard_error : float
        Of `crps` from that of the best candidate, over blocks; of a model without the twin, from
        that of the chosen one over the parts in time.
    coverage : dict of str to float
        By output, the share of samples inside 90 % bands that other parts calibrated.
    seconds : float
        Processor time of all fits.
    reason : str
        Why it has no score; "" if it has.
    uses_twin : bool
        False for a model that knows nothing of the twin.

    """

    name: str
    title: str
    rmse: dict[str, float]
    nrmse: float
    crps: float
    difference: float
    standard_error: float
    coverage: dict[str, float]
    seconds: float
    reason: str = ""
    uses_twin: bool = True


@dataclass(frozen=True, eq=False)
class Fitted:
    """An updated twin, with the comparison by which it was chosen.

    Attributes
    ----------
    twin : CorrectedTwin or DynamicsTwin
        The model, fitted to all records, its bands calibrated by the parts that were left out.
    chosen, preferred : str
        The candidate that `twin` is, and the one that the comparison shows; they differ where a
        method was given.
    scores : tuple of CandidateScore
        All candidates, the simplest first, and then the models without the twin.
    remarks : tuple of str
        What the comparison shows of twin and records, in sentences.
    parameters : mapping of str to (float, float, float)
        By parameter: before the fit, identified alone, and in `twin`.
    horizon : float or None
        Time ahead in s at which candidates were judged; None for free simulation.
    begin : float
        Time in s at the begin of each record by which the starts of free simulations were inferred,
        since they differ between records; 0 where they begin as the model does.
    parts : tuple of str
        What was left out in turn; none where nothing was compared.
    measured, predicted, deviation : NDArray
        (n, T, d_y): the records, and the chosen candidate's predictions of the parts in time that
        were left out; NaN elsewhere.
    learned : FittedDynamics or None
        What corrected state equations learned; None where the twin has none.
    seconds : float
        Duration.
    checked : Checked
        The records that were given, and what was found in them before anything was learned.

    """

    twin: CorrectedTwin | DynamicsTwin
    chosen: str
    preferred: str
    scores: tuple[CandidateScore, ...]
    remarks: tuple[str, ...]
    parameters: Mapping[str, tuple[float, float, float]]
    horizon: float | None
    begin: float
    parts: tuple[str, ...]
    records: Trajectories
    predicted: NDArray
    deviation: NDArray
    learned: FittedDynamics | None
    seconds: float
    checked: Checked

    def score(self, name: str) -> CandidateScore:
        """The score of a candidate."""
        return next(each for each in self.scores if each.name == name)

    @property
    def how(self) -> str:
        """How candidates predicted the parts that were left out."""
        if self.horizon is not None:
            return f"{self.horizon:g} s ahead of the last measurement"
        if self.begin:
            return f"free simulation from starts that the first {self.begin:g} s of a record give"
        return "free simulation from the commands"

    @property
    def option(self) -> str:
        """The option of `retwin evaluate` by which other records are predicted as these were."""
        if self.horizon is not None:
            return f" --horizon {self.horizon:g}s"
        return f" --warm-up {self.begin:g}s" if self.begin else ""

    @property
    def values(self) -> dict[str, Any]:
        """The comparison as JSON values."""
        scores = [
            {key: _finite(value) for key, value in asdict(each).items()} for each in self.scores
        ]
        return {
            "chosen": self.chosen,
            "preferred": self.preferred,
            "horizon": self.horizon,
            "begin": self.begin,
            "parts": list(self.parts),
            "candidates": scores,
            "remarks": list(self.remarks),
            "parameters": {name: list(each) for name, each in self.parameters.items()},
            "seconds": self.seconds,
            "records": self.checked.values,
            "fitted_to": fingerprints(self.records),
            "dynamics": self._learned,
            "residual": self._residual,
            "one_step_errors": self.one_step_errors,
        }

    @cached_property
    def one_step_errors(self) -> dict[str, dict[str, float]]:
        """By output, the largest autocorrelation of the errors of a filter, and a test of them.

        Corrected state equations have a filter; there is none of other corrections.
        """
        if not isinstance(self.twin, DynamicsTwin):
            return {}
        made = self.twin.predictive(self.records)
        return {
            name: {
                "autocorrelation": float(found.values[found.largest]),
                "lag": float(found.lags[found.largest] / self.records.rate),
                "limit": float(found.limits[found.largest]),
                "p": p,
            }
            for name, (found, p) in zip(made.record.outputs.names, made.whiteness(), strict=True)
        }

    @property
    def _learned(self) -> dict[str, Any] | None:
        found = self.learned
        if found is None:
            return None
        correlations = [[*pair, each] for pair, each in found.correlations.items()]
        errors = {name: _finite(each) for name, each in found.errors.items()}
        names = ("parameters", "terms", "figures", "reason")
        own = {name: getattr(found, name) for name in names}
        return own | {"errors": errors, "correlations": correlations}

    @property
    def _residual(self) -> dict[str, Any] | None:
        residual = self.twin.residual if isinstance(self.twin, CorrectedTwin) else None
        if residual is None or (fitted := residual.fitted) is None:
            return None
        figures = {name: _finite(each) for name, each in fitted.figures.items()}
        return {"emulated": residual.emulated, "figures": figures, "reason": fitted.reason}

    def save(self, folder: str | Path, *, page: str = "") -> None:
        """Write the twin as `rt.load_twin` reads it, the comparison, and a page if one is given."""
        with write_atomically(folder, folder=True, holds=HOLDS) as part:
            self.twin.save(part)
            write_json(part / FILE, self.values)
            if page:
                (part / PAGE).write_text(page, encoding="utf-8")


def _finite(value: Any) -> Any:
    """A value for JSON, which has neither NaN nor infinity."""
    return None if isinstance(value, float) and not np.isfinite(value) else value
