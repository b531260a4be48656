"""`State`: a state of a model, and what is known of it at the first sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from retwin.checks import require
from retwin.twins.parametric import Parameter


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
        Bounds of an unknown start, which is then a free parameter of `StateTwin.parametric`.

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
        require(
            (self.low is None) == (self.high is None) and np.isfinite(self.initial),
            f"state {self.name!r}",
            expected="a finite start, and both low and high or neither",
            got=f"start {self.start}, low {self.low}, high {self.high}",
            remedy="give both bounds of an unknown start",
        )
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
