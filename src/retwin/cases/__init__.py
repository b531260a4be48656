"""Cases: what one system binds together. The only place that knows a robot."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

from retwin.case import Case
from retwin.cases.armpi import armpi
from retwin.cases.columns import ColumnRecords
from retwin.cases.file import read_case
from retwin.cases.tanks import tanks, tanks_overflow
from retwin.errors import InputError

__all__ = ["ColumnRecords", "armpi", "get", "read_case", "tanks", "tanks_overflow"]

_BUILT_IN: dict[str, Callable[[], Case]] = {
    "armpi": armpi,
    "tanks": tanks,
    "tanks_overflow": tanks_overflow,
}


def get(name: str) -> Case:
    """The case of that name: a built-in one, a file *.toml, or a user's `package.module:object`.

    Raises InputError when there is none, and for a file that is not as `read_case` wants it.
    """
    if name in _BUILT_IN:
        return _BUILT_IN[name]()
    if Path(name).suffix.lower() == ".toml":
        return read_case(name)
    module, _, attribute = name.partition(":")
    got = "no such case"
    if attribute:
        try:
            found = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            got = str(error)
        else:
            if callable(found):
                found = found()
            if isinstance(found, Case):
                return found
            got = f"a {type(found).__name__}"
    raise InputError(
        f"case {name!r}",
        expected=f"{', '.join(_BUILT_IN)}, a file *.toml, or package.module:object naming a Case",
        got=got,
        remedy="check the spelling, or that the file or module is there",
    )
