"""An instance of an FMU in its worker process, which is run again and again."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.twins.fmu.access import groups_of
from retwin.twins.fmu.model import NUMBERS, find_scalars
from retwin.workers.process import Retired, more_time

MAX_INSTANCES = 500
"""Largest number of instances that one process makes. Some FMUs crash at about the thousandth."""
STATUS = ("ok", "warning", "discard", "error", "fatal", "pending")
DISCARD, FATAL = STATUS.index("discard"), STATUS.index("fatal")
LAST_TIME, TERMINATED = 2, 3
"""The kinds of status in FMI 2 that give the last successful time in s, and whether the FMU has
ended its simulation."""

Start = Mapping[str, float | str]


@dataclass(frozen=True)
class RunSettings:
    """Settings that all runs share.

    Parameters
    ----------
    inputs, outputs : tuple of str
        Names of variables, in order.
    rate : float
        Sample rate in Hz.
    substeps : int
        Communication steps per sample.
    rates : mapping of str to float
        Rates in Hz of inputs that are sampled and held at a rate of their own.
    reuse : bool
        Whether an instance is reset between runs, or made anew.

    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    rate: float
    substeps: int
    rates: Mapping[str, float]
    reuse: bool


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a run.

    Parameters
    ----------
    outputs : ndarray, shape (k, d_y)
        Outputs at the samples until the FMU ended, which are all T as a rule; none after a failure.
    reason : str, default ""
        The reason of a failure.
    ended : float, optional
        Time in s at which the FMU ended its simulation; None where it did not.
    forgets : bool, default False
        Whether the FMU was found not to restore its initial state when it is reset.

    """

    outputs: NDArray = field(default_factory=lambda: np.empty((0, 0)))
    reason: str = ""
    ended: float | None = None
    forgets: bool = False


@contextmanager
def _same_arithmetic() -> Iterator[None]:
    """Restore rounding mode and treatment of tiny numbers, which native code may change."""
    kept = ctypes.create_string_buffer(256)  # more than any system's fenv_t
    _floating_point().fegetenv(kept)
    try:
        yield
    finally:
        _floating_point().fesetenv(kept)


@cache
def _floating_point() -> ctypes.CDLL:
    """The library that holds C's functions of fenv.h; Python itself is linked to it."""
    return ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None)


