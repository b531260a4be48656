"""Systems: what a `Case` binds together, case.toml files, and one folder per built-in system.

Belongs here: everything that knows a particular system, its files and its pictures. Not here: the
method, which takes any system. `get` finds a case by its name.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from retwin import catalog
from retwin.errors import InputError

if TYPE_CHECKING:
    from retwin.cases.armpi_fpv.case import armpi
    from retwin.cases.cascaded_tanks.case import tanks, tanks_overflow
    from retwin.cases.case import Case
    from retwin.cases.columns import ColumnRecords
    from retwin.cases.file import read_case

__all__ = ["ColumnRecords", "armpi", "get", "read_case", "tanks", "tanks_overflow"]

_TARGETS = {
    "ColumnRecords": "retwin.cases.columns:ColumnRecords",
    "read_case": "retwin.cases.file:read_case",
    **{name: entry.target for name, entry in catalog.CASES.items()},
}


def __getattr__(name: str) -> Any:
    if name in _TARGETS:
        return catalog.resolve(_TARGETS[name])
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def get(name: str) -> Case:
    """The case of that name: a built-in one, a file *.toml, or a user's `package.module:object`.

    Raises InputError when there is none, and for a file that `read_case` refuses.
    """
    from retwin.cases.case import Case
    from retwin.cases.file import read_case

    if Path(name).suffix.lower() == ".toml":
        return read_case(name)
    target = catalog.CASES[name].target if name in catalog.CASES else name
    got = "no such case"
    if ":" in target:
        try:
            found = catalog.resolve(target)
        except (ImportError, AttributeError, ValueError) as error:
            got = str(error)
        else:
            found = found() if callable(found) else found
            if isinstance(found, Case):
                return found
            got = f"a {type(found).__name__}"
    raise InputError(
        f"case {name!r}",
        expected=f"{', '.join(catalog.CASES)}, a file *.toml, or package.module:object naming a "
        "Case",
        got=got,
        remedy="check the spelling, or that the file or module is there",
    )
