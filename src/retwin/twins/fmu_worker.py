"""What a worker process does with an FMU: load it once, then run it again and again.

An FMU is native code. This module is the only one that loads it, and no parent process calls it.
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

__all__ = ["AGAIN", "Job", "load", "orphaned", "run", "start"]

AGAIN = 75
"""Exit code of a process that was spent before it began a run: the run is to be asked for again."""
INSTANCES = 500
"""Instances one process makes at most. Some FMUs crash at about the thousandth."""
STATUS = ("ok", "warning", "discard", "error", "fatal", "pending")
FATAL = STATUS.index("fatal")
ROUNDING = 1e-9

Start = Mapping[str, float | str]


@dataclass(frozen=True)
class Job:
    """What all runs have in common.

    Parameters
    ----------
    inputs, outputs: names of variables, in order.
    rate: samples per second.
    substeps: communication steps per sample.
    rates: samples per second of the inputs that are held at a rate of their own.
    reuse: whether an instance is reset between runs, or made anew.

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
    """Make this process ready for runs of `job` with the FMU unpacked in `folder`."""
    import fmpy  # noqa: F401  loaded here, so that no run's time limit pays for it

    global _folder, _job
    _folder, _job = folder, job
    # Python's handlers wait for the native code to return, which a hung FMU never does.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # What an FMU prints must not mix with what the program prints.
    os.dup2(2, 1)


def orphaned(folder: str, job: Job) -> None:
    """Remove the unpacked FMU when the parent process, which would have done it, has died."""
    shutil.rmtree(folder, ignore_errors=True)


def load() -> str:
    """Why the FMU cannot be loaded here; "" when it is."""
    global _instance
    if _instance is None:
        try:
            _instance = Instance(_folder, _job)
        except Exception as error:  # FMPy raises nothing more special
            return " ".join(str(error).split())
    return ""


def run(commands: NDArray, values: Start) -> NDArray | str:
    """Outputs (T, d_y) for `commands` (T, d_u) and start values, or why there are none."""
    if _instance is not None and _instance.spent:
        # Time for the parent to hear that this process took the task, or it would be lost.
        time.sleep(0.2)
        os._exit(AGAIN)
    reason = load()
    if _instance is None:
        return reason
    return _instance.run(commands, values)


class Instance:
    """An instance of the FMU, reset or made anew between runs; its library is loaded once.

    Raises what FMPy raises when it cannot be loaded.
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
        self.said = ""
        self.made = 1
        self.fresh, self.sound, self.spent = True, True, False
        self.slave = instantiate_fmu(folder, self.description, "CoSimulation", logger=self._listen)

    def run(self, commands: NDArray, values: Start) -> NDArray | str:
        """See `run` of this module."""
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
            said = f" ({self.said})" if self.said else ""
            return f"FMI status {label} in {error.function}{said}"
        except Exception as error:  # FMPy raises nothing more special
            self.sound = False
            return " ".join(str(error).split())

    def _renew(self) -> None:
        """Back to where an instance begins: by a reset, or by another instance."""
        from fmpy.fmi1 import FMICallException

        self.said = ""
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
            self.slave.instantiate(logMessage=self._listen)
        self.made += 1
        self.sound, self.spent = True, self.made >= INSTANCES

    def _listen(self, *message: Any) -> None:
        """Keep what the FMU says last: (…, status, category, text)."""
        self.said = " ".join(message[-1].decode("utf-8", "replace").split())

    def _simulate(self, commands: NDArray, values: Start) -> NDArray:
        """Outputs after every sample's last step, in which the FMU saw inputs from its begin."""
        step = 1.0 / (self.job.rate * self.job.substeps)
        steps = (len(commands) - 1) * self.job.substeps
        table = self._table(commands)
        outputs = np.zeros((len(commands), len(self.outputs)))
        setters = [self._setter(columns, table) for columns in _by_type(self.inputs)]
        taken = [(columns, *self._getter(columns, outputs)) for columns in _by_type(self.outputs)]
        begin = self._initialise(values, setters, steps * step)
        for _, _, get in taken:
            get(0)
        for k in range(steps):
            for put in setters:
                put(k)
            said = self.slave.doStep(begin + k * step, step)
            if said is not None and said[1]:
                raise RuntimeError(f"the FMU ended its simulation at {begin + said[3]:g} s")
            if (k + 1) % self.job.substeps == 0:
                for _, _, get in taken:
                    get((k + 1) // self.job.substeps)
        for columns, rows, _ in taken:
            outputs[:, columns] = rows
        return outputs

    def _initialise(
        self, values: Start, setters: list[Callable[[int], None]], duration: float
    ) -> float:
        """Start values and first inputs, in FMI's order; gives the time of the begin in s."""
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

        Continuous inputs are linear between samples, others held; one with a rate of its own is
        sampled at that rate and held.
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
        """A call that sets the inputs in `columns`, all of one type, to row k of `table`."""
        variables = [self.inputs[column] for column in columns]
        kind, element = self._type(variables[0])
        return self._call(f"Set{kind}", variables, _as_type(table[:, columns], kind, element))

    def _getter(
        self, columns: list[int], outputs: NDArray
    ) -> tuple[NDArray, Callable[[int], None]]:
        """An array for the outputs in `columns`, all of one type, and a call that fills row k."""
        variables = [self.outputs[column] for column in columns]
        kind, element = self._type(variables[0])
        rows = np.zeros((len(outputs), len(columns)), element)
        return rows, self._call(f"Get{kind}", variables, rows)

    def _type(self, variable: Any) -> tuple[str, Any]:
        """What FMI's calls call the type of a variable, and its C type."""
        from fmpy import fmi2, fmi3

        kind = variable.type
        if kind == "Enumeration":
            kind = "Integer" if self.version == 2 else "Int64"
        return kind, getattr(fmi2 if self.version == 2 else fmi3, f"fmi{self.version}{kind}")

    def _call(self, name: str, variables: list[Any], rows: NDArray) -> Callable[[int], None]:
        """FMI's call `name` on row k of `rows`, without a copy: FMPy's own takes twice as long."""
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
    """Whether a variable may take values between its samples."""
    return variable.type in ("Real", "Float32", "Float64") and variable.variability == "continuous"


def _by_type(variables: list[Any]) -> list[list[int]]:
    """Which variables are of one type: FMI has one call per type."""
    kinds = [variable.type for variable in variables]
    return [[i for i, k in enumerate(kinds) if k == kind] for kind in dict.fromkeys(kinds)]


def _as_type(values: NDArray, kind: str, element: Any) -> NDArray:
    """`values` as C type; whole numbers are rounded and kept within the type's range."""
    dtype = np.dtype(element)
    if dtype.kind != "f":
        low, high = (0, 1) if kind == "Boolean" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        values = np.clip(np.rint(values), low, high)
    return np.ascontiguousarray(values, dtype)
