"""Sentences on an updated twin, which the command line prints and the page shows."""

from __future__ import annotations

from retwin.evaluation.choice.fitted import Fitted
from retwin.report.assets import sentences
from retwin.update.corrected import CorrectedTwin
from retwin.update.residual import ResidualModel, StationaryResidual

SIGNIFICANT = 0.05
"""p-value below which errors are not taken for white noise."""


def model_sentences(found: Fitted) -> list[str]:
    """What the model was trained on, and whether its one-step errors are white noise."""
    residual = found.twin.residual if isinstance(found.twin, CorrectedTwin) else None
    fitted = None if residual is None else residual.fitted
    covered, latent = [], {}
    if fitted is not None and isinstance(residual, ResidualModel):
        shares = {name: fitted.figures.get(f"coverage90_{name}") for name in residual.outputs.names}
        covered = [f"{each:.0%} of {name}" for name, each in shares.items() if each is not None]
    elif residual is not None and not isinstance(residual, StationaryResidual):
        latent = dict(zip(residual.latent.names, residual.latent.units, strict=True))
    return sentences(
        "model",
        fitted=fitted,
        emulated="EMULATED " if residual is not None and residual.emulated else "",
        covered=covered,
        latent=latent,
        one_step_errors=found.one_step_errors,
        significant=SIGNIFICANT,
    )
