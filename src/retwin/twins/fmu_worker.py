"""The worker process of an FMU: it loads the FMU once and runs it again and again.

An FMU is native code. This module is the only one that loads it, and parent processes do not call
it.
"""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["RETRY", "Job", "load", "orphaned", "run", "start"]

RETRY = 75
"""Exit code of a process that ends before it begins a run, which another process has to do. The
code is that of sysexits.h for a temporary failure."""
MAX_INSTANCES = 500
"""Largest number of instances that one process makes. Some FMUs crash at about the thousandth."""
STATUS = ("ok", "warning", "discard", "error", "fatal", "pending")
FATAL = STATUS.index("fatal")
ROUNDING = 1e-9
"""Times in samples that are this close below a whole number count as that number: they round."""

Start = Mapping[str, float | str]


@dataclass(frozen=True)
class Job:
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


_folder: str
_job: Job
_instance: Instance | None = None


def start(folder: str, job: Job) -> None:
    """Prepare this process for runs.

    Parameters
    ----------
    folder : str
        Where the FMU is unpacked.
    job : Job
        Settings of the runs.

    """
    import fmpy  # noqa: F401  before the time limit of the first run begins

    global _folder, _job
    _folder, _job = folder, job
    # Python's handlers wait for native code to return, which a hung FMU never does.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # The output of an FMU must not mix with that of the program.
    os.dup2(2, 1)


def orphaned(folder: str, job: Job) -> None:
    """Remove the unpacked FMU when the parent process, which would have done it, has died.

    Parameters
    ----------
    folder, job
        See `start`.

    """
    shutil.rmtree(folder, ignore_errors=True)


def load() -> str:
    """Load the FMU, unless it is loaded.

    Returns
    -------
    str
        The reason why it cannot be loaded; "" when it is loaded.

    """
    global _instance
    if _instance is None:
        try:
            _instance = Instance(_folder, _job)
        except Exception as error:  # FMPy raises nothing more special
            return " ".join(str(error).split())
    return ""


def run(commands: NDArray, values: Start) -> NDArray | str:
    """Run the FMU once.

    Parameters
    ----------
    commands : ndarray, shape (T, d_u)
        Commands of one trajectory.
    values : mapping of str to float or str
        Start values.

    Returns
    -------
    ndarray, shape (T, d_y), or str
        Outputs, or the reason of the failure.

    """
    if _instance is not None and _instance.spent:
        # Until the parent has noted that this process took the task; otherwise it would be lost.
        time.sleep(0.2)
        os._exit(RETRY)
    reason = load()
    if _instance is None:
        return reason
    return _instance.run(commands, values)


