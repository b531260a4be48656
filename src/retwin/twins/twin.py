"""`Twin`: a simulator from commands to outputs, and the steps that every `simulate` shares."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.arrays import check_finite
from retwin.checks import agree, instance, require, whole
from retwin.data.measured import check_magnitude
from retwin.data.segments import Segments
from retwin.data.trajectories import HEALTHY, Channels, Trajectories
from retwin.progress import Progress
from retwin.times import stride_of
from retwin.twins.collected import Collected
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.applied_faults import (
    draw_faults,
    faulty_commands,
    frozen_from,
    frozen_response,
)
from retwin.twins.faults.system_faults import check_faults, measured_with
from retwin.twins.limits import Limits
from retwin.twins.workers import keep_workers
from retwin.workers.threads import Turns, in_threads


@runtime_checkable
class Twin(Protocol):
    """A simulator from commands to outputs: plain, learned or corrected.

    A twin may also have `limits`, the `Limits` of its commands; `fingerprint`, a text that
    identifies it where its fields, and the files that they name, do not; `deterministic`, true
    if its outputs depend on no seed, so that one simulation of a record is enough; and `shiftable`,
    names of its parameters that can change during a simulation (`ParameterShift`).
    """

    @property
    def inputs(self) -> Channels:
        """Command channels."""

    @property
    def outputs(self) -> Channels:
        """Output channels."""

    @property
    def rate(self) -> float:
        """Sample rate in Hz."""

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """Simulate commands, each trajectory with its fault, if any.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u)
            Commands in the units of `inputs`, T at least 2.
        faults : sequence of Fault or None, optional
            One per trajectory, None for a healthy one; by default all are healthy.
        seed : int
            At least 0. The same seed gives the same bytes.
        progress : callable, optional
            Called with the finished fraction, from 0 to 1.

        Returns
        -------
        Trajectories
            `nominal` is the ideal output for the clean commands, `observed` the output that the
            twin predicts with the faults, `labels` the label of each fault.

        Raises
        ------
        InputError
            Commands of another width, not finite or outside the twin's limits; not one fault per
            trajectory; a seed that is not a whole number of at least 0.
        SimulationError
            Some trajectories could not be simulated; it holds the others.

        """


def checked_commands(commands: ArrayLike, inputs: Channels) -> NDArray:
    """Check the shape and the values of commands.

    Parameters
    ----------
    commands : array_like, shape (n, T, d_u)
        Finite numbers, n at least 1 and T at least 2.
    inputs : Channels
        The d_u command channels.

    Returns
    -------
    ndarray, shape (n, T, d_u)
        The commands as floating-point numbers.

    Raises
    ------
    InputError
        Another shape, no numbers, NaN or an infinite value.

    """
    array = np.ascontiguousarray(commands)  # torch takes no negative strides
    shaped = array.ndim == 3 and len(array) > 0 and array.shape[1] >= 2
    fits = shaped and array.shape[2] == len(inputs) and array.dtype.kind in "fiu"
    expected = f"numbers of shape (n, T, {len(inputs)}), T at least 2"
    got = f"{array.dtype} of shape {array.shape}"
    remedy = f"give one column per input channel, {', '.join(inputs.names)}"
    require(fits, "commands", expected=expected, got=got, remedy=remedy)
    check_finite("commands", array)
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def checked_stride(
    twin: Twin, trajectories: Trajectories, rate: float | None, argument: str
) -> int:
    """Check that a twin can be compared with healthy trajectories at a rate.

    Parameters
    ----------
    twin : Twin
        The twin.
    trajectories : Trajectories
        Healthy or unlabelled ones.
    rate : float, optional
        Sample rate of the comparison in Hz; by default that of the trajectories.
    argument : str
        The name of the trajectories in messages.

    Returns
    -------
    int
        Samples of the trajectories per sample of the comparison.

    Raises
    ------
    InputError
        There is no trajectory, one has a fault, channels or rate are not the twin's, `rate` does
        not divide that of the trajectories, or a value stands for a missing measurement
        (`check_magnitude`).

    """
    instance(argument, trajectories, Trajectories, remedy="load recorded ones, or simulate a twin")
    check_healthy(argument, trajectories)
    check_channels(twin, trajectories, argument)
    check_magnitude(argument, trajectories)
    return stride_of(
        trajectories.rate, rate, steps=trajectories.steps, remedy="give the sensor's true rate"
    )


def check_healthy(argument: str, trajectories: Trajectories) -> None:
    """Refuse a set without trajectories, or with one that is labelled with a fault."""
    faulty = int((~trajectories.maybe_healthy).sum())
    fits = len(trajectories) > 0 and not faulty
    got = f"{len(trajectories)}, {faulty} of them with a fault"
    remedy = f"take {argument}.with_label({HEALTHY!r})"
    require(fits, argument, expected="healthy trajectories, one at least", got=got, remedy=remedy)


def check_channels(twin: Twin, trajectories: Trajectories, argument: str) -> None:
    """Refuse trajectories whose channels or rate are not those of a twin.

    Raises InputError, in which the trajectories have the name `argument`.
    """
    instance(argument, trajectories, Trajectories, remedy="load recorded ones, or simulate a twin")
    remedy = "load the file with its case, or convert it"
    agree(argument, trajectories, twin, "that of the twin", remedy=remedy)


def checked_seed(seed: int) -> int:
    """Check that a seed is a whole number of at least 0.

    Parameters
    ----------
    seed : int
        The seed.

    Returns
    -------
    int
        The seed as a Python integer.

    Raises
    ------
    InputError
        Anything else.

    """
    return whole("seed", seed, remedy="give one: the same seed gives the same result")


def nominal_outputs(
    nominal: Callable[[NDArray], NDArray], commands: NDArray, width: int
) -> NDArray:
    """Evaluate and check a user's function for the ideal output.

    Parameters
    ----------
    nominal : callable
        From commands (n, T, d_u) to outputs (n, T, d_y).
    commands : ndarray, shape (n, T, d_u)
        Clean commands.
    width : int
        The number of outputs, d_y.

    Returns
    -------
    ndarray, shape (n, T, d_y)
        The ideal outputs.

    Raises
    ------
    InputError
        The function returns another shape, NaN or an infinite value.

    """
    outputs = np.asarray(nominal(commands))
    shape = (*commands.shape[:2], width)
    fits = outputs.shape == shape and outputs.dtype.kind in "fiub"
    require(
        fits and bool(np.isfinite(outputs).all()),
        "nominal",
        expected=f"a function that gives finite outputs of shape {shape}",
        got="NaN or an infinite number" if fits else f"{outputs.dtype}, {outputs.shape}",
        remedy="give the ideal outputs (n, T, d_y) for commands (n, T, d_u)",
    )
    return outputs


@dataclass(frozen=True, eq=False)
class Chunk:
    """A few trajectories that are simulated together.

    Attributes
    ----------
    index : slice
        Their place among all trajectories.
    commands : ndarray, shape (n, T, d_u)
        Clean commands.
    faulty_commands : ndarray, shape (n, T, d_u)
        Commands with the faults' effect on the reference.
    faults : sequence of Fault or None
        One per trajectory, their severities drawn.
    segments : Segments
        Segments of the clean commands.
    rate : float
        Sample rate in Hz.
    seed : int
        Seed of the whole simulation.
    parameters : mapping of str to ndarray, shape (n,)
        Values of parameters of the twin.
    failed : dict of int to str
        Filled in by the simulation: the trajectories of this chunk, counted from 0, that could
        not be simulated, and the reasons. Their outputs are ignored.
    known : dict of int to int
        Filled in by the simulation: the trajectories of this chunk whose simulation ended early,
        and the number of their samples that are known. Later ones are masked.
    turn : context manager
        A block that the simulations of all chunks enter in order, for what draws from a generator
        that they share, or changes other things in common.
    report : callable
        Takes the share of this chunk that is done, where a chunk takes long.

    """

    index: slice
    commands: NDArray
    faulty_commands: NDArray
    faults: Sequence[Fault | None]
    segments: Segments
    rate: float
    seed: int = 0
    parameters: Mapping[str, NDArray] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)
    known: dict[int, int] = field(default_factory=dict)
    turn: AbstractContextManager[None] = field(default_factory=nullcontext)
    report: Progress = lambda share: None

    @property
    def frozen(self) -> NDArray:
        """Sample (n, d_u) from which an actuator is held; T where it never is."""
        return frozen_from(self.faults, *self.commands.shape[1:], rate=self.rate)

    @property
    def held_commands(self) -> NDArray:
        """Faulty commands (n, T, d_u), held from the sample at which an actuator freezes.

        For twins whose actuators cannot be accessed: a held command stands in for a frozen
        response.
        """
        return frozen_response(self.faulty_commands, self.faults, rate=self.rate)


def simulate_in_chunks(
    twin: Twin,
    run: Callable[[Chunk], tuple[NDArray, NDArray]],
    commands: ArrayLike,
    faults: Sequence[Fault | None] | None,
    *,
    seed: int,
    progress: Progress | None,
    size: int = 128,
    emulated: bool = False,
    threaded: bool = False,
    parameters: Mapping[str, NDArray] | None = None,
) -> Trajectories:
    """Simulate by a function of chunks: the steps that the `simulate` of all twins shares.

    Arguments are checked, severities of faults are drawn, progress is reported, and the results
    are collected. A trajectory that fails or gives outputs that are not finite does not end the
    others.

    Parameters
    ----------
    twin : Twin
        The twin whose channels, rate and limits count.
    run : callable
        From a `Chunk` to its nominal and observed outputs, each (n, T, d_y).
    commands, faults, seed, progress
        See `Twin.simulate`.
    size : int, default 128
        Trajectories per chunk, at most.
    emulated : bool, default False
        Whether the result stands in for measurements.
    threaded : bool, default False
        Whether `run` may be called in several threads at a time, and then uses `Chunk.turn`.
    parameters : mapping of str to ndarray, shape (n,), optional
        Values of parameters of the twin.

    Returns
    -------
    Trajectories
        See `Twin.simulate`.

    Raises
    ------
    InputError, SimulationError
        See `Twin.simulate`.

    """
    commands = checked_commands(commands, twin.inputs)
    limits: Limits | None = getattr(twin, "limits", None)
    if limits is not None:
        commands = limits.keep(commands, twin.inputs)
    seed = checked_seed(seed)
    shiftable = getattr(twin, "shiftable", ())
    check_faults(faults or (), len(twin.inputs), len(twin.outputs), shiftable)
    segments = Segments.from_commands(commands)
    faults = [None] * len(commands) if faults is None else faults
    drawn = draw_faults(faults, segments, seed, rate=twin.rate)
    collected = Collected(commands, twin.inputs, twin.outputs, twin.rate)
    turns = Turns()

    def run_chunk(begin: int) -> float:
        index, rate = slice(begin, begin + size), twin.rate
        clean, own, parts = commands[index], drawn[index], segments[index]
        effective = faulty_commands(clean, own, parts, rate=rate)
        values = {name: each[index] for name, each in (parameters or {}).items()}
        turn = turns.turn(begin // size)

        def report(share: float) -> None:
            if progress is not None:
                progress((begin + share * len(clean)) / len(commands))

        chunk = Chunk(
            index, clean, effective, own, parts, rate, seed, values, turn=turn, report=report
        )
        try:
            nominal, healthy = run(chunk)
        finally:
            turns.over(begin // size)
        observed = measured_with(healthy, own, rate)
        collected.put(index, nominal, observed, chunk.failed, chunk.known)
        return min(1.0, (begin + size) / len(commands))

    for share in (in_threads if threaded else map)(run_chunk, range(0, len(commands), size)):
        if progress is not None:
            progress(share)
    labels = np.array([HEALTHY if fault is None else fault.label for fault in drawn])
    source = f"{type(twin).__name__} seed={seed}"
    return collected.trajectories(labels, source=source, emulated=emulated)


class ChunkedTwin:
    """The base of twins that simulate some trajectories at a time, by their method `_run`.

    Worker processes that a chunk starts stay until all chunks are simulated.
    """

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`."""
        twin: Any = self  # with the channels and the rate of the subclass
        run, emulated = twin._run, getattr(self, "emulated", False)
        with keep_workers():
            return simulate_in_chunks(
                twin, run, commands, faults, seed=seed, progress=progress, emulated=emulated
            )
