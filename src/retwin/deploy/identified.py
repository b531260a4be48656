"""`save_identification`: identified parameters, their page, and what other commands go on with."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic_core import to_jsonable_python

from retwin._version import __version__
from retwin.cases.file import read_case
from retwin.cases.logs import Logs
from retwin.cases.opened_twin import OpenedTwin
from retwin.cases.updated_case import updated_case
from retwin.data.io import load, save
from retwin.data.quality.check import Checked
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.evaluation.identification.parameters import spread_of
from retwin.evaluation.identification.validation import Identification
from retwin.report.identification import identification_page
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place
from retwin.twins.fmu.twin import FMUTwin
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.agreement import check_with_twin
from retwin.update.identification.posterior import Posterior

SCHEMA = 1
"""The version of identification.json."""
HOLDS = ("identification.json", "logs.npz", "report.html", "start_values.json", "updated.toml")
"""The files in the folder."""


def identified_by(case: str | os.PathLike[str], records: Trajectories) -> bool:
    """Whether the parameters of a case were identified by one of these records, or more.

    Such a case is the updated.toml of `save_identification`, beside its measurements.
    """
    folder = Path(case).parent
    beside = [(folder / each).is_file() for each in ("identification.json", "logs.npz")]
    if Path(case).name != "updated.toml" or not all(beside):
        return False
    known, given = (
        [own.observed[i][own.mask[i]] for i in range(len(own)) if own.mask[i].any()]
        for own in (load(folder / "logs.npz"), records)
    )
    # The begin of a record may have been left out of the identification.
    return any(_same_ends(one, other) for one in known for other in given)


def _same_ends(one: NDArray, other: NDArray) -> bool:
    """Whether the shorter of two arrays is the end of the longer one."""
    size = min(len(one), len(other))
    return np.array_equal(one[-size:], other[-size:])


def save_identification(
    found: Identification,
    opened: OpenedTwin,
    logs: Logs,
    folder: str | os.PathLike[str],
    *,
    checked: Checked | None = None,
    command: str = "",
) -> dict[str, Any]:
    """Write the result of an identification, whole or not at all.

    | file | holds |
    |---|---|
    | `identification.json` | parameters, errors, correlations, open directions, RMSE, tests |
    | `report.html` | the same as a page that needs no other file |
    | `updated.toml` | a case whose twin has the identified values, for other commands |
    | `start_values.json` | for an FMU: start values by name, as FMPy takes them |
    | `logs.npz` | the measurements as trajectories |

    Parameters
    ----------
    found : Identification
        What `validate_identification` returned.
    opened : OpenedTwin
        The twin, as it was opened.
    logs : Logs
        The measurements, as they were read.
    folder : path
        The folder to make, or to replace if it holds such files only.
    checked : Checked, optional
        What was found in the measurements; by default they are checked here.
    command : str
        The command that makes it again, for the page.

    Returns
    -------
    dict of str to Any
        The contents of identification.json, and in addition `files`, the path of each file that was
        written by its name.

    Raises
    ------
    InputError
        The folder cannot be written.

    """
    check_place(folder, folder=True, holds=HOLDS)
    checked = checked or check_with_twin(opened.twin, logs.trajectories)
    values = identification_values(found, opened, logs) | {"records": checked.values}
    start = start_values(found.twin)
    with write_atomically(folder, folder=True, holds=HOLDS) as part:
        save(logs.trajectories, part / "logs.npz")
        spread = spread_of(found.parameters)
        measured = ("logs.npz", logs.trajectories, spread, logs.columns)
        text = updated_case(opened, found.twin, part, *measured)
        (part / "updated.toml").write_text(text, encoding="utf-8")
        values["updated_case"] = _refused(part / "updated.toml", found.twin)
        if values["updated_case"]:
            (part / "updated.toml").unlink()
        if start:
            _write_json(part / "start_values.json", start)
        _write_json(part / "identification.json", values)
        about = {"command": command, "folder": str(folder)}
        page = identification_page(found, values, start, checked, **about)
        (part / "report.html").write_text(page, encoding="utf-8", newline="\n")
        names = sorted(each.name for each in part.iterdir())
    return {**values, "files": {name: str(Path(folder) / name) for name in names}}


def identification_values(found: Identification, opened: OpenedTwin, logs: Logs) -> dict[str, Any]:
    """The contents of identification.json, as plain values; NaN and infinity become null."""
    result = found.found
    bayes = isinstance(result, Posterior)
    measured = {part: each[0] for part, each in found.simulated.items()}
    about: dict[str, Any] = {
        "schema": SCHEMA,
        "retwin": __version__,
        "twin": opened.name,
        "method": "bayes" if bayes else "least squares",
        "emulated": logs.trajectories.emulated,
        "parameters": {
            each.name: {**_without_name(asdict(each)), "covered": each.covered}
            for each in found.parameters
        },
        "errors_rest_on": found.basis,
        "correlations": _correlations([each.name for each in found.parameters], found.correlation),
        "directions": [asdict(each) for each in found.directions],
        "outputs": {each.name: _without_name(asdict(each)) for each in found.outputs},
        "residuals": {each.name: _without_name(asdict(each)) for each in found.residuals},
        "held_out": found.split,
        "trajectories": {part: each.ids.tolist() for part, each in measured.items()},
        "rate": logs.trajectories.rate,
        "logs": [asdict(each) for each in logs.trajectories.provenance],
        "notes": list(logs.notes),
        "twin_runs": result.twin_runs,
        "seconds": result.seconds,
        "figures": dict(result.figures),
        "reason": result.reason,
    }
    if isinstance(result, Posterior):
        about["misspecified"] = result.misspecified
    else:
        about["loss"] = result.loss
        about["horizon"] = result.horizon
        about["horizons"] = [
            {**asdict(each), "length": each.length and each.length / about["rate"]}
            for each in result.horizons
        ]
        about["starts"] = [asdict(each) for each in result.starts]
    return to_jsonable_python(about, inf_nan_mode="null", fallback=np.generic.item)


def start_values(twin: ParametricTwin) -> dict[str, float]:
    """Start values of an FMU by name, as FMPy takes them; empty for another kind of twin."""
    inner = twin.twin
    now: Mapping[str, Any] = twin.inner(dict(zip(twin.names, twin.values, strict=True)))
    while isinstance(inner, ParametricTwin):
        own = dict(zip(inner.names, inner.values, strict=True)) | dict(now)
        now, inner = inner.inner(own), inner.twin
    if not isinstance(inner, FMUTwin):
        return {}
    fixed = {name: value for name, value in inner.start.items() if not isinstance(value, str)}
    return {name: float(value) for name, value in {**fixed, **now}.items()}


def _refused(path: Path, twin: ParametricTwin) -> str:
    """Why the case that was written cannot be read back with these values; "" if it can."""
    try:
        again = read_case(path).parametric
    except InputError as error:
        return str(error)
    if again is None or again.names != twin.names or not np.allclose(again.values, twin.values):
        return "the case that was written has other parameters"
    return ""


def _correlations(names: Sequence[str], matrix: Any) -> list[list[Any]]:
    """Pairs of parameters with their correlation, the strongest first."""
    places = ((i, j) for i in range(len(names)) for j in range(i) if np.isfinite(matrix[i, j]))
    pairs = [[names[i], names[j], float(matrix[i, j])] for i, j in places]
    return sorted(pairs, key=lambda each: -abs(each[2]))


def _without_name(values: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key != "name"}


def _write_json(path: Path, values: object) -> None:
    text = json.dumps(values, indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
