"""`log_case`: what a log is mapped to, the channels of a case or of the file of a twin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from retwin import cases, twins
from retwin.data.io import DataCase
from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.twins import FILES

__all__ = ["TwinData", "log_case"]


@dataclass(frozen=True)
class TwinData:
    """The channels of a twin without a case, as a `DataCase`.

    Attributes
    ----------
    inputs, outputs : Channels
        Those of the twin.
    rate : float
        0: an FMU or a model has no sample rate of its own, and takes that of the log.
    classes : tuple of str
        None are known.

    """

    inputs: Channels
    outputs: Channels
    rate: float = 0.0
    classes: tuple[str, ...] = ()

    def complete(
        self, trajectories: Trajectories, *, progress: Progress | None = None
    ) -> Trajectories:
        """The same trajectories: commands are those of the file."""
        return trajectories


def log_case(name: str) -> DataCase:
    """The case of that name, or the channels of a twin: `*.fmu`, `*.xml`, `*.urdf`.

    Raises InputError where there is none.
    """
    if Path(name).suffix.lower() not in FILES:
        return cases.data_case(name)
    twin = twins.get(name)
    return TwinData(twin.inputs, twin.outputs)
