"""`updated_case`: a case.toml in which a twin has other values of its parameters."""

from __future__ import annotations

import os
import textwrap
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined

from retwin.cases.named_signals import Columns, LogSettings
from retwin.cases.opened_twin import OpenedTwin
from retwin.data.segments import Segments
from retwin.data.trajectories import Trajectories
from retwin.serialisation.configs import toml_text
from retwin.twins import FILES
from retwin.twins.commands.record_sampler import moves_and_rests
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.dynamics import state_names

STEP = 2
"""Samples within which a command that moves is a step, and no ramp."""
SUFFICIENT = 0.1
"""Error of learned state equations, over the discrepancy of the twin, that is small beside it: the
root mean square of both together is 0.5 % larger."""


def updated_case(
    opened: OpenedTwin,
    twin: ParametricTwin,
    folder: str | os.PathLike[str],
    commands: str,
    measured: Trajectories | None = None,
    spread: float = 1.0,
    columns: Columns = Columns(),  # noqa: B008 - frozen
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
    columns : Columns
        How the logs name the channels. A built-in case has names of its own.

    Returns
    -------
    str
        TOML.

    """
    place, source = Path(folder).resolve(), Path(opened.name)
    base = "" if opened.case is None else opened.name
    if Path(base).suffix.lower() == ".toml":
        base = _relative(Path(base).resolve(), place)
    is_file = source.suffix.lower() in FILES
    home = (source.resolve().parent if is_file else Path.cwd()).resolve()
    made = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    lines = partial(textwrap.fill, width=98, initial_indent="# ", subsequent_indent="# ")
    made.filters |= {"toml": toml_text, "comment": lambda text: f"{lines(text)}\n"}
    template = resources.files(__package__).joinpath("updated.toml.j2").read_text("utf-8")
    values = zip(twin.parameters, twin.values, strict=True)
    return made.from_string(template).render(
        base=base,
        stem=source.stem if is_file else opened.name.rpartition(":")[2],
        source=source.name,
        home=_relative(home, place),
        name=source.name if is_file else opened.name,
        is_file=is_file,
        twin=twin,
        channels=_channels(twin) if is_file or not opened.own_channels else {},
        moving="" if measured is None else _describe_motion(measured),
        commands=commands,
        shows_states=bool(state_names(twin)),
        sufficient=SUFFICIENT,
        spread=spread,
        logs={key: value for key, value in vars(LogSettings.of(columns)).items() if value},
        parameters=[(each, min(max(value, each.low), each.high)) for each, value in values],
    )


def _describe_motion(measured: Trajectories) -> str:
    """How the commands of logs change: "in ramps" and rest, "in steps", or "all the time".

    A delay and an offset per segment suit commands that move in ramps and then rest, as those of a
    robot do. Steps and continuous excitation show the dynamics between, which have a residual in
    each sample.
    """
    segments = Segments.from_commands(measured.commands).until(measured.lengths)
    if not moves_and_rests(segments):
        return "all the time"
    ramps = (segments.settle - segments.start)[segments.valid]
    return "in ramps" if np.median(ramps) > STEP else "in steps"


def _channels(twin: ParametricTwin) -> dict[str, tuple[str, ...]]:
    """Names of the channels of a twin that does not have its own, as a file or a function."""
    inner: Any = twin
    while isinstance(inner, ParametricTwin):
        inner = inner.twin
    # A sensor of a robot model may have several channels.
    outputs = getattr(inner, "sensors", twin.outputs.names)
    return {"inputs": twin.inputs.names, "outputs": outputs}


def _relative(path: Path, start: Path) -> str:
    """`path` as seen from `start`, with slashes; absolute where there is no such way."""
    try:
        return Path(os.path.relpath(path, start)).as_posix()
    except ValueError:  # on another drive of Windows
        return path.as_posix()
