"""`retwin fit --dynamics`: corrected state equations, and what was learned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from retwin.cli.terminal import answer, bar, note, table
from retwin.data.trajectories import Trajectories

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.update import FittedStateSurrogate
    from retwin.update.dynamics import FittedDynamics, Prediction

LARGEST = 8
"""Number of terms of the state equations that are printed."""
SIGNIFICANT = 0.05
"""p-value below which errors are not taken for white noise."""


def fit_equations(
    system: Case, measured: Trajectories, out: Path, name: str, seed: int, *, as_json: bool
) -> None:
    """Learn what the state equations lack, save the twin, and print what was learned."""
    from retwin.update import fit_dynamics
    from retwin.update.dynamics import state_names

    twin, surrogate = system.twin, None
    if not state_names(twin):
        surrogate = _state_surrogate(system, measured, seed)
        twin = surrogate.twin
    with bar("fit") as show:
        found = fit_dynamics(
            twin,
            measured,
            system.dynamics,
            progress=lambda s: show("state equations", s),
        )
    replace(found.twin, case=name).save(out)
    parameters = [
        (each, f"{value:.4g} ± {found.errors[each]:.2g}", _strongest(found, each))
        for each, value in found.parameters.items()
    ]
    white = white_errors(found.twin.predictive(measured))
    terms = [(each, f"{size:.3f}") for each, size in list(found.terms.items())[:LARGEST]]
    figures = found.figures
    answer(
        {
            "saved": str(out),
            "parameters": found.parameters,
            "errors": found.errors,
            "correlations": [[*pair, each] for pair, each in found.correlations.items()],
            "terms": found.terms,
            "one_step_errors": white,
            "surrogate": None if surrogate is None else surrogate.figures,
            "figures": figures,
            "reason": found.reason,
        },
        f"Free simulation of the calibration record: RMS error {figures['rms_before']:.3g} with "
        f"the twin alone, {figures['rms_after']:.3g} with its equations corrected, "
        f"{figures['held_out']:.3g} in blocks left out.",
        table(("parameter", "value", "strongest correlation"), parameters, numbers=("value",)),
        "",
        *(
            f"One-step errors of {name} are {'not ' * (each['p'] < SIGNIFICANT)}white noise: the "
            f"largest autocorrelation is {each['autocorrelation']:.2g} at {each['lag']:.3g} s "
            f"(95 % limit {each['limit']:.2g}, Ljung and Box p = {each['p']:.2g})."
            for name, each in white.items()
        ),
        "",
        "The largest terms, over the usual time derivative of their state:",
        table(("term", "size"), terms, numbers=("size",)),
        as_json=as_json,
    )
    note(f"Saved {out}")


def _state_surrogate(system: Case, measured: Trajectories, seed: int) -> FittedStateSurrogate:
    """State equations that stand in for the case's twin, which is no `StateTwin`."""
    from retwin.twins import keep_workers
    from retwin.update import fit_state_surrogate

    with keep_workers(), bar("fit") as show:
        found = fit_state_surrogate(
            system.twin,
            system.sampler,
            measured,
            system.state_surrogate,
            seed=seed,
            progress=lambda s: show("state surrogate", s),
        )
    errors = (
        f"{found.figures[f'own_{name}']:.3g} {unit} of {name}"
        for name, unit in zip(found.twin.outputs.names, found.twin.outputs.units, strict=True)
    )
    note(
        f"The twin shows no state equations. Others with {found.figures['states']:.0f} states "
        "stand in for it, learned from simulations; on the measured commands their RMS error is "
        f"{', '.join(errors)}"
    )
    return found


def _strongest(found: FittedDynamics, parameter: str) -> str:
    """The strongest correlation of a parameter, and with what."""
    strongest = found.strongest(parameter)
    return f"{strongest[1]:+.2f} with {strongest[0]}" if strongest else "–"


def white_errors(prediction: Prediction) -> dict[str, dict[str, float]]:
    """The largest autocorrelation of the one-step errors of each output, and a test."""
    record = prediction.record
    return {
        name: {
            "autocorrelation": float(found.values[found.largest]),
            "lag": float(found.lags[found.largest] / record.rate),
            "limit": float(found.limits[found.largest]),
            "p": p,
        }
        for name, (found, p) in zip(record.outputs.names, prediction.whiteness(), strict=True)
    }
