"""Systems: what a `Case` binds together, case.toml files, and one folder per built-in system.

Belongs here: everything that knows a particular system, its files and its pictures. Not here: the
method, which takes any system. `get` finds a case by its name.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from retwin import catalog
from retwin._lazy import homes, names
from retwin.errors import InputError

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.data.io import DataCase

_HOME = homes(
    {
        "animation": "animate",
        "armpi_fpv.emulator": "EmulatedArmPi",
        "armpi_fpv.recovery": "recover_commands",
        "armpi_fpv.twin": "ArmPiTwin KinematicTwin armpi_parametric",
        "case": "Body Case",
        "columns": "ColumnRecords Record",
        "file": "read_case",
        "logs": "Columns LogReader read_logs",
        "opened_twin": "open_parametric",
        "time_column": "TimeColumn",
    }
)
_CASES = {
    name: entry.target.removeprefix(f"{__name__}.").partition(":")[0]
    for name, entry in catalog.CASES.items()
}

__getattr__, __dir__, __all__ = names(__name__, _HOME | _CASES)
__all__ += ["data_case", "get"]


def get(name: str) -> Case:
    """The case of that name: a built-in one, a file *.toml, or a user's `package.module:object`.

    Raises InputError when there is none, and for a file that `read_case` refuses.
    """
    from retwin.cases.case import Case
    from retwin.cases.file import read_case
    from retwin.twins.twin import Twin

    if Path(name).suffix.lower() == ".toml":
        return read_case(name)
    target = catalog.CASES[name].target if name in catalog.CASES else name
    got, remedy = "no such case", "check the spelling, or that the file or module is there"
    if ":" in target:
        try:
            found = catalog.resolve(target)
        except (ImportError, AttributeError, ValueError) as error:
            got = str(error)
        else:
            # A twin of state equations can be called too, with commands.
            found = found() if callable(found) and not isinstance(found, Twin) else found
            if isinstance(found, Case):
                return found
            got = f"a {type(found).__name__}"
            if isinstance(found, Twin):
                remedy = f"retwin identify {name} LOG --out FOLDER writes the case of a twin: "
                remedy += "FOLDER/updated.toml"
    expected = f"{', '.join(catalog.CASES)}, a file *.toml, or package.module:object naming a "
    expected += "Case"
    raise InputError(f"case {name!r}", expected=expected, got=got, remedy=remedy)


def data_case(name: str) -> DataCase:
    """What files of that case's trajectories need of it; for a built-in case without torch.

    Raises as `get` does.
    """
    if name in catalog.CASES:
        return catalog.resolve(catalog.CASES[name].recorded)
    return get(name)
