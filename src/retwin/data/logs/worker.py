"""The process in which a log is read: it gets a request, and sends signals as frames.

Libraries of log formats have native code, which may crash, hang or take all memory on a damaged or
hostile file. Here that ends this process only, and `reading` says so in one line. A frame is the
length of a JSON text in four bytes, the text, and the bytes of the arrays that it announces.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from retwin.catalog import LOGS, resolve
from retwin.data.logs.signals import Clock, Signal
from retwin.errors import InputError, brief

FRAME = struct.Struct("<I")
"""The length of a frame's text."""
OVERHEAD = 2**29
"""Bytes that the libraries themselves may take."""
CPU_SECONDS, BYTES_PER_CPU_SECOND = 120, 2 * 10**5
"""Processor time that a log may take: a fixed part, and a part by the size of its files. ROS
messages of one number are decoded at 10⁶ bytes per second."""


def main() -> None:
    """Read the log of the request on standard input, and send what is found."""
    request = json.loads(sys.stdin.buffer.read())
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no frame
    warnings.simplefilter("ignore")
    path = Path(request["path"])
    _limit(request["max_bytes"], request["size"])
    try:
        _read(path, request, out)
    except InputError as error:
        _send(out, {"error": [error.argument, error.expected, error.got, error.remedy]})
    except MemoryError:
        _send(out, {"memory": True})
    except BrokenPipeError:
        pass  # nobody waits any more
    except Exception as error:
        _send(out, {"damaged": f"{type(error).__name__}: {brief(error)}"})
    else:
        _send(out, {"done": True})
    with suppress(OSError):
        out.flush()
    os._exit(0)  # native libraries may hang or crash at their end


def _read(path: Path, request: dict[str, Any], out: BinaryIO) -> None:
    read = resolve(LOGS[request["format"]].reader)
    wanted = None if request["wanted"] is None else frozenset(request["wanted"])
    for each in read(path, wanted, Clock(**request["clock"])):
        if not isinstance(each, Signal):
            _send(out, {"skipped": each.name, "reason": each.reason})
            continue
        times = np.ascontiguousarray(each.times, "<i8")
        values = np.ascontiguousarray(each.values, "<f8")
        about = {"name": each.name, "unit": each.unit, "count": len(times)}
        _send(out, {**about, "unreadable": each.unreadable}, times, values)


def _send(out: BinaryIO, about: dict[str, Any], *arrays: np.ndarray) -> None:
    text = json.dumps(about).encode()
    out.write(FRAME.pack(len(text)) + text)
    for each in arrays:
        out.write(each.data)
    out.flush()


def _limit(max_bytes: int, size: int) -> None:
    """Limit memory, written files and processor time of this process, where the system can."""
    try:
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    except (ImportError, OSError, ValueError):
        return
    seconds = CPU_SECONDS + size // BYTES_PER_CPU_SECOND
    for kind, most in (
        (resource.RLIMIT_DATA, used + max_bytes + OVERHEAD),
        (resource.RLIMIT_FSIZE, max_bytes),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_CORE, 0),
    ):
        limit = resource.getrlimit(kind)[1]
        most = most if limit == resource.RLIM_INFINITY else min(most, limit)
        with suppress(ValueError, OSError):
            resource.setrlimit(kind, (min(most, 2**62), limit))
