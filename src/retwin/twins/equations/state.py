"""`State`: a state of a model, and what is known of it; and which parameters are dead times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from retwin.checks import one_of, require
from retwin.twins.wrappers.parametric import Parameter


@dataclass(frozen=True)
class State:
    """A state of a model, and what is known of it at the first sample.

    Parameters
    ----------
    name : str
        Name by which the equations find it.
    unit : str
        Its unit.
    start : float, optional
        Its value at the first sample, if it is known. Otherwise it is inferred where there are
        measurements, and simulations from commands alone begin at `initial`. Another value, one
        for all trajectories or one for each, can be given to `simulate` as the parameter
        `start_NAME`.
    low, high : float, optional
        Bounds of an unknown start, which is then a free parameter of `StateTwin.parametric`. With a
        `start` beside them, `identify` takes it as the same in all records; else each has its own.

    Raises
    ------
    InputError
        One bound alone, bounds out of order, or a start outside them.

    """

    name: str
    unit: str = "1"
    start: float | None = None
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        fits = (self.low is None) == (self.high is None) and np.isfinite(self.initial)
        expected = "a finite start, and both low and high or neither"
        got = f"start {self.start}, low {self.low}, high {self.high}"
        remedy = "give both bounds of an unknown start"
        require(fits, f"state {self.name!r}", expected=expected, got=got, remedy=remedy)
        self.unknown()

    @property
    def initial(self) -> float:
        """Its start; where none is given 0, or the middle of bounds that exclude 0."""
        if self.start is not None:
            return self.start
        if self.low is None or self.high is None or self.low <= 0 <= self.high:
            return 0.0
        return (self.low + self.high) / 2

    def unknown(self) -> tuple[Parameter, ...]:
        """The free parameter of an unknown start; empty for a known one."""
        if self.low is None or self.high is None:
            return ()
        return (Parameter(f"start_{self.name}", self.unit, self.low, self.high, self.initial),)


def check_delays(
    delays: Mapping[str, str], commands: Sequence[str], parameters: Sequence[Parameter]
) -> None:
    """Refuse dead times of unknown commands, and those that are no parameters in s from 0 on."""
    own = {each.name: each for each in parameters}
    for command, name in delays.items():
        one_of("delays", command, commands)
        parameter = own[one_of("delays", name, tuple(own))]
        fits = parameter.unit == "s" and parameter.low >= 0
        expected = "a parameter in s whose lowest value is at least 0"
        got = f"{name} in {parameter.unit}, from {parameter.low:g}"
        remedy = "give the parameter that unit and other bounds"
        require(fits, "delays", expected=expected, got=got, remedy=remedy)
