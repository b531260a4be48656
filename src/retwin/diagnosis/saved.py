"""`load_diagnoser`: any diagnoser that was saved, whatever its kind."""

from __future__ import annotations

from pathlib import Path

from retwin.diagnosis.inversion import InversionDiagnoser
from retwin.diagnosis.network import NetworkDiagnoser
from retwin.diagnosis.rocket import RocketDiagnoser
from retwin.serialisation.models import kind_of

__all__ = ["load_diagnoser"]

Saved = NetworkDiagnoser | InversionDiagnoser | RocketDiagnoser


def load_diagnoser(folder: str | Path) -> Saved:
    """The diagnoser of a folder; InputError when it holds none, or a damaged one."""
    match kind_of(folder):
        case "inversion":
            return InversionDiagnoser.load(folder)
        case "rocket":
            return RocketDiagnoser.load(folder)
        case _:  # another kind of model, or none: this one says what is wrong
            return NetworkDiagnoser.load(folder)