class Instance:
    """An instance of the FMU, reset or made anew between runs; its library is loaded once.

    The constructor passes on FMPy's exceptions when the FMU cannot be loaded.
    """

    def __init__(self, folder: str, job: Job) -> None:
        from fmpy import read_model_description
        from fmpy.simulation import instantiate_fmu

        self.job = job
        self.description = read_model_description(folder, validate=False)
        self.version = self.description.fmiMajorVersion
        named = {variable.name: variable for variable in self.description.modelVariables}
        self.inputs = [named[name] for name in job.inputs]
        self.outputs = [named[name] for name in job.outputs]
        self.message = ""
        self.made = 1
        self.fresh, self.sound, self.spent = True, True, False
        self.slave = instantiate_fmu(folder, self.description, "CoSimulation", logger=self._log)

    def run(self, commands: NDArray, values: Start) -> NDArray | str:
        """See the function `run`."""
        from fmpy.fmi1 import FMICallException

        try:
            self._renew()
            self.fresh = False
            outputs = self._simulate(commands, values)
            self.sound = bool(np.isfinite(outputs).all())
            return outputs
        except FMICallException as error:
            self.sound, self.spent = False, self.spent or error.status == FATAL
            label = STATUS[error.status] if error.status < len(STATUS) else str(error.status)
            message = f" ({self.message})" if self.message else ""
            return f"FMI status {label} in {error.function}{message}"
        except Exception as error:  # FMPy raises nothing more special
            self.sound = False
            return " ".join(str(error).split())

    def _renew(self) -> None:
        """Restore the initial state: by a reset, or by another instance."""
        from fmpy.fmi1 import FMICallException

        self.message = ""
        if self.fresh:
            return
        if self.job.reuse and self.sound:
            try:
                self.slave.reset()
                return
            except FMICallException:
                pass
        # Not by FMPy's freeInstance, which would unload the library as well.
        getattr(self.slave, f"fmi{self.version}FreeInstance")(self.slave.component)
        if self.version == 2:
            self.slave.instantiate(callbacks=self.slave.callbacks)
        else:
            self.slave.instantiate(logMessage=self._log)
        self.made += 1
        self.sound, self.spent = True, self.made >= MAX_INSTANCES

    def _log(self, *message: Any) -> None:
        """Keep the last log message of the FMU: (…, status, category, text)."""
        self.message = " ".join(message[-1].decode("utf-8", "replace").split())

    def _simulate(self, commands: NDArray, values: Start) -> NDArray:
        """Outputs (T, d_y) at the samples; in each step the FMU has the inputs of its begin."""
        step = 1.0 / (self.job.rate * self.job.substeps)
        steps = (len(commands) - 1) * self.job.substeps
        table = self._table(commands)
        outputs = np.zeros((len(commands), len(self.outputs)))
        setters = [self._setter(columns, table) for columns in _by_type(self.inputs)]
        getters = [(columns, *self._getter(columns, outputs)) for columns in _by_type(self.outputs)]
        begin = self._initialise(values, setters, steps * step)
        for _, _, get in getters:
            get(0)
        for k in range(steps):
            for put in setters:
                put(k)
            outcome = self.slave.doStep(begin + k * step, step)
            if outcome is not None and outcome[1]:
                raise RuntimeError(f"the FMU ended its simulation at {begin + outcome[3]:g} s")
            if (k + 1) % self.job.substeps == 0:
                for _, _, get in getters:
                    get((k + 1) // self.job.substeps)
        for columns, rows, _ in getters:
            outputs[:, columns] = rows
        return outputs

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

    def _table(self, commands: NDArray) -> NDArray:
        """Inputs (K, d_u) at all communication points.

        Continuous inputs are linear between samples, others are held; an input with a rate of its
        own is sampled at that rate and held.
        """
        samples = np.arange(len(commands))
        points = np.arange((len(commands) - 1) * self.job.substeps + 1) / self.job.substeps
        table = np.empty((len(points), len(self.inputs)))
        for column, variable in enumerate(self.inputs):
            at = points
            if variable.name in self.job.rates:
                ratio = self.job.rate / self.job.rates[variable.name]
                at = np.floor(points / ratio + ROUNDING) * ratio
            if not is_continuous(variable):
                at = np.floor(at + ROUNDING)
            table[:, column] = np.interp(at, samples, commands[:, column])
        return table

    def _setter(self, columns: list[int], table: NDArray) -> Callable[[int], None]:
        """A function that sets the inputs in `columns`, all of one type, to row k of `table`."""
        variables = [self.inputs[column] for column in columns]
        kind, element = self._type(variables[0])
        return self._call(f"Set{kind}", variables, _as_type(table[:, columns], kind, element))

    def _getter(
        self, columns: list[int], outputs: NDArray
    ) -> tuple[NDArray, Callable[[int], None]]:
        """An array for the outputs in `columns`, of one type, and a function that fills row k."""
        variables = [self.outputs[column] for column in columns]
        kind, element = self._type(variables[0])
        rows = np.zeros((len(outputs), len(columns)), element)
        return rows, self._call(f"Get{kind}", variables, rows)

    def _type(self, variable: Any) -> tuple[str, Any]:
        """The name of a variable's type in FMI's functions, and its C type."""
        from fmpy import fmi2, fmi3

        kind = variable.type
        if kind == "Enumeration":
            kind = "Integer" if self.version == 2 else "Int64"
        return kind, getattr(fmi2 if self.version == 2 else fmi3, f"fmi{self.version}{kind}")

    def _call(self, name: str, variables: list[Any], rows: NDArray) -> Callable[[int], None]:
        """FMI's function `name` for row k of `rows`; twice as fast as FMPy's."""
        from ctypes import c_uint32

        count = len(variables)
        references = (c_uint32 * count)(*(variable.valueReference for variable in variables))
        buffers = (self._type(variables[0])[1] * count * len(rows)).from_buffer(rows)
        function = getattr(self.slave, f"fmi{self.version}{name}")
        component = self.slave.component
        if self.version == 2:
            return lambda k: function(component, references, count, buffers[k])
        return lambda k: function(component, references, count, buffers[k], count)


def is_continuous(variable: Any) -> bool:
    """Whether a variable is interpolated between its samples.

    Parameters
    ----------
    variable : fmpy.model_description.ScalarVariable
        An input.

    Returns
    -------
    bool
        True for continuous floating-point variables.

    """
    return variable.type in ("Real", "Float32", "Float64") and variable.variability == "continuous"


def _by_type(variables: list[Any]) -> list[list[int]]:
    """Indices of the variables of each type: FMI has one function per type."""
    kinds = [variable.type for variable in variables]
    return [[i for i, k in enumerate(kinds) if k == kind] for kind in dict.fromkeys(kinds)]


def _as_type(values: NDArray, kind: str, element: Any) -> NDArray:
    """`values` as C type; whole numbers are rounded and clipped to the range of the type."""
    dtype = np.dtype(element)
    if dtype.kind != "f":
        low, high = (0, 1) if kind == "Boolean" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        values = np.clip(np.rint(values), low, high)
    return np.ascontiguousarray(values, dtype)
