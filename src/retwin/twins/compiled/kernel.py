"""The C compiler: a model's C99 source as a function of arrays."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import torch
from numpy.typing import NDArray

__all__ = ["call", "compiled", "compilers"]

FLAGS = ("-std=c99", "-O3", "-ffp-contract=off", "-fPIC", "-shared")
"""Without contraction and reassociation, results are those of torch up to single roundings."""
NATIVE = "-march=native"
"""For all instructions of this processor, which not every compiler can find out."""
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
    for command, native in product(compilers(), ([NATIVE], [])):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            file, library = Path(folder, "model.c"), Path(folder, "model.so")
            file.write_text(source, "utf-8")
            try:
                subprocess.run(
                    [*command, *FLAGS, *native, str(file), "-o", str(library), "-lm"],
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
    library: ctypes.CDLL,
    name: str,
    sizes: tuple[int, ...],
    period: float,
    common: Sequence[NDArray],
    rows: Sequence[NDArray | None],
) -> None:
    """Call a function of a model, for all trajectories.

    They are divided between the threads of torch, which changes no result.

    Parameters
    ----------
    library : CDLL
        See `compiled`.
    name : str
        The function.
    sizes : tuple of int
        The number n of trajectories, and the other sizes.
    period : float
        The sample period in s.
    common : sequence of NDArray
        Double arrays of all trajectories, of the shapes that `simulate.c` gives, contiguous.
    rows : sequence of NDArray or None
        Those with a first axis of n; None is NULL.

    """
    function = getattr(library, name)
    function.restype = None
    count = max(1, min(sizes[0], torch.get_num_threads()))
    ends = [sizes[0] * i // count for i in range(count + 1)]

    def part(first: int, last: int) -> None:
        own = (None if each is None else each[first:last] for each in rows)
        function(
            *map(ctypes.c_longlong, (last - first, *sizes[1:])),
            ctypes.c_double(period),
            *(ctypes.c_void_p(None if a is None else a.ctypes.data) for a in (*common, *own)),
        )

    if count == 1:
        part(0, sizes[0])
        return
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(part, ends[:-1], ends[1:]))
