"""A twin with corrected dynamics as a folder, and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.checks import one_of, require
from retwin.serialisation.models import read_model, refusing, save_model
from retwin.twins.equations.saved_equations import equations_from, equations_of
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.discrepancy.equations import correctable
from retwin.update.forecast_errors import ForecastErrors

__all__ = ["read_fields", "write_fields"]

KIND = "dynamics"
"""Kind of the saved model."""
ARRAYS = (
    "values",
    "factor",
    "start_deviation",
    "process",
    "proportional",
    "free_process",
    "noise",
    "widening",
    "constant",
)
"""Attributes that are saved as arrays."""
DOMAIN = ("low", "high", "mean", "speed")
"""Attributes of the domain."""


def write_fields(folder: str | Path, fields: Mapping[str, Any]) -> None:
    """Write the fields of a `DynamicsTwin`, its equations as operations on numbers."""
    forecast: ForecastErrors | None = fields["forecast"]
    about: dict[str, Any] = {
        "equations": equations_of(fields["equations"]),
        "corrected": list(fields["corrected"]),
        "emulated": fields["emulated"],
        "case": fields["case"],
        "forecast": forecast and forecast.values,
    }
    arrays = {name: fields[name] for name in ARRAYS}
    arrays |= {f"domain_{name}": getattr(fields["domain"], name) for name in DOMAIN}
    save_model(folder, KIND, about, {k: torch.tensor(v) for k, v in arrays.items()})


def read_fields(folder: str | Path) -> dict[str, Any]:
    """The fields that `write_fields` wrote.

    Raises InputError if the folder holds no such model or is damaged.
    """
    about, weights = read_model(folder, KIND)
    with refusing(folder, expected="corrected dynamics"):
        equations = equations_from(StateTwin, about["equations"])
        arrays = {name: weights[name].double().numpy() for name in ARRAYS}
        domain = Domain(*(weights[f"domain_{name}"].double().numpy() for name in DOMAIN))
        _check(equations, arrays, domain)
        return {
            "equations": equations,
            **arrays,
            "domain": domain,
            "corrected": correctable(equations, about["corrected"]),
            "emulated": one_of("emulated", about["emulated"], (True, False)),
            "case": about["case"],
            "forecast": ForecastErrors.of(about.get("forecast")),
        }


def _check(equations: StateTwin, arrays: Mapping[str, NDArray], domain: Domain) -> None:
    """Refuse arrays that do not belong to the equations, and variances below 0."""
    traced = equations.model
    parameters, states = len(equations.parameters), len(traced.slope)
    shapes = [arrays[name].shape for name in ARRAYS]
    both = parameters + states
    wanted = [(both,), (both, shapes[1][-1]), *[(states,)] * 4, *[(len(traced.outputs),)] * 3]
    fits = shapes == wanted and all(np.isfinite(each).all() for each in arrays.values())
    expected = f"finite arrays of the shapes {wanted}"
    require(fits, "weights", expected=expected, got=shapes, remedy="save the model again")
    ends = np.stack([domain.low, domain.mean, domain.high])
    sound = (
        all((arrays[name] >= 0).all() for name in ARRAYS[2:])
        and (arrays["noise"] > 0).all()
        and ends.shape == (3, states + len(equations.inputs))
        and domain.speed.shape == (states,)
        and np.isfinite(ends).all()
        and np.isfinite(domain.speed).all()
        and (np.diff(ends, axis=0) >= 0).all()
    )
    expected = "variances above 0 and a domain of all states and commands"
    require(sound, "weights", expected=expected, got="others", remedy="save the model again")
