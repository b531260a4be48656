"""`Limits`: which values channels can have physically; another one is no measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import one_of, require


@dataclass(frozen=True, eq=False)
class Limits:
    """The limits of d channels, commands first: `low` and `high` (d,), infinite where none are."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: NDArray
    high: NDArray

    @classmethod
    def of(cls, twin: Any, declared: Mapping[str, Sequence[float]]) -> Limits:
        """Those that are declared for channels of a twin; InputError if they are none."""
        names = (*twin.inputs.names, *twin.outputs.names)
        units = (*twin.inputs.units, *twin.outputs.units)
        low, high = np.full((2, len(names)), [[-np.inf], [np.inf]])
        for name, (least, most) in declared.items():
            place, got = names.index(one_of("limits", name, names)), f"{least:g} and {most:g}"
            expected, remedy = f"the smallest and then the largest value of {name}", "swap them"
            require(least < most, "limits", expected=expected, got=got, remedy=remedy)
            low[place], high[place] = least, most
        return cls(names, units, low, high)

    def outside(self, values: NDArray) -> NDArray:
        """Whether values (..., d) are impossible; one that is missing is not."""
        return np.asarray((values < self.low) | (values > self.high))

    def kept(self, values: NDArray) -> NDArray:
        """Values (..., d) of which those that are impossible are missing."""
        return np.where(self.outside(values), np.nan, values)

    def text(self, place: int, value: float | None = None) -> str:
        """What is wrong with the channel of that place, with the value if that is known."""
        unit = f" {self.units[place]}" if self.units[place] != "1" else ""
        shown = "" if value is None else f" {value:.6g}{unit}"
        return (
            f"{self.names[place]}{shown} is outside its limits {self.low[place]:g} to "
            f"{self.high[place]:g}{unit}: the sensor or its line is at fault"
        )