class Instance:
    """An instance of the FMU, reset or made anew between runs; its library is loaded once.

    The constructor passes on FMPy's exceptions when the FMU cannot be loaded.
    """

    @_same_arithmetic()
    def __init__(self, folder: str, job: RunSettings) -> None:
        from fmpy import read_model_description
        from fmpy.simulation import instantiate_fmu

        self.job = job
        self.description = read_model_description(folder, validate=False)
        self.version = self.description.fmiMajorVersion
        self.inputs, self.outputs = (
            find_scalars(self.description, argument, names) if names else []
            for argument, names in (("inputs", job.inputs), ("outputs", job.outputs))
        )
        self.message = ""
        self.made = 1
        self.reuse, self.sound, self.spent = job.reuse, True, False
        self.fresh = self.pristine = True
        self.first: tuple[NDArray, Start, NDArray] | None = None
        self.forgets = self.unchecked = self.moved = False
        self.slave = instantiate_fmu(folder, self.description, "CoSimulation", logger=self._log)
        self.slave._call = _refusing_negative(self.slave._call)

    def run(self, commands: NDArray, values: Start) -> Outcome:
        """See the function `run`; a failure after a reset is confirmed by a new instance."""
        from fmpy.fmi1 import FMICallException

        while True:
            self._renew()
            pristine, self.fresh, self.sound = self.pristine, False, False
            try:
                outcome = self._simulate(commands, values)
            except FMICallException as error:
                self.spent = self.spent or error.status == FATAL
                known = error.status in range(len(STATUS))
                label = STATUS[error.status] if known else str(error.status)
                message = f" ({self.message})" if self.message else ""
                reason = f"FMI status {label} in {error.function}{message}"
            except Exception as error:  # FMPy raises nothing more special
                reason = " ".join(str(error).split())
            else:
                self._note(commands, values, outcome.outputs)
                return replace(outcome, forgets=self.forgets)
            if pristine:
                return Outcome(reason=reason, forgets=self.forgets)
            more_time()

    def _note(self, commands: NDArray, values: Start, outputs: NDArray) -> None:
        """Keep the first good run; have the renewal checked after the first that went elsewhere."""
        self.sound = bool(np.isfinite(outputs).all())
        if self.sound and self.first is None:
            self.first, self.unchecked = (commands, values, outputs), True
        elif self.first and not self.moved and not np.array_equal(outputs, self.first[2]):
            self.moved = self.unchecked = True

    def _renew(self, *, same: float = 1e-6) -> None:
        """Restore the initial state: by a reset, or by another instance or process.

        Parameters
        ----------
        same : float, default 1e-6
            Largest difference, relative to the largest output, between runs of one trajectory that
            count as equal in different instances, so that an FMU whose last digits vary needs no
            process per run.

        """
        self.message = ""
        if self.fresh:
            return
        if self.spent:
            raise Retired
        if self.reuse and self.sound and self._reset():
            if self._check_restored(self._reset, 0.0):
                return
            self.reuse, self.forgets = False, True
        self._another()
        if not self._check_restored(self._another, same):
            raise Retired(
                "runs differ with what their process ran before, even in a new instance; every run "
                "has a process of its own"
            )

    def _check_restored(self, renew: Callable[[], bool], tolerance: float) -> bool:
        """Whether the first trajectory has the same outputs again, if that is to be checked."""
        if self.first is None or not self.unchecked:
            return True
        commands, values, outputs = self.first
        more_time()
        try:
            again = self._simulate(commands, values).outputs
        except Exception:  # FMPy raises nothing more special
            return False
        finally:
            more_time()
        allowed = tolerance * np.abs(outputs).max(initial=0.0)
        same = again.shape == outputs.shape and bool((np.abs(again - outputs) <= allowed).all())
        self.unchecked = not same
        return same and renew()

    @_same_arithmetic()
    def _reset(self) -> bool:
        """Reset the instance; whether it could be done."""
        from fmpy.fmi1 import FMICallException

        try:
            self.slave.reset()
        except FMICallException:
            return False
        self.pristine = False
        return True

    @_same_arithmetic()
    def _another(self) -> bool:
        """Replace the instance by a new one; not by FMPy, which would unload the library too."""
        single = self.description.coSimulation.canBeInstantiatedOnlyOncePerProcess
        if self.made >= MAX_INSTANCES or single in (True, "true"):
            raise Retired
        getattr(self.slave, f"fmi{self.version}FreeInstance")(self.slave.component)
        try:
            if self.version == 2:
                self.slave.instantiate(callbacks=self.slave.callbacks)
            else:
                self.slave.instantiate(logMessage=self._log)
        except Exception:  # FMPy raises nothing more special
            raise Retired from None
        self.made += 1
        self.pristine = True
        return True

    def _log(self, *message: Any) -> None:
        """Keep the last log message of the FMU: (…, status, category, text)."""
        self.message = " ".join(message[-1].decode("utf-8", "replace").split())

    @_same_arithmetic()
    def _simulate(self, commands: NDArray, values: Start) -> Outcome:
        """Outputs at the samples; in each step the FMU has the inputs of its begin."""
        step = 1.0 / (self.job.rate * self.job.substeps)
        steps = (len(commands) - 1) * self.job.substeps
        inputs, groups = (
            groups_of(self.slave, self.version, some) for some in (self.inputs, self.outputs)
        )
        table = self._table(commands)
        setters = [each.setter(table) for each in inputs]
        getters = [(each, *each.getter(len(commands))) for each in groups]
        begin = self._initialise(values, setters, steps * step)
        for _, _, get in getters:
            get(0)
        known, ended = len(commands), None
        for k in range(steps):
            for put in setters:
                put(k)
            ended = self._step(begin + k * step, step)
            if ended is not None:
                known = k // self.job.substeps + 1
                break
            if (k + 1) % self.job.substeps == 0:
                for _, _, get in getters:
                    get((k + 1) // self.job.substeps)
        outputs = np.zeros((known, len(self.outputs)))
        for group, rows, _ in getters:
            outputs[:, group.columns] = rows[:known, group.places]
        return Outcome(outputs, ended=ended)

    def _step(self, time: float, step: float) -> float | None:
        """Do a communication step; the time in s at which the FMU ended its simulation, if it did.

        FMI 3 gives that with the step. In FMI 2 the step is discarded, and the FMU is asked.
        """
        from fmpy.fmi1 import FMICallException

        try:
            outcome = self.slave.doStep(time, step)
        except FMICallException as error:
            if self.version == 2 and error.status == DISCARD:
                with suppress(FMICallException):
                    if self.slave.getBooleanStatus(TERMINATED):
                        return float(self.slave.getRealStatus(LAST_TIME))
            raise
        if outcome is None:
            return None
        _, terminated, early, last = outcome
        if early and not terminated:
            raise RuntimeError(f"the FMU returned from its step at {last:g} s, which is too early")
        return float(last) if terminated else None

    def _initialise(
        self, values: Start, setters: list[Callable[[int], None]], duration: float
    ) -> float:
        """Set start values and first inputs, in FMI's order; returns the start time in s."""
        from fmpy.simulation import (
            apply_start_values,
            settable_in_initialization_mode,
            settable_in_instantiated,
        )

        slave, experiment = self.slave, self.description.defaultExperiment
        begin = float(getattr(experiment, "startTime", None) or 0.0)
        tolerance = getattr(experiment, "tolerance", None)
        times = {
            "tolerance": None if tolerance is None else float(tolerance),
            "startTime": begin,
            "stopTime": begin + duration,
        }
        if self.version == 2:
            slave.setupExperiment(**times)
        left = apply_start_values(slave, self.description, values, settable_in_instantiated)
        slave.enterInitializationMode(**({} if self.version == 2 else times))
        apply_start_values(slave, self.description, left, settable_in_initialization_mode)
        for put in setters:
            put(0)
        slave.exitInitializationMode()
        return begin

    def _table(self, commands: NDArray, *, rounding: float = 1e-9) -> NDArray:
        """Inputs (K, d_u) at all communication points.

        Continuous inputs are linear between samples, others are held; an input with a rate of its
        own is sampled at that rate and held.

        Parameters
        ----------
        rounding : float, default 1e-9
            Times in samples that are this close below a whole number count as that number: they
            round.

        """
        samples = np.arange(len(commands))
        points = np.arange((len(commands) - 1) * self.job.substeps + 1) / self.job.substeps
        table = np.empty((len(points), len(self.inputs)))
        for column, scalar in enumerate(self.inputs):
            at = points
            if scalar.name in self.job.rates:
                ratio = self.job.rate / self.job.rates[scalar.name]
                at = np.floor(points / ratio + rounding) * ratio
            kind = scalar.variable
            if kind.type not in NUMBERS or kind.variability != "continuous":
                at = np.floor(at + rounding)
            table[:, column] = np.interp(at, samples, commands[:, column])
        return table


def _refusing_negative(call: Callable[..., Any]) -> Callable[..., Any]:
    """FMPy's call of an FMI function, in which a negative status is a failure too."""
    from fmpy.fmi1 import FMICallException

    def checked(name: str, *arguments: Any) -> Any:
        status = call(name, *arguments)
        if isinstance(status, int) and status < 0:
            raise FMICallException(function=name, status=status)
        return status

    return checked
