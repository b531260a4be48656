"""Access to numbers of an FMU instance, by FMI's functions for the numbers of one type."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.twins.fmu.model import Scalar


@dataclass(frozen=True, eq=False)
class VariableGroup:
    """Numbers of one type, which FMI sets and gets together.

    Parameters
    ----------
    kind : str
        Name of the type in FMI's functions.
    element : ctypes type
        Its type in C.
    variables : list of fmpy.model_description.ModelVariable
        The variables, each once.
    columns : list of int
        Columns of the channels.
    places : list of int
        Their places among the values of all variables.
    count : int
        The number of values of all variables.

    """

    kind: str
    element: Any
    variables: list[Any]
    columns: list[int]
    places: list[int]
    count: int


@dataclass(frozen=True, eq=False)
class Access:
    """How numbers of an instance are set and read.

    Parameters
    ----------
    slave : fmpy's object
        The instance.
    version : int
        Major version of FMI, 2 or 3.

    """

    slave: Any
    version: int

    def setters(self, inputs: Sequence[Scalar], table: NDArray) -> list[Callable[[int], None]]:
        """Functions that set the inputs to row k of `table` (K, d_u), one for each type."""
        return [self._setter(group, table) for group in self._groups(inputs)]

    def getters(
        self, outputs: Sequence[Scalar], count: int
    ) -> list[tuple[VariableGroup, NDArray, Callable[[int], None]]]:
        """For each type the outputs, an array for `count` samples, and what fills its row k."""
        return [self._getter(group, count) for group in self._groups(outputs)]

    def _groups(self, scalars: Sequence[Scalar]) -> list[VariableGroup]:
        """The numbers of each type: FMI has one function per type."""
        groups = []
        for kind in dict.fromkeys(each.variable.type for each in scalars):
            columns = [i for i, each in enumerate(scalars) if each.variable.type == kind]
            variables = {scalars[i].variable.name: scalars[i].variable for i in columns}
            sizes = [prod(variable.shape) for variable in variables.values()]
            first = dict(zip(variables, np.cumsum([0, *sizes]).tolist(), strict=False))
            places = [first[scalars[i].variable.name] + scalars[i].place for i in columns]
            name, element = self._type(kind)
            groups.append(
                VariableGroup(name, element, list(variables.values()), columns, places, sum(sizes))
            )
        return groups

    def _setter(self, group: VariableGroup, table: NDArray) -> Callable[[int], None]:
        """A function that sets the inputs of a group to row k of `table`.

        Elements of an array that are no channels keep their start values.
        """
        starts = [_starts(variable) for variable in group.variables]
        rows = np.tile(np.concatenate(starts), (len(table), 1))
        rows[:, group.places] = table[:, group.columns]
        return self._call("Set", group, _as_type(rows, group))

    def _getter(
        self, group: VariableGroup, count: int
    ) -> tuple[VariableGroup, NDArray, Callable[[int], None]]:
        """A group, an array for its outputs at `count` samples, and a function that fills row k."""
        rows = np.zeros((count, group.count), group.element)
        return group, rows, self._call("Get", group, rows)

    def _type(self, kind: str) -> tuple[str, Any]:
        """The name of a type in FMI's functions, and the type in C."""
        from fmpy import fmi2, fmi3

        if kind == "Enumeration":
            kind = "Integer" if self.version == 2 else "Int64"
        return kind, getattr(fmi2 if self.version == 2 else fmi3, f"fmi{self.version}{kind}")

    def _call(self, verb: str, group: VariableGroup, rows: NDArray) -> Callable[[int], None]:
        """FMI's function that gets or sets a group for row k of `rows`; twice as fast as FMPy's."""
        from fmpy.fmi1 import FMICallException

        count = len(group.variables)
        references = (ctypes.c_uint32 * count)(*(each.valueReference for each in group.variables))
        buffers = (group.element * group.count * len(rows)).from_buffer(rows)
        name = f"fmi{self.version}{verb}{group.kind}"
        function, component = self.slave._functions[name], self.slave.component
        size = () if self.version == 2 else (group.count,)

        def call(k: int) -> None:
            status = function(component, references, count, buffers[k], *size)
            if not 0 <= status <= 1:  # neither ok nor a warning
                raise FMICallException(function=name, status=status)

        return call


def _starts(variable: Any) -> NDArray:
    """Start values of all elements of a variable; 0 where it declares none."""
    texts = str(variable.start or "0").split()
    numbers = [float({"false": 0, "true": 1}.get(text, text)) for text in texts]
    return np.resize(numbers, prod(variable.shape))


def _as_type(values: NDArray, group: VariableGroup) -> NDArray:
    """`values` as C type; whole numbers are rounded and clipped to the range of the type."""
    dtype = np.dtype(group.element)
    if dtype.kind != "f":
        boolean = group.kind == "Boolean"
        low, high = (0, 1) if boolean else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        values = np.clip(np.rint(values), low, high)
    return np.ascontiguousarray(values, dtype)
