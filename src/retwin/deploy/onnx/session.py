"""A graph as a function of named arrays, within a share of the free memory."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.serialisation.files import refusing
from retwin.serialisation.sizes import Budget

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

EXPECTED = "a graph that retwin export onnx wrote"
TIMEOUT, TIMEOUT_PER_ROW = 60.0, 0.1
"""Longest duration in s of a run, and what each trajectory adds: a graph may loop for ever."""
REMEDY = "make it anew with retwin export onnx, or give it less at once if memory is short"


class Session:
    """A session of onnxruntime as a function of named arrays; others are ignored.

    Parameters
    ----------
    session : onnxruntime.InferenceSession
        The session.
    file : Path
        File of the graph, for messages.

    """

    def __init__(self, session: InferenceSession, file: Path) -> None:
        self.session = session
        self.file = file
        self.threads = ThreadPoolExecutor()
        self.inputs = {each.name: each.shape for each in session.get_inputs()}

    def __call__(self, **arrays: NDArray) -> NDArray:
        """The output of the graph; InputError if it does not run, or not within its time."""
        from onnxruntime import RunOptions

        given = {name: array for name, array in arrays.items() if name in self.inputs}
        limit = TIMEOUT + TIMEOUT_PER_ROW * max(map(len, given.values()), default=0)
        options = RunOptions()
        running = self.threads.submit(self.session.run, None, given, options)
        with refusing(self.file, expected=EXPECTED, remedy=REMEDY):
            try:
                result: NDArray = np.asarray(running.result(timeout=limit)[0])
            except TimeoutError:
                raise self.refused(f"one that runs for more than {limit:g} s") from None
            finally:
                options.terminate = True  # it has ended, or is to
        if result.dtype.kind not in "biuf":
            raise self.refused(f"an output of type {result.dtype}")
        return result

    def checked(self, shape: tuple[int, ...], **arrays: NDArray) -> NDArray:
        """The output; InputError if it has another shape or is not finite."""
        result = self(**arrays)
        if result.shape != shape:
            raise self.refused(f"an output of shape {result.shape} for {shape}")
        if not np.isfinite(result).all():
            raise self.refused("an output that is not finite")
        return result

    def refused(self, got: str) -> InputError:
        """The error for an output that no graph of `export_onnx` has."""
        return InputError(str(self.file), expected=EXPECTED, got=got, remedy=REMEDY)

    def width(self, name: str) -> int:
        """Size of the last axis of an input."""
        return int(self.inputs[name][-1])


def bounded_options(runtime: Any) -> Any:
    """Options of sessions that take a share of the free memory in all: a graph may expand."""
    kind = runtime.OrtAllocatorType.ORT_ARENA_ALLOCATOR
    memory = runtime.OrtMemoryInfo("Cpu", kind, 0, runtime.OrtMemType.DEFAULT)
    # The other settings of an arena are the defaults. A further call replaces it for new sessions.
    arena = runtime.OrtArenaCfg(Budget("graphs").left, -1, -1, -1)
    runtime.create_and_register_allocator(memory, arena)
    options = runtime.SessionOptions()
    options.add_session_config_entry("session.use_env_allocators", "1")
    return options
