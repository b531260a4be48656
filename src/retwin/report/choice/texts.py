"""Sentences on an updated twin, which the command line prints and the page shows."""

from __future__ import annotations

from retwin.evaluation.choice.fitted import Fitted
from retwin.update.corrected import CorrectedTwin
from retwin.update.residual import Residual, ResidualModel, StationaryResidual

SIGNIFICANT = 0.05
"""p-value below which errors are not taken for white noise."""


def model_sentences(found: Fitted) -> list[str]:
    """What the model was trained on, and whether its one-step errors are white noise."""
    made = []
    if isinstance(found.twin, CorrectedTwin) and found.twin.residual.fitted is not None:
        made.append(_residual(found.twin.residual))
    return made + [
        f"One-step errors of {name} are {'not ' * (each['p'] < SIGNIFICANT)}white noise: the "
        f"largest autocorrelation is {each['autocorrelation']:.2g} at {each['lag']:.3g} s "
        f"(95 % limit {each['limit']:.2g}, Ljung and Box p = {each['p']:.2g})."
        for name, each in found.one_step_errors.items()
    ]


def _residual(rg: Residual) -> str:
    """The training data of a residual model, and its errors on held-out parts."""
    assert rg.fitted is not None
    figures, reason = rg.fitted.figures, rg.fitted.reason
    emulated = "EMULATED " if rg.emulated else ""
    if isinstance(rg, ResidualModel):
        counted = f"{figures['movements']:.0f} segments of {figures['trajectories']:.0f} "
        shares = [
            f"{figures[f'coverage90_{name}']:.0%} of {name}"
            for name in rg.outputs.names
            if f"coverage90_{name}" in figures
        ]
        bands = f" Bands of 90 % hold {', '.join(shares)} in the calibration." if shares else ""
        return f"Residual model: {counted}{emulated}trajectories; {reason}.{bands}"
    made = f"Residual model: {figures['samples']:.0f} {emulated}samples; {reason}."
    if isinstance(rg, StationaryResidual):
        return made
    latent = zip(rg.latent.names, rg.latent.units, strict=True)
    errors = ", ".join(f"{name} {figures[f'rmse_{name}']:.3g} {unit}" for name, unit in latent)
    return (
        f"{made} On held-out parts the RMSE of its mean is {errors}, and its 90 % band covers "
        f"{figures['coverage90']:.0%}."
    )
