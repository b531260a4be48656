"""The C compiler: C99 source as functions of arrays.

Belongs here: finding a compiler, compiling once per machine, calls. Not here: C source, which lies
beside the modules that describe the same in torch; `kernel.h` stands above it.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from importlib.resources import files
from importlib.util import find_spec
from itertools import pairwise, product
from pathlib import Path
from typing import TypeVar

from numpy.typing import NDArray

from retwin.errors import brief
from retwin.workers.threads import available, in_threads

T = TypeVar("T")
FLAGS = ("-std=c99", "-O3", "-ffp-contract=off", "-fPIC", "-shared")
"""Without contraction and reassociation, results are those of torch up to single roundings."""
NATIVE = "-march=native"
"""For all instructions of this processor, which not every compiler can find out."""
COMPILED = 64
"""Number of models whose compiled form is kept in this process."""
TIMEOUT = 120
"""Longest time in s that a compiler may take; the first run of zig builds its own library."""


def c_source(package: str, *names: str) -> str:
    """The text of C files that lie beside the modules of a package, one after the other."""
    folder = files(package)
    return "\n".join((folder / name).read_text("utf-8") for name in names)


def compilers() -> Iterator[list[str]]:
    """Commands of the C compilers that are installed: `CC`, the system's, or the one of PyPI."""
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        found = shutil.which(name) if name else None
        if found:
            yield [found]
    if find_spec("ziglang"):
        yield [sys.executable, "-m", "ziglang", "cc"]


def try_compilers(
    make: Callable[[tuple[str, ...]], T], *flags: Sequence[str]
) -> tuple[T | None, str]:
    """What `make` returns for the first compiler and flags with which it raises no OSError.

    Without one, None, and the reasons of all.
    """
    reasons = []
    for command, own in product(compilers(), flags):
        try:
            return make((*command, *own)), ""
        except OSError as error:
            reasons.append(f"{command[0]}: {brief(error)}")
    return None, "; ".join(reasons)


@lru_cache(maxsize=COMPILED)
def compiled_files(package: str, *names: str, contract: bool = False) -> ctypes.CDLL | None:
    """The functions of C files in a package, compiled together; None without a C compiler.

    The files need no declarations: `kernel.h` stands above them. `contract` is that of `compiled`.
    """
    source = c_source(__package__, "kernel.h") + c_source(package, *names)
    return compiled(source, contract=contract, quiet=True)


@lru_cache(maxsize=COMPILED)
def compiled(source: str, *, contract: bool = False, quiet: bool = False) -> ctypes.CDLL | None:
    """The functions of a C99 source; None, with a warning, where no compiler can make them.

    Libraries are kept in the user's cache folder, so that each is compiled once per machine.

    Parameters
    ----------
    source : str
        See `Model.source`.
    contract : bool
        Whether a product and a sum may be rounded once, which is faster: results are then not those
        of torch to the last digit.
    quiet : bool
        Whether the warning is left out.

    Returns
    -------
    CDLL or None
        The loaded library, kept for as long as this process needs it.

    """
    flags = [*FLAGS, "-ffp-contract=fast"] if contract else [*FLAGS]
    made, reasons = try_compilers(partial(_library, source), [*flags, NATIVE], flags)
    if made is None and not quiet:
        warnings.warn(
            "the model runs in torch, some thousand times slower, since there is no C compiler "
            f"({reasons or 'none is installed'}); install one, or retwin[compiled]",
            stacklevel=2,
        )
    return made


def build(command: Sequence[str], source: Path, library: Path) -> None:
    """Compile a file with a compiler and its flags; an OSError says why it fails."""
    given = [*command, str(source), "-o", str(library), "-lm"]
    try:
        subprocess.run(given, check=True, capture_output=True, timeout=TIMEOUT, text=True)
    except subprocess.CalledProcessError as error:
        raise OSError((error.stderr or "failed").strip().splitlines()[0]) from None
    except subprocess.TimeoutExpired as error:
        raise OSError(error) from None


def _library(source: str, command: tuple[str, ...]) -> ctypes.CDLL:
    """The library that a compiler makes of a source, from the cache if it has made it before."""
    kept = _kept(source, command)
    if kept is not None and _own(kept):
        try:
            return ctypes.CDLL(str(kept))
        except OSError:  # it is damaged, or from another system
            kept.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        file, library = Path(folder, "model.c"), Path(folder, "model.so")
        file.write_text(source, "utf-8")
        build(command, file, library)
        loaded = ctypes.CDLL(str(library))
        if kept is not None:
            with suppress(OSError):  # a cache that cannot be written is no reason to fail
                kept.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                part = kept.with_suffix(f".{os.getpid()}")
                shutil.copyfile(library, part)
                part.replace(kept)
        return loaded


def _kept(source: str, command: tuple[str, ...]) -> Path | None:
    """Where the library is kept, by all that its code depends on; None without a home folder."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        made = Path(command[0]).stat()
    except (OSError, RuntimeError):
        return None
    parts = (source, *command, str(made.st_mtime_ns), str(made.st_size), _instructions())
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    return Path(home, "retwin", "compiled", f"{name}.so")


@lru_cache(maxsize=1)
def _instructions() -> str:
    """What this processor can execute, which the native code depends on."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return f"{platform.machine()} {platform.processor()} {platform.node()}"
    names = ("flags", "model name", "Features", "cpu family", "model\t")
    return "\n".join(sorted({line for line in text.splitlines() if line.startswith(names)}))


def _own(file: Path) -> bool:
    """Whether a file, and its folder, are this user's, and nobody else can write to them."""
    try:
        about = [each.stat() for each in (file, file.parent)]
    except OSError:
        return False
    user = getattr(os, "getuid", lambda: about[0].st_uid)()
    return all(each.st_uid == user and not each.st_mode & 0o022 for each in about)


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
        Arrays of all trajectories, of the types and shapes that the C source gives, contiguous.
    rows : sequence of NDArray or None
        Those with a first axis of n; None is NULL.

    """
    function = getattr(library, name)
    function.restype = None
    count = max(1, min(sizes[0], available()))
    ends = [sizes[0] * i // count for i in range(count + 1)]

    def part(first: int, last: int) -> None:
        own = (None if each is None else each[first:last] for each in rows)
        function(
            *map(ctypes.c_longlong, (last - first, *sizes[1:])),
            ctypes.c_double(period),
            *(ctypes.c_void_p(None if a is None else a.ctypes.data) for a in (*common, *own)),
        )

    for _ in in_threads(lambda ends: part(*ends), list(pairwise(ends))):
        pass
