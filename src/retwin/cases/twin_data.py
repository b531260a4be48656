"""`log_case`: what a log is mapped to, the channels of a case or of a twin that is none."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from retwin import cases, catalog, twins
from retwin.checks import nothing, require
from retwin.data.io import DataCase
from retwin.data.logs.mapping import Mapping, read_mapping
from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.twins import FILES
from retwin.twins.twin import Twin


@dataclass(frozen=True)
class TwinData:
    """The channels of a twin without a case, as a `DataCase`.

    Attributes
    ----------
    inputs, outputs : Channels
        Those of the twin.
    rate : float
        Its sample rate in Hz; 0 for an FMU, a model or a function, which has none of its own and
        takes that of the log.
    classes : tuple of str
        None are known, so that any are taken.
    twin : Twin or None
        The twin itself, where it has a sample rate.

    """

    inputs: Channels
    outputs: Channels
    rate: float = 0.0
    classes: tuple[str, ...] = ()
    twin: Twin | None = None

    def measured(self, mapping: Mapping) -> TwinData:
        """The same with those of its outputs that a mapping has."""
        pairs = zip(self.outputs.names, self.outputs.units, strict=True)
        kept = [pair for pair in pairs if pair[0] in mapping.outputs]
        if not kept:  # other names, which reading refuses
            return self
        names, units = zip(*kept, strict=True)
        return replace(self, outputs=Channels(names, units))

    def complete(
        self, trajectories: Trajectories, *, progress: Progress | None = None
    ) -> Trajectories:
        """The same trajectories: commands are those of the file."""
        return trajectories


def log_case(
    name: str,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    *,
    mapping: str | os.PathLike[str] | None = None,
    rate: float | None = None,
) -> DataCase:
    """The case of that name, or the channels of a twin that is none.

    Parameters
    ----------
    name : str
        A built-in case, `case.toml`, `*.fmu`, `*.xml`, `*.urdf`, `module:object` naming a case or a
        twin, or `module:function`.
    inputs, outputs : sequence of str
        Names of the channels: those of a function, or some of a file's.
    mapping : path, optional
        A mapping.toml; of a twin that is no case, outputs that it lacks are left out.
    rate : float, optional
        The sample rate of the log in Hz, for a twin that has none of its own.

    Raises
    ------
    InputError
        There is none, a function without names of its channels, or names for what has its own.

    """
    is_file = Path(name).suffix.lower() in FILES
    found = _object(name) if ":" in name and not is_file else None
    if not is_file and (":" not in name or _is_case(found)):
        expected = "none of them, since the case has its own"
        nothing("inputs, outputs", (*inputs, *outputs), expected, remedy="leave them out")
        return cases.data_case(name)
    # A function has no rate of its own, and its channels do not depend on it.
    function = twins.takes_commands(found)
    require(
        not function or (inputs and outputs),
        "--inputs, --outputs",
        expected="the names of the channels, which a function does not have",
        got=f"inputs {', '.join(inputs) or 'none'}, outputs {', '.join(outputs) or 'none'}",
        remedy="name both, joined by commas",
    )
    free = is_file or function
    twin = twins.get(name, inputs=inputs, outputs=outputs, rate=rate or (1.0 if function else None))
    known = not free or rate is not None
    made = TwinData(
        twin.inputs, twin.outputs, twin.rate if known else 0.0, twin=twin if known else None
    )
    return made if mapping is None else made.measured(read_mapping(mapping))


def _object(name: str) -> Any:
    """What a name `module:object` stands for; None if there is none, which `get` refuses."""
    try:
        return twins.made_by(catalog.resolve(name))
    except (ImportError, AttributeError, ValueError):
        return None


def _is_case(found: Any) -> bool:
    from retwin.cases.case import Case  # which needs torch

    return isinstance(found, Case)
