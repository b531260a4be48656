"""The C compiler: a model's C99 source as a function of arrays."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from numpy.typing import NDArray

__all__ = ["call", "compiled", "compilers"]

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""Without contraction and reassociation, results are those of torch up to single roundings."""
COMPILED = 64
"""Number of models whose compiled form is kept in this process."""
TIMEOUT = 120
"""Longest time in s that a compiler may take; the first run of zig builds its own library."""


def compilers() -> Iterator[list[str]]:
    """Commands of the C compilers that are installed: `CC`, the system's, or the one of PyPI."""
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        found = shutil.which(name) if name else None
        if found:
            yield [found]
    if find_spec("ziglang"):
        yield [sys.executable, "-m", "ziglang", "cc"]


@lru_cache(maxsize=COMPILED)
def compiled(source: str) -> ctypes.CDLL | None:
    """The functions of a C99 source; None, with a warning, where no compiler can make them.

    Parameters
    ----------
    source : str
        See `Model.source`.

    Returns
    -------
    CDLL or None
        The loaded library, kept for as long as this process needs it.

    """
    reasons = []
    for command in compilers():
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            file, library = Path(folder, "model.c"), Path(folder, "model.so")
            file.write_text(source, "utf-8")
            try:
                subprocess.run(
                    [*command, *FLAGS, str(file), "-o", str(library), "-lm"],
                    check=True,
                    capture_output=True,
                    timeout=TIMEOUT,
                    text=True,
                )
                return ctypes.CDLL(str(library))
            except subprocess.CalledProcessError as error:
                reasons.append(
                    f"{command[0]}: {(error.stderr or 'failed').strip().splitlines()[0]}"
                )
            except (OSError, subprocess.TimeoutExpired) as error:
                reasons.append(f"{command[0]}: {error}")
    warnings.warn(
        "the model runs in torch, some thousand times slower, since there is no C compiler "
        f"({'; '.join(reasons) or 'none is installed'}); install one, or retwin[compiled]",
        stacklevel=2,
    )
    return None


def call(
    library: ctypes.CDLL, name: str, sizes: tuple[int, ...], period: float, *arrays: NDArray | None
) -> None:
    """Call a function of a model with its sizes, the sample period in s, and double arrays.

    The arrays must be contiguous and of the shapes that `simulate.c` gives; None is NULL.
    """
    function = getattr(library, name)
    function.restype = None
    function(
        *map(ctypes.c_longlong, sizes),
        ctypes.c_double(period),
        *(ctypes.c_void_p(None if each is None else each.ctypes.data) for each in arrays),
    )
