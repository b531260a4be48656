"""`FMUTwin`: a simulator exported as an FMU (FMI 2.0 or 3.0, co-simulation), run by FMPy.

It needs the extra `fmu`. An FMU is native code that runs with the user's rights: run only FMUs
from sources that you trust.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import at_least, positive, require
from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.times import sample_rate
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.fmu.instance import Outcome, RunSettings, Start
from retwin.twins.fmu.model import (
    channels_of,
    extract,
    find_scalars,
    limits_of,
    read_description,
    start_column,
)
from retwin.twins.limits import Limits
from retwin.twins.time_step import steps_per_sample
from retwin.twins.twin import Chunk, checked_commands, nominal_outputs, simulate_in_chunks
from retwin.twins.workers import keep_workers, worker_processes
from retwin.workers.isolation import IsolatedPool
from retwin.workers.pools import scratch_folder
from retwin.workers.process import Frame, ProcessEnded

TRAJECTORIES_PER_CHUNK = 256
"""Number of trajectories per chunk: it bounds the tasks that wait for a process."""
TASKS = "retwin.twins.fmu.worker"
"""The module of the tasks of its processes."""
FORGETS = (
    "its reset does not restore the initial state, so every run has a new instance; reuse=False "
    "makes them at once"
)


@dataclass(frozen=True)
class FMUTwin:
    """A functional mock-up unit, run in worker processes, since it may hang or crash.

    `FMUTwin.from_file` makes one with names, units and limits from the FMU. Each process loads the
    FMU once and resets it between runs; see also `keep_workers`. A run depends neither on the runs
    before it nor on the number of processes: see `reuse`.

    Parameters
    ----------
    path : Path
        The .fmu file.
    inputs, outputs : Channels
        Variables, or elements of arrays, that are commands and outputs. Continuous inputs are
        linear between samples, other inputs are rounded and held. In each step the FMU has the
        inputs of its begin.
    rate : float, default 100.0
        Sample rate in Hz, above 0.
    start : mapping of str to float or str, optional
        Start values by name, in the variables' units.
    rates : mapping of str to float, optional
        Rates in Hz, at most `rate`, of inputs that are sampled and held at a rate of their own.
    step : float, optional
        Communication step in s, which divides the sample period; by default the sample period.
    limits : Limits, optional
        Range of the commands.
    nominal : callable, optional
        From clean commands (n, T, d_u) to the ideal output (n, T, d_y); by default the FMU's own
        output without faults.
    reuse : bool, default True
        Whether an instance is reset between runs. In each process the first trajectory is run
        again after its first reset, and after the first run with other outputs. An FMU whose
        outputs then differ gets a new instance for every run, and where that does not help either
        a new process, with one warning. False makes a new instance for every run at once.
    timeout : float, default 60.0
        Duration of a run in s, loading included, after which it is ended as hung.
    workers : int, default 0
        Processes; 0 takes one per core. The result does not depend on it.

    Raises
    ------
    InputError
        A rate, step or timeout that is not positive, a rate of an input above `rate`, or a step
        that does not divide the sample period.

    """

    path: Path
    inputs: Channels
    outputs: Channels
    rate: float = 100.0
    start: Mapping[str, float | str] = field(default_factory=dict)
    rates: Mapping[str, float] = field(default_factory=dict)
    step: float | None = None
    limits: Limits | None = None
    nominal: Callable[[NDArray], NDArray] | None = None
    reuse: bool = True
    timeout: float = 60.0
    workers: int = 0

    def __post_init__(self) -> None:
        sample_rate("rate", self.rate)
        positive("timeout", self.timeout, unit="s")
        for name, rate in self.rates.items():
            fits = name in self.inputs.names and 0 < rate <= self.rate
            expected = f"inputs of the twin, each with a rate above 0 and up to {self.rate:g} Hz"
            got = f"{name!r} with {rate:g} Hz"
            remedy = f"the inputs are {', '.join(self.inputs.names)}"
            require(fits, "rates", expected=expected, got=got, remedy=remedy)
        _ = self.substeps

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        rate: float = 100.0,
        inputs: Sequence[str] = (),
        outputs: Sequence[str] = (),
        *,
        start: Mapping[str, float | str] | None = None,
        outside: Literal["refuse", "clip"] = "refuse",
        **options: Any,
    ) -> FMUTwin:
        """Make the twin of a file from its description; its native code is not loaded yet.

        Parameters
        ----------
        path : str or Path
            The .fmu file.
        rate : float, default 100.0
            Sample rate in Hz.
        inputs, outputs : sequence of str, optional
            Names of variables, in order; of an array its own, for all elements, or "y[0]" for
            one. Local variables may be named as outputs. By default all outputs that are numbers,
            and all such inputs whose range is more than one value; the others keep their start
            values.
        start : mapping of str to float or str, optional
            Start values by name.
        outside : {"refuse", "clip"}
            What is done with commands outside the ranges that the FMU declares.
        **options
            Other parameters of the class.

        Returns
        -------
        FMUTwin
            The twin.

        Raises
        ------
        InputError
            The file is no FMU, or one without co-simulation, without native code for this machine
            or without the named variables; FMPy is not installed.

        """
        path = Path(path)
        description = read_description(path)
        inputs_found = find_scalars(description, "inputs", inputs)
        outputs_found = find_scalars(description, "outputs", outputs)
        remedy = "name local variables as outputs, or export the FMU with outputs"
        at_least(
            "outputs", outputs_found, 1, "variable that is an output and a number", remedy=remedy
        )
        twin = cls(
            path.resolve(),
            channels_of(inputs_found),
            channels_of(outputs_found),
            rate,
            start=dict(start or {}),
            limits=limits_of(inputs_found, outside),
            **options,
        )
        twin._start_values(description, {}, 1)
        return twin

    @property
    def substeps(self) -> int:
        """Communication steps per sample.

        Raises
        ------
        InputError
            The step does not divide the sample period.

        """
        return 1 if self.step is None else steps_per_sample(self.rate, self.step)

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> Trajectories:
        """See `TakesParameters.simulate`; a stuck actuator is a held command.

        Parameters
        ----------
        commands, faults, seed, progress
            See `Twin.simulate`.
        parameters : mapping of str to array_like, optional
            Start values by name, each () or (n,); they take precedence over `start`.

        Returns
        -------
        Trajectories
            See `Twin.simulate`.

        Raises
        ------
        InputError
            As `Twin.simulate`; start values that cannot be set; an FMU that does not load.
        SimulationError
            Runs that hung, crashed or ended in an error.

        """
        commands = checked_commands(commands, self.inputs)
        count = len(commands)
        values = self._start_values(read_description(self.path), parameters or {}, count)
        notes: dict[str, None] = {}
        ended: dict[int, float] = {}

        def report(finished: float) -> None:
            if progress is not None:
                progress(min(1.0, finished / count))

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            # No process is started before commands and faults are found good.
            with self._workers(count) as pool:
                made = self._run(pool, chunk, values[chunk.index], report, ended)
                notes.update(dict.fromkeys(pool.notes))
                return made

        size = TRAJECTORIES_PER_CHUNK
        try:
            with keep_workers():
                return simulate_in_chunks(
                    self, run, commands, faults, seed=seed, progress=None, size=size
                )
        finally:
            self._warn(notes, ended)

    def _warn(self, notes: Collection[str], ended: Mapping[int, float]) -> None:
        """Warn once of an FMU that does not restore its state, and of runs that ended early."""
        for note in notes:
            warnings.warn(f"{self.path.name}: {note}", stacklevel=3)
        if ended:
            some = [f"trajectory {i} at {time:g} s" for i, time in list(ended.items())[:5]]
            more = ", …" if len(ended) > 5 else ""
            warnings.warn(
                f"{self.path.name} ended {len(ended)} simulations before their commands end: "
                f"{', '.join(some)}{more}; their later outputs are masked",
                stacklevel=3,
            )

    def _workers(self, count: int) -> AbstractContextManager[IsolatedPool]:
        """Processes that have loaded the FMU, for `count` trajectories."""
        names = self.inputs.names, self.outputs.names
        job = RunSettings(*names, self.rate, self.substeps, dict(self.rates), self.reuse)
        workers = min(self.workers or os.cpu_count() or 1, count)
        state = self.path.stat()
        version = (self.path, state.st_mtime_ns, state.st_size)
        return worker_processes((version, job, workers), lambda: self._start(job, workers))

    @contextmanager
    def _start(self, job: RunSettings, workers: int) -> Iterator[IsolatedPool]:
        """Start the processes on an unpacked FMU, which is removed when they end."""
        with scratch_folder() as folder:
            extract(self.path, folder)
            about = {"folder": folder, "settings": asdict(job)}
            with closing(IsolatedPool(workers, folder, f"{TASKS}:start", about)) as pool:
                self._check_loads(pool)
                yield pool

    def _run(
        self,
        pool: IsolatedPool,
        chunk: Chunk,
        values: Sequence[Start],
        report: Callable[[float], None],
        ended: dict[int, float],
    ) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs of a chunk; reports the number of finished trajectories.

        The time in s is entered in `ended` for each trajectory whose simulation the FMU ended.
        """
        clean, held = chunk.commands, chunk.held_commands
        observed = np.zeros((*clean.shape[:2], len(self.outputs)))
        nominal = np.zeros_like(observed)
        runs = [(observed, i, held[i]) for i in range(len(clean))]
        # Where no fault changes the commands, the run is the nominal run as well.
        changed = (held != clean).any(axis=(1, 2))
        if self.nominal is None:
            runs += [(nominal, i, clean[i]) for i in np.flatnonzero(changed).tolist()]
        size = 8 * clean.shape[1] * len(self.outputs)
        task = partial(pool.schedule, f"{TASKS}:run", timeout=self.timeout, size=size)
        futures = [task(values[i], [commands]) for _, i, commands in runs]
        for done, ((outputs, i, _), future) in enumerate(zip(runs, futures, strict=True), 1):
            outcome = self._outcome(future)
            if outcome.reason:
                healthy = "" if outputs is observed else "without its fault: "
                chunk.failed.setdefault(i, healthy + outcome.reason)
            else:
                known = len(outcome.outputs)
                outputs[i, :known], outputs[i, known:] = outcome.outputs, outcome.outputs[-1]
                if outcome.ended is not None:
                    chunk.known[i] = min(known, chunk.known.get(i, known))
                    ended.setdefault(chunk.index.start + i, outcome.ended)
            if outcome.forgets and FORGETS not in pool.notes:
                pool.notes.append(FORGETS)
            report(chunk.index.start + len(clean) * done / len(runs))
        if self.nominal is not None:
            return nominal_outputs(self.nominal, clean, len(self.outputs)), observed
        nominal[~changed] = observed[~changed]
        return nominal, observed

    def _outcome(self, future: Future[Frame]) -> Outcome:
        """The outcome of a run, also of one that harmed its process."""
        try:
            about, (outputs,) = future.result()
            return Outcome(outputs, **about)
        except TimeoutError:
            return Outcome(reason=f"hung for more than {self.timeout:g} s")
        except ProcessEnded as error:
            return Outcome(reason=str(error))

    def _check_loads(self, pool: IsolatedPool) -> None:
        """Refuse an FMU that cannot be loaded, once instead of in every run."""
        loading = pool.schedule(f"{TASKS}:load", None, timeout=self.timeout, size=0)
        reason = self._outcome(loading).reason
        expected = "an FMU that loads on this machine"
        got = f"{self.path.name}: {reason}"
        remedy = "export it for this system; see that what it needs is installed"
        require(not reason, "path", expected=expected, got=got, remedy=remedy)

    def _start_values(
        self, description: Any, parameters: Mapping[str, ArrayLike], count: int
    ) -> list[dict[str, Any]]:
        """Checked start values of every trajectory."""
        values = [dict(self.start) for _ in range(count)]
        for name, value in {**self.start, **parameters}.items():
            column = start_column(description, name, value, count, self.inputs.names)
            for own, single in zip(values, column, strict=True):
                own[name] = single
        return values
