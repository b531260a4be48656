"""`updated_case`: a case.toml in which a twin has other values of its parameters."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from retwin.cases.named_twin import FILES
from retwin.cases.opened_twin import OpenedTwin
from retwin.twins.parametric import ParametricTwin

__all__ = ["updated_case"]

HEADER = """\
# Written by retwin identify. Each start is an identified value; low and high are the range in which
# it was searched. Every command takes this file as its CASE.
"""


def updated_case(
    opened: OpenedTwin, twin: ParametricTwin, folder: str | os.PathLike[str], commands: str
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
        lines.append(f"based_on = {_text(base)}")
    else:
        source = Path(opened.name)
        is_file = source.suffix.lower() in FILES
        home = (source.resolve().parent if is_file else Path.cwd()).resolve()
        stem = source.stem if is_file else opened.name.rpartition(":")[2]
        lines += [
            f"name = {_text(stem)}",
            f"title = {_text(f'{source.name}, identified')}",
            f"folder = {_text(_relative(home, place))}",
            f"twin = {_text(source.name if is_file else opened.name)}",
            *_channels(opened, twin, is_file=is_file),
            "",
            "[commands]",
            f"file = {_text(commands)}",
        ]
    lines += ["", "[parameters]"]
    for each, value in zip(twin.parameters, twin.values, strict=True):
        start = min(max(value, each.low), each.high)
        settings = f"low = {each.low!r}, high = {each.high!r}, start = {start!r}"
        lines.append(f"{_text(each.name)} = {{ unit = {_text(each.unit)}, {settings} }}")
    return "\n".join(lines) + "\n"


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
        listed = ", ".join(map(_text, names))
        tables = ", ".join(f"{_text(each)} = {{}}" for each in names)
        lines.append(f"{name} = " + (f"[{listed}]" if is_file else f"{{ {tables} }}"))
    return lines


def _relative(path: Path, start: Path) -> str:
    """`path` as seen from `start`, with slashes; absolute where there is no such way."""
    try:
        return Path(os.path.relpath(path, start)).as_posix()
    except ValueError:  # on another drive of Windows
        return path.as_posix()


def _text(text: str) -> str:
    """A string of TOML, whose escapes are those of JSON."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
