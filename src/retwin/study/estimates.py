"""Estimates of the parameters of corrected dynamics, in the folder of an update of a study."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.serialisation.files import read_json, write_json
from retwin.update.dynamics import FittedDynamics

FILE = "estimates.json"
"""Per parameter: name, estimate, error, what it is most correlated with, and how much. It is
null for what is not determined."""


def write_estimates(folder: Path, made: FittedDynamics) -> None:
    """Write the estimates beside the twin."""
    rows = []
    for name, value in made.parameters.items():
        other, correlation = made.strongest(name) or ("", None)
        error = made.errors[name]
        rows.append([name, value, error if np.isfinite(error) else None, other, correlation])
    write_json(folder / FILE, rows)


def read_estimates(
    folder: Path, given: Mapping[str, float], units: Mapping[str, str]
) -> dict[str, NDArray]:
    """The estimates as arrays; none of an update without parameters, or of an earlier version.

    Parameters
    ----------
    folder : Path
        That of the update.
    given, units : mapping
        The parameters' values before the update, and their units.

    Returns
    -------
    dict of str to ndarray
        `parameters` (k, 3), which are name, unit and what it is most correlated with, and
        `estimates` (k, 4): the value as given, the estimate, its error and that correlation, NaN
        for none.

    """
    rows = read_json(folder / FILE) if (folder / FILE).exists() else []
    if not rows:
        return {}
    names = [[name, units.get(name, ""), other] for name, _, _, other, _ in rows]
    values = [[given.get(name), value, error, r] for name, value, error, _, r in rows]
    return {"parameters": np.array(names), "estimates": np.array(values, dtype=np.float64)}
