"""Access to numbers of an FMU instance, by FMI's functions for the numbers of one type."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.twins.fmu.model import Scalar


class VariableGroup:
    """Numbers of one type of an instance, which FMI sets and gets together.

    Parameters
    ----------
    slave : fmpy's object
        The instance.
    version : int
        Major version of FMI, 2 or 3.
    kind : str
        The type of the variables.
    scalars : sequence of Scalar
        Channels, of which those of this type belong to the group.

    Attributes
    ----------
    columns : list of int
        Columns of its channels.
    places : list of int
        Their places among the values of all its variables.

    """

    def __init__(self, slave: Any, version: int, kind: str, scalars: Sequence[Scalar]) -> None:
        from fmpy import fmi2, fmi3

        two = version == 2
        self._kind = {"Enumeration": "Integer" if two else "Int64"}.get(kind, kind)
        self._element = getattr(fmi2 if two else fmi3, f"fmi{version}{self._kind}")
        self._slave, self._version = slave, version
        self.columns = [i for i, each in enumerate(scalars) if each.variable.type == kind]
        own = [scalars[i] for i in self.columns]
        self._variables = {each.variable.name: each.variable for each in own}
        sizes = [prod(variable.shape) for variable in self._variables.values()]
        first = dict(zip(self._variables, np.cumsum([0, *sizes]).tolist(), strict=False))
        self.places = [first[each.variable.name] + each.place for each in own]
        self._count = sum(sizes)

    def setter(self, table: NDArray) -> Callable[[int], None]:
        """A function that sets the inputs of the group to row k of a table (K, d_u).

        Elements of an array that are no channels keep their start values. Whole numbers are
        rounded, and clipped to the range of their type.
        """
        starts = [_starts(variable) for variable in self._variables.values()]
        rows = np.tile(np.concatenate(starts), (len(table), 1))
        rows[:, self.places] = table[:, self.columns]
        dtype = np.dtype(self._element)
        if dtype.kind != "f":
            boolean = self._kind == "Boolean"
            low, high = (0, 1) if boolean else (np.iinfo(dtype).min, np.iinfo(dtype).max)
            rows = np.clip(np.rint(rows), low, high)
        return self._call("Set", np.ascontiguousarray(rows, dtype))

    def getter(self, count: int) -> tuple[NDArray, Callable[[int], None]]:
        """An array for the values of the group at `count` samples, and what fills its row k."""
        rows = np.zeros((count, self._count), self._element)
        return rows, self._call("Get", rows)

    def _call(self, verb: str, rows: NDArray) -> Callable[[int], None]:
        """FMI's function that gets or sets the group for row k of `rows`; faster than FMPy's."""
        from fmpy.fmi1 import FMICallException

        count = len(self._variables)
        numbers = (each.valueReference for each in self._variables.values())
        references = (ctypes.c_uint32 * count)(*numbers)
        buffers = (self._element * self._count * len(rows)).from_buffer(rows)
        name = f"fmi{self._version}{verb}{self._kind}"
        function, component = self._slave._functions[name], self._slave.component
        size = () if self._version == 2 else (self._count,)

        def call(k: int) -> None:
            status = function(component, references, count, buffers[k], *size)
            if not 0 <= status <= 1:  # neither ok nor a warning
                raise FMICallException(function=name, status=status)

        return call


def groups_of(slave: Any, version: int, scalars: Sequence[Scalar]) -> list[VariableGroup]:
    """The numbers of each type: FMI has one function per type."""
    kinds = dict.fromkeys(each.variable.type for each in scalars)
    return [VariableGroup(slave, version, kind, scalars) for kind in kinds]


def _starts(variable: Any) -> NDArray:
    """Start values of all elements of a variable; 0 where it declares none."""
    texts = str(variable.start or "0").split()
    numbers = [float({"false": 0, "true": 1}.get(text, text)) for text in texts]
    return np.resize(numbers, prod(variable.shape))
