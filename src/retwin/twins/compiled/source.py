"""C files that lie beside the modules of a package."""

from __future__ import annotations

from importlib.resources import files

__all__ = ["c_source"]


def c_source(package: str, *names: str) -> str:
    """The text of C files of a package, one after the other."""
    folder = files(package)
    return "\n".join((folder / name).read_text("utf-8") for name in names)
