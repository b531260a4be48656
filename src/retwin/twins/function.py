"""`FunctionTwin`: any Python function from commands to outputs, in worker processes on request."""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pebble import ProcessExpired, ProcessPool

from retwin.checks import require
from retwin.data.trajectories import Channels
from retwin.errors import InputError
from retwin.times import sample_rate
from retwin.twins.limits import Limits
from retwin.twins.twin import Chunk, ChunkedTwin
from retwin.twins.workers import worker_processes
from retwin.workers.pools import check_sendable, sendable_errors, worker_pool

IMPORTABLE = {
    "expected": "a function that worker processes can import",
    "remedy": "define it in a module of its own, or give workers=1",
}
"""Parts of the error for another function."""

Function = Callable[..., ArrayLike]


@dataclass(frozen=True)
class FunctionTwin(ChunkedTwin):
    """A twin that is a Python function.

    Parameters
    ----------
    function : callable
        From commands to outputs in physical units. Vectorised: (n, T, d_u) to (n, T, d_y), for at
        most 128 trajectories at a time; otherwise (T, d_u) to (T, d_y). A function with a
        parameter `rng` is stochastic; it gets a `numpy.random.Generator` by that name. One with a
        parameter `rate` gets the sample rate in Hz, unless a `functools.partial` binds it.
    inputs, outputs : Channels
        Channels of the commands and the outputs.
    rate : float
        Sample rate in Hz, above 0.
    vectorised : bool, default True
        Whether `function` takes many trajectories at once.
    nominal : callable, optional
        The ideal output for clean commands, with the arguments of `function`; by default
        `function` itself. A stochastic function requires it, since the ideal output has no noise.
    limits : Limits, optional
        Range of the commands.
    workers : int, default 1
        Processes over which the calls of a function of one trajectory are distributed; 1 calls it
        in this process.

    Raises
    ------
    InputError
        An object that cannot be called, a stochastic function without `nominal`, a rate that is
        not positive, `workers` below 1, or more than one for a vectorised function or for a
        function that other processes cannot import.

    Notes
    -----
    The actuators inside the function cannot be accessed, so a frozen response is a held command.
    Random numbers depend on the seed and on the index of the (first) trajectory: the same seed
    gives the same bytes for any number of workers. `simulate` passes on exceptions of the function
    unchanged, raises InputError when it returns another shape, no numbers, NaN or infinite values,
    and SimulationError when the worker processes of some trajectories died.

    """

    function: Function
    inputs: Channels
    outputs: Channels
    rate: float
    _: KW_ONLY
    vectorised: bool = True
    nominal: Function | None = None
    limits: Limits | None = None
    workers: int = 1

    def __post_init__(self) -> None:
        for role, given in (("function", self.function), ("nominal", self.nominal)):
            fits = callable(given) or (role == "nominal" and given is None)
            expected = "something that can be called with commands"
            remedy = "give a function of the commands that returns the outputs"
            require(fits, role, expected=expected, got=repr(given), remedy=remedy)
        fits = self.nominal is not None or not _takes(self.function, "rng")
        expected = f"a function for the ideal output, since {_name(self.function)} is random"
        remedy = "give nominal=, the same without noise"
        require(fits, "nominal", expected=expected, got="None", remedy=remedy)
        sample_rate("rate", self.rate)
        fits = self.workers >= 1 and (self.workers == 1 or not self.vectorised)
        expected = "1, or more for a function of one trajectory"
        got = f"{self.workers} with vectorised={self.vectorised}"
        remedy = "leave workers out, or give vectorised=False"
        require(fits, "workers", expected=expected, got=got, remedy=remedy)
        if self.workers > 1:
            check_sendable(self.function, "function", **IMPORTABLE)
            check_sendable(self.nominal, "nominal", **IMPORTABLE)

    def _run(self, chunk: Chunk) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs of a chunk."""
        if self.workers == 1:
            return self._outputs_of(None, chunk)
        # No process is started before commands and faults are found good.
        key = (FunctionTwin, self.workers)  # processes can serve every function
        with worker_processes(key, lambda: worker_pool(self.workers)) as pool:
            return self._outputs_of(pool, chunk)

    def _outputs_of(self, pool: ProcessPool | None, chunk: Chunk) -> tuple[NDArray, NDArray]:
        held = chunk.held_commands
        every = np.arange(len(held))
        # Without a nominal function, the healthy output of a trajectory is its nominal output.
        faulty = every
        if self.nominal is None:
            faulty = np.flatnonzero((held != chunk.commands).any(axis=(1, 2)))
        ideal = "function" if self.nominal is None else "nominal"
        clean = self._calls(ideal, chunk, chunk.commands, every)
        calls = [*clean, *self._calls("function", chunk, held, faulty)]
        outputs = []
        for output in _outputs(calls, pool, chunk):
            outputs.append(output)
            chunk.report(len(outputs) / len(calls))
        nominal = np.concatenate(outputs[: len(clean)]).astype(chunk.commands.dtype)
        observed = nominal.copy()
        if len(faulty):
            observed[faulty] = np.concatenate(outputs[len(clean) :])
        return nominal, observed

    def _calls(self, role: str, chunk: Chunk, commands: NDArray, rows: NDArray) -> list[_Call]:
        """The calls that give the outputs of those rows of the chunk, in order."""
        if len(rows) == 0:
            return []
        parts = [rows] if self.vectorised else np.split(rows, len(rows))
        # Each has a copy of its commands, which the function may change.
        return [_Call(self, role, commands[p], p + chunk.index.start, chunk.seed) for p in parts]


@dataclass(frozen=True, eq=False)
class _Call:
    """One call of a user's function, for one trajectory or for many."""

    twin: FunctionTwin
    role: str
    commands: NDArray
    ids: NDArray
    seed: int

    @property
    def function(self) -> Function:
        """The function that is called."""
        return getattr(self.twin, self.role)

    def outputs_of(self) -> NDArray:
        """Call the function and check its outputs (n, T, d_y)."""
        many = self.twin.vectorised
        options: dict[str, Any] = {}
        if _takes(self.function, "rate"):
            options["rate"] = self.twin.rate
        if self.role == "function" and _takes(self.function, "rng"):
            # With a spawn key, since the severities of faults are drawn from the seed itself.
            sequence = np.random.SeedSequence(self.seed, spawn_key=(int(self.ids[0]),))
            options["rng"] = np.random.default_rng(sequence)
        returned = self.function(self.commands if many else self.commands[0], **options)
        outputs = self._numbers(returned)
        outputs = outputs if many else outputs[None]
        self._check_finite(outputs)
        return outputs

    def _numbers(self, returned: ArrayLike) -> NDArray:
        """What the function returned, as numbers of the right shape."""
        single, outputs = not self.twin.vectorised, self.twin.outputs
        shape = (*self.commands.shape[:2], len(outputs))[int(single) :]
        try:
            # A copy: the function may reuse its own array.
            values = np.array(returned)
            got = f"{values.dtype} of shape {values.shape}"
        except (TypeError, ValueError, RuntimeError) as error:
            values = np.empty(0)
            got = " ".join(str(error).split())
        names = ", ".join(outputs.names)
        other = "vectorised=False if it takes one trajectory, (T, d_u)"
        if single:
            other = "vectorised=True if it takes many trajectories, (n, T, d_u)"
        require(
            values.shape == shape and values.dtype.kind in "fiub",
            self.role,
            expected=f"{_name(self.function)} to return numbers of shape {shape}",
            got=f"{type(returned).__name__}, {got}",
            remedy=f"return one column per output channel, {names}; give {other}",
        )
        return values

    def _check_finite(self, outputs: NDArray) -> None:
        """Refuse NaN and infinite values."""
        bad = ~np.isfinite(outputs)
        if bad.any():
            row, sample, channel = np.argwhere(bad)[0]
            expected = f"{_name(self.function)} to return finite numbers"
            got = f"{outputs[row, sample, channel]} for {self.twin.outputs.names[channel]} in "
            got += f"trajectory {self.ids[row]}, sample {sample}"
            remedy = "repair the function, or give limits that exclude such commands"
            raise InputError(self.role, expected=expected, got=got, remedy=remedy)


