"""Modules of users, imported by their path.

A folder on Python's search path would offer all its files: a `zarr.py` beside a case would stand in
for an optional package that is not installed. Here a module alone is found, in this process and in
its worker processes.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import find_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType


def import_beside(name: str, folder: Path) -> ModuleType:
    """The module of that name: an installed one, or else the one in `folder`.

    While a module in the folder is executed, it may import others beside it.

    Parameters
    ----------
    name : str
        The module, with dots for one in a package.
    folder : Path
        Where the module or its package may be.

    Returns
    -------
    module
        The module.

    Raises
    ------
    ImportError
        There is none. Exceptions of the module itself are passed on.

    """
    top = name.partition(".")[0]
    if top and top not in sys.modules:
        _FINDER.paths.pop(top, None)
        spec = find_spec(top)
        # A folder on the path is a package without __init__.py, which any module goes before.
        if spec is None or not spec.origin:
            package, module = folder.resolve() / top, folder.resolve() / f"{top}.py"
            candidates = (package / "__init__.py", module, *[package] * (spec is None))
            found = next((each for each in candidates if each.exists()), None)
            if found is not None:
                _FINDER.paths[top] = str(found)
    return importlib.import_module(name)


def known() -> dict[str, str]:
    """The path of each module that was found in a folder, by its name."""
    return dict(_FINDER.paths)


def add_known(paths: Mapping[str, str]) -> None:
    """Find these modules, which another process found, in this one too."""
    _FINDER.paths.update(paths)


class _Finder(MetaPathFinder):
    """Finds modules by their paths; asked first, before a folder of that name is taken."""

    def __init__(self) -> None:
        self.paths: dict[str, str] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module of that name, if its path is known."""
        if fullname not in self.paths:
            return None
        file = Path(self.paths[fullname])
        if file.is_dir():  # a package without __init__.py
            spec = ModuleSpec(fullname, None, is_package=True)
            spec.submodule_search_locations = [str(file)]
            return spec
        inside = [str(file.parent)] if file.name == "__init__.py" else None
        return spec_from_file_location(
            fullname, file, loader=_Loader(fullname, str(file)), submodule_search_locations=inside
        )


class _Loader(SourceFileLoader):
    """Executes a module that may import others beside it, which are then known too."""

    def exec_module(self, module: ModuleType) -> None:
        """Execute the module."""
        file = Path(self.path)
        folder = file.parent.parent if file.name == "__init__.py" else file.parent
        before = set(sys.modules)
        sys.path.append(str(folder))
        try:
            super().exec_module(module)
        finally:
            sys.path.remove(str(folder))
            for name in set(sys.modules) - before:
                other = getattr(sys.modules[name], "__file__", None)
                if "." not in name and other and Path(other).is_relative_to(folder):
                    _FINDER.paths[name] = other


_FINDER = _Finder()
sys.meta_path.insert(0, _FINDER)
