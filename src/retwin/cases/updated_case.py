"""`updated_case`: a case.toml in which a twin has other values of its parameters."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from retwin.cases.named_twin import FILES
from retwin.cases.opened_twin import OpenedTwin
from retwin.data.segments import Segments
from retwin.data.trajectories import Trajectories
from retwin.serialisation.configs import toml_text
from retwin.twins.parametric import ParametricTwin
from retwin.twins.record_sampler import moves_and_rests
from retwin.update.dynamics import state_names

HEADER = """\
# Written by retwin identify. Each start is an identified value; low and high are the range in which
# it was searched. Every command takes this file as its CASE.
"""
STEP = 2
"""Samples within which a command that moves is a step, and no ramp."""
SUFFICIENT = 0.1
"""Error of learned state equations, over the discrepancy of the twin, that is small beside it: the
root mean square of both together is 0.5 % larger."""
STATE_EQUATIONS = (
    "For retwin fit --dynamics: the state equations, which the twin does not show, are learned "
    "from simulations until their error is this share of the twin's discrepancy in the logs. These "
    "draw each parameter from this share of its range about its start, five times as wide as "
    "its interval or more: the smaller it is, the easier the equations are learned."
)


def updated_case(
    opened: OpenedTwin,
    twin: ParametricTwin,
    folder: str | os.PathLike[str],
    commands: str,
    measured: Trajectories | None = None,
    spread: float = 1.0,
) -> str:
    """The text of a case.toml for a twin with identified parameters.

    Parameters
    ----------
    opened : OpenedTwin
        The twin as it was opened. That of a case gives a file that is based on the case.
    twin : ParametricTwin
        The same twin at the identified values.
    folder : path
        The folder in which the file will lie; other files are named relative to it.
    commands : str
        The name of a file of trajectories in that folder, from whose commands those of a twin
        without a case are drawn.
    measured : Trajectories, optional
        The trajectories in that file; their commands decide about the correction of a twin without
        a case.
    spread : float, default 1
        Share of the ranges, about the values, over which `fit_state_surrogate` draws parameters.

    Returns
    -------
    str
        TOML.

    """
    place = Path(folder).resolve()
    lines = [HEADER]
    if opened.case is not None:
        base = opened.name
        if Path(base).suffix.lower() == ".toml":
            base = _relative(Path(base).resolve(), place)
        lines.append(f"based_on = {toml_text(base)}")
    else:
        source = Path(opened.name)
        is_file = source.suffix.lower() in FILES
        home = (source.resolve().parent if is_file else Path.cwd()).resolve()
        stem = source.stem if is_file else opened.name.rpartition(":")[2]
        lines += [
            f"name = {toml_text(stem)}",
            f"title = {toml_text(f'{source.name}, identified')}",
            f"folder = {toml_text(_relative(home, place))}",
            f"twin = {toml_text(source.name if is_file else opened.name)}",
            *_channels(opened, twin, is_file=is_file),
            "",
            "[commands]",
            f"file = {toml_text(commands)}",
        ]
        if measured is not None:
            # Keys of the case come before its tables.
            place_of_tables = lines.index("[commands]") - 1
            lines[place_of_tables:place_of_tables] = _correction(measured)
        if not state_names(twin):
            lines += ["", *_comment(STATE_EQUATIONS), "[state_surrogate]"]
            lines += [f"sufficient = {SUFFICIENT}", f"spread = {spread:.2g}"]
    lines += ["", "[parameters]"]
    for each, value in zip(twin.parameters, twin.values, strict=True):
        start = min(max(value, each.low), each.high)
        settings = f"low = {each.low!r}, high = {each.high!r}, start = {start!r}"
        lines.append(f"{toml_text(each.name)} = {{ unit = {toml_text(each.unit)}, {settings} }}")
    return "\n".join(lines) + "\n"


def _correction(measured: Trajectories) -> list[str]:
    """The default correction for the commands of logs, with the reason.

    A delay and an offset per segment suit commands that move in ramps and then rest, as those of a
    robot do. Steps and continuous excitation show the dynamics between, which have a residual in
    each sample.
    """
    segments = Segments.from_commands(measured.commands).until(measured.lengths)
    ramps = (segments.settle - segments.start)[segments.valid]
    if moves_and_rests(segments) and np.median(ramps) > STEP:
        text = (
            "The commands of the logs move in ramps and rest: a correction of the outputs has a "
            "delay and an offset per segment. retwin fit compares it with others."
        )
        return [*_comment(text), 'correction = "delay_offset"']
    kind = "change in steps" if moves_and_rests(segments) else "change all the time"
    text = (
        f"The commands of the logs {kind}: a correction of the outputs has a residual of each "
        "sample. retwin fit compares it with others; --dynamics corrects the state equations, "
        "which leave an FMU as another one."
    )
    return [*_comment(text), 'correction = "additive"']


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, 98, initial_indent="# ", subsequent_indent="# ")


def _channels(opened: OpenedTwin, twin: ParametricTwin, *, is_file: bool) -> list[str]:
    """Rate and channels of a twin that does not have its own, as a file or a function."""
    if not is_file and opened.own_channels:
        return []
    lines = [f"rate = {float(twin.rate)!r}"]
    inner: Any = twin
    while isinstance(inner, ParametricTwin):
        inner = inner.twin
    # A sensor of a robot model may have several channels.
    outputs = getattr(inner, "sensors", twin.outputs.names)
    for name, names in (("inputs", twin.inputs.names), ("outputs", outputs)):
        listed = ", ".join(map(toml_text, names))
        tables = ", ".join(f"{toml_text(each)} = {{}}" for each in names)
        lines.append(f"{name} = " + (f"[{listed}]" if is_file else f"{{ {tables} }}"))
    return lines


def _relative(path: Path, start: Path) -> str:
    """`path` as seen from `start`, with slashes; absolute where there is no such way."""
    try:
        return Path(os.path.relpath(path, start)).as_posix()
    except ValueError:  # on another drive of Windows
        return path.as_posix()