def _outputs(calls: Sequence[_Call], pool: ProcessPool | None, chunk: Chunk) -> Iterator[NDArray]:
    """Outputs of each call, in order; a trajectory whose process died is entered as failed."""
    if pool is None:
        yield from (call.outputs_of() for call in calls)
        return
    # Pickled here, so that a function that the worker cannot import ends its call, not the pool.
    futures = [pool.schedule(_in_worker, args=(pickle.dumps(call), call.role)) for call in calls]
    for call, future in zip(calls, futures, strict=True):
        try:
            yield future.result()
        except BrokenProcessPool as error:
            expected = "worker processes that can start"
            remedy = "call it from a script, under `if __name__ == '__main__':`, or workers=1"
            raise InputError("workers", expected=expected, got=str(error), remedy=remedy) from error
        except ProcessExpired as error:
            chunk.failed[int(call.ids[0]) - chunk.index.start] = (
                f"the process of {_name(call.function)} died, exit code {error.exitcode}"
            )
            yield np.zeros((*call.commands.shape[:2], len(call.twin.outputs)))


def _in_worker(pickled: bytes, role: str) -> NDArray:
    """Outputs of a pickled call."""
    try:
        call = pickle.loads(pickled)
    except (AttributeError, ImportError) as error:
        raise InputError(role, got=" ".join(str(error).split()), **IMPORTABLE) from error
    with sendable_errors():
        return call.outputs_of()


def _takes(function: Function, name: str) -> bool:
    """Whether the function has a parameter of that name besides the commands, and not yet bound."""
    if isinstance(function, partial) and name in function.keywords:
        return False
    try:
        return name in list(inspect.signature(function).parameters)[1:]
    except (TypeError, ValueError):  # some compiled functions have no signature
        return False


def _name(function: Function) -> str:
    """Name of the function, for messages."""
    inner = function.func if isinstance(function, partial) else function
    return getattr(inner, "__qualname__", type(inner).__qualname__)
