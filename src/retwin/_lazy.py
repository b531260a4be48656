"""Names of a package whose modules are imported when they are first used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any


def homes(modules: Mapping[str, str]) -> dict[str, str]:
    """Public name to module, from each module and its public names, with blanks between."""
    found = {name: module for module, listed in modules.items() for name in listed.split()}
    return dict(sorted(found.items()))


def read_stub(stub: str) -> dict[str, str]:
    """Public name to module, from the text of a stub with `from MODULE import NAME as NAME`."""
    lines = (line.split() for line in stub.splitlines())
    return {words[3]: words[1] for words in lines if words[:1] == ["from"]}


def names(
    package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """A module's `__getattr__`, `__dir__` and `__all__`.

    Parameters
    ----------
    package : str
        The package; its submodules are attributes too.
    homes : mapping
        Public name to the module that defines it, below the package.

    """

    def attribute(name: str) -> Any:
        if name in homes:
            try:
                return getattr(importlib.import_module(f"{package}.{homes[name]}"), name)
            except ModuleNotFoundError as error:
                from retwin.checks import install_command  # it needs numpy

                error.add_note(f"install what retwin needs: {install_command()}")
                raise
        if name.startswith("_") or find_spec(f"{package}.{name}") is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return importlib.import_module(f"{package}.{name}")

    def listing() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return attribute, listing, sorted(homes)
