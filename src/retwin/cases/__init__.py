"""Cases: what one system binds together. The only place that knows a robot."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from retwin.case import Case
from retwin.cases.armpi import armpi
from retwin.cases.tanks import tanks
from retwin.errors import InputError

__all__ = ["armpi", "get", "tanks"]

_BUILT_IN: dict[str, Callable[[], Case]] = {"armpi": armpi, "tanks": tanks}


def get(name: str) -> Case:
    """The case of that name: a built-in one, or a user's `package.module:object`.

    Raises InputError when there is none.
    """
    if name in _BUILT_IN:
        return _BUILT_IN[name]()
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
        expected=f"{', '.join(_BUILT_IN)}, or package.module:object naming a Case",
        got=got,
        remedy="check the spelling, or that the module can be imported",
    )
