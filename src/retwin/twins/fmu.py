"""`FMUTwin`: a simulator exported as an FMU (FMI 2.0 or 3.0, co-simulation), run by FMPy.

Needs the extra `fmu`. An FMU runs native code with your rights: run only FMUs that you trust.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pebble import ProcessExpired, ProcessPool

from retwin.checks import positive
from retwin.data.trajectories import Channels, Trajectories
from retwin.errors import InputError
from retwin.processes import scratch_folder, worker_pool
from retwin.progress import Progress
from retwin.twins import fmu_worker
from retwin.twins.faults import Fault
from retwin.twins.fmu_model import (
    channels_of,
    extract,
    find_variables,
    limits_of,
    read_description,
    start_column,
)
from retwin.twins.limits import Limits
from retwin.twins.time_step import steps_per_sample
from retwin.twins.twin import Chunk, checked_commands, nominal_outputs, simulate_in_chunks
from retwin.twins.workers import worker_processes

__all__ = ["FMUTwin"]

TRAJECTORIES_PER_CHUNK = 256
"""Trajectories per chunk."""


@dataclass(frozen=True)
class FMUTwin:
    """A functional mock-up unit, run in worker processes, which it may hang or crash.

    Make it with `FMUTwin.from_file`, which takes names, units and limits from the FMU. Each worker
    loads the FMU once and resets it between runs. A script that simulates must do so under
    `if __name__ == "__main__":`.

    Parameters
    ----------
    path: the .fmu file.
    inputs, outputs: variables that are commands and outputs. Continuous inputs are linear between
        samples, others rounded and held. The FMU sees inputs from the begin of each step.
    rate: samples per second of commands and outputs.
    start: start values by name, in the variables' units.
    rates: inputs that are sampled and held at a rate of their own, in Hz, at most `rate`.
    step: communication step in s, which divides the sample period; None takes one per sample.
    limits: that the commands must keep.
    nominal: the ideal output (n, T, d_y) for clean commands (n, T, d_u); None takes the FMU's own
        healthy output.
    reuse: whether an instance is reset between runs. False makes another for every run: for FMUs
        whose reset leaves something behind.
    timeout: s that a run may take before it counts as hung, loading included.
    workers: processes; 0 takes one per core. The result does not depend on it.

    Raises
    ------
    InputError: a rate, step or timeout that is not positive or does not fit.

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
        positive("rate", self.rate, unit="Hz")
        positive("timeout", self.timeout, unit="s")
        for name, rate in self.rates.items():
            if name not in self.inputs.names or not 0 < rate <= self.rate:
                raise InputError(
                    "rates",
                    expected=f"inputs of the twin, each with a rate above 0 and up to {self.rate:g}"
                    " Hz",
                    got=f"{name!r} with {rate:g} Hz",
                    remedy=f"the inputs are {', '.join(self.inputs.names)}",
                )
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
        """The twin of a file, whose description is read here; its native code is not loaded.

        Parameters
        ----------
        path: the .fmu file.
        rate: samples per second.
        inputs, outputs: names of variables, in order; by default all scalar numbers among the
            FMU's inputs and outputs.
        start: start values by name.
        outside: what to do with commands beyond the limits that the FMU declares.
        options: other attributes of the class, by name.

        Raises
        ------
        InputError: no FMU, or one without co-simulation, without native code for this machine or
            without the named variables; FMPy is not installed.

        """
        path = Path(path)
        description = read_description(path)
        taken = find_variables(description, "inputs", inputs)
        given = find_variables(description, "outputs", outputs)
        if not given:
            raise InputError(
                "outputs",
                expected="at least one variable that is an output and a number",
                got=f"{path.name}, which has none",
                remedy="export the FMU with outputs",
            )
        twin = cls(
            path.resolve(),
            channels_of(taken),
            channels_of(given),
            rate,
            start=dict(start or {}),
            limits=limits_of(taken, outside),
            **options,
        )
        twin._start_values(description, {}, 1)
        return twin

    @property
    def substeps(self) -> int:
        """Communication steps per sample.

        Raises InputError when the step does not divide the sample period.
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
        """See `Twin.simulate`; the actuators are inside, so a stuck one is a held command.

        Parameters
        ----------
        commands, faults, seed, progress: as in `Twin.simulate`.
        parameters: start values per trajectory, (n,) or one for all; they go before `start`.

        A run that hangs, crashes or ends in an error ends alone: see `SimulationError`.

        Raises
        ------
        InputError: as in `Twin.simulate`; start values that cannot be set; an FMU that is gone or
            does not load.

        """
        commands = checked_commands(commands, self.inputs)
        count = len(commands)
        values = self._start_values(read_description(self.path), parameters or {}, count)

        def report(finished: float) -> None:
            if progress is not None:
                progress(min(1.0, finished / count))

        with ExitStack() as stack:
            # No process is started before commands and faults are found good.
            pool = cache(lambda: stack.enter_context(self._workers(count)))

            def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
                return self._run(pool(), chunk, values[chunk.index], report)

            return simulate_in_chunks(
                self, run, commands, faults, seed=seed, progress=None, size=TRAJECTORIES_PER_CHUNK
            )

    def _workers(self, count: int) -> AbstractContextManager[ProcessPool]:
        """Processes that have loaded the FMU, for `count` trajectories."""
        job = fmu_worker.Job(
            inputs=self.inputs.names,
            outputs=self.outputs.names,
            rate=self.rate,
            substeps=self.substeps,
            rates=dict(self.rates),
            reuse=self.reuse,
        )
        workers = min(self.workers or os.cpu_count() or 1, count)
        state = self.path.stat()
        version = (self.path, state.st_mtime_ns, state.st_size)
        return worker_processes((version, job, workers), lambda: self._start(job, workers))

    @contextmanager
    def _start(self, job: fmu_worker.Job, workers: int) -> Iterator[ProcessPool]:
        """Start the processes on an unpacked FMU, which is removed when they end."""
        begin, orphaned = fmu_worker.start, fmu_worker.orphaned
        with scratch_folder() as folder:
            extract(self.path, folder)
            with worker_pool(workers, begin, (folder, job), orphaned=orphaned) as pool:
                self._check_loads(pool)
                yield pool

    def _run(
        self,
        pool: ProcessPool,
        chunk: Chunk,
        values: Sequence[fmu_worker.Start],
        tell: Callable[[float], None],
    ) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs of a chunk, which tells how many trajectories are done."""
        clean, held = chunk.commands, chunk.held_commands
        observed = np.zeros((*clean.shape[:2], len(self.outputs)))
        nominal = np.zeros_like(observed)
        runs = [(observed, i, held[i]) for i in range(len(clean))]
        # A trajectory whose commands no fault has bent is its own healthy run.
        bent = (held != clean).any(axis=(1, 2))
        if self.nominal is None:
            runs += [(nominal, i, clean[i]) for i in np.flatnonzero(bent).tolist()]
        asked = [self._ask(pool, commands, values[i]) for _, i, commands in runs]
        for done, ((outputs, i, commands), future) in enumerate(zip(runs, asked, strict=True), 1):
            outcome = self._outcome(pool, future, commands, values[i])
            if isinstance(outcome, str):
                healthy = "" if outputs is observed else "without its fault: "
                chunk.failed.setdefault(i, healthy + outcome)
            else:
                outputs[i] = outcome
            tell(chunk.index.start + len(clean) * done / len(runs))
        if self.nominal is not None:
            return nominal_outputs(self.nominal, clean, len(self.outputs)), observed
        nominal[~bent] = observed[~bent]
        return nominal, observed

    def _ask(self, pool: ProcessPool, commands: NDArray, values: fmu_worker.Start) -> Future:
        return pool.schedule(fmu_worker.run, args=(commands, values), timeout=self.timeout)

    def _outcome(
        self, pool: ProcessPool, future: Future, commands: NDArray, values: fmu_worker.Start
    ) -> NDArray | str:
        """Outputs (T, d_y), or why there are none."""
        while True:
            try:
                return future.result()
            except TimeoutError:
                return f"hung for more than {self.timeout:g} s"
            except ProcessExpired as error:
                if error.exitcode != fmu_worker.AGAIN:
                    return _death(error.exitcode)
                future = self._ask(pool, commands, values)

    def _check_loads(self, pool: ProcessPool) -> None:
        """Refuse an FMU that no run could load, before every run says so."""
        try:
            reason = pool.schedule(fmu_worker.load, timeout=self.timeout).result()
        except TimeoutError:
            reason = f"it hung for more than {self.timeout:g} s"
        except ProcessExpired as error:
            reason = _death(error.exitcode)
        if reason:
            raise InputError(
                "path",
                expected="an FMU that loads on this machine",
                got=f"{self.path.name}: {reason}",
                remedy="export it for this system; see that what it needs is installed",
            )

    def _start_values(
        self, description: Any, parameters: Mapping[str, ArrayLike], count: int
    ) -> list[dict[str, Any]]:
        """Start values of every trajectory, checked."""
        values = [dict(self.start) for _ in range(count)]
        for name, value in {**self.start, **parameters}.items():
            column = start_column(description, name, value, count, self.inputs.names)
            for own, single in zip(values, column, strict=True):
                own[name] = single
        return values


def _death(code: int | None) -> str:
    """How a process ended."""
    if code is not None and code < 0:
        return f"its process died (signal {-code})"
    return f"its process ended (exit code {code})"
