"""Faults of any system: a parameter, a sensor or an actuator that changes for a time.

Each has an onset and an end in seconds, and a size, of which 0 is no fault. What is given as a pair
(low, high) is open: `drawn` draws it uniformly, and an inversion infers it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.segments import Segments
from retwin.times import to_samples
from retwin.twins.faults.actuator_faults import (
    ActuatorBias,
    Fault,
    Faults,
    Stuck,
    checked_onset,
    ends_of,
    onset_samples,
)


@dataclass(frozen=True, kw_only=True)
class TimedFault(Fault):
    """The base of faults that act from an onset to an end.

    Parameters
    ----------
    onset : float or (float, float), default 0
        Time in s from which the fault acts, at least 0. A pair (low, high) is the range of a
        uniform draw of whole samples.
    end : float or (float, float), optional
        Time in s from which it acts no more, after the onset; by default it lasts. A pair is the
        range of a uniform draw.
    label : str
        Class name.

    Raises
    ------
    InputError
        Times that are negative, infinite, no numbers or out of order. When drawn: an onset after
        the end of the trajectory.

    """

    onset: float | tuple[float, float] = 0.0
    end: float | tuple[float, float] | None = None
    label: str = "Fault"

    def __post_init__(self) -> None:
        low, high = checked_onset(self.onset)
        if self.end is None:
            return
        first, last = ends_of(self.end)
        fits = low < first <= last < math.inf and high < last
        expected = f"a time in s after the onset at {self.onset}, or a pair (low, high) of them"
        remedy = "leave it out for a fault that lasts"
        require(fits, "end", expected=expected, got=repr(self.end), remedy=remedy)

    def onset_range(self, steps: int, rate: float) -> tuple[int, int]:
        """First and last sample at which it can begin in a trajectory of so many samples.

        Raises InputError if the earliest onset is after the end of the trajectory.
        """
        return onset_samples(self.onset, steps, rate)

    def end_range(self, steps: int, rate: float) -> tuple[int, int]:
        """First and last sample at which it can end; `steps` for a fault that lasts."""
        if self.end is None:
            return steps, steps
        low, high = (min(to_samples(each, rate), steps) for each in ends_of(self.end))
        return low, high

    def drawn(self, rng: np.random.Generator, *, steps: int, segments: int, rate: float) -> Self:
        """The same fault with all that is open drawn; see `Fault.drawn`."""
        first, last = self.onset_range(steps, rate)
        onset = int(rng.integers(first, last + 1))
        first, last = (max(each, onset + 1) for each in self.end_range(steps, rate))
        end = None if self.end is None else int(rng.integers(first, last + 1)) / rate
        return replace(self, onset=onset / rate, end=end)

    def active(self, steps: int, rate: float) -> NDArray:
        """Whether it acts at each sample, (T,) bool, for a fault of which nothing is open."""
        onset, end = self.onset_range(steps, rate)[0], self.end_range(steps, rate)[0]
        index = np.arange(steps)
        return (index >= onset) & (index < end)

    def measured(self, outputs: NDArray, rate: float) -> NDArray:
        """What sensors measure of outputs (T, d_y); unchanged, unless it is a fault of a sensor."""
        return outputs


@dataclass(frozen=True, kw_only=True)
class SizedFault(TimedFault):
    """The base of faults that have a size.

    Parameters
    ----------
    size : float or (float, float)
        The size, with its sign, not 0; a pair (low, high) is the range of a uniform draw.

    Raises
    ------
    InputError
        A size that is infinite, no number, 0, or a pair out of order; and see `TimedFault`.

    """

    grows: ClassVar[bool] = False
    """Whether the size is that per second since the onset."""
    size: float | tuple[float, float]

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = ends_of(self.size)
        fits = -math.inf < low <= high < math.inf and not low == high == 0
        expected = "a number other than 0, or a pair (low, high) in order"
        remedy = "give the sizes of real faults, with their sign"
        require(fits, "size", expected=expected, got=repr(self.size), remedy=remedy)

    def drawn(self, rng: np.random.Generator, *, steps: int, segments: int, rate: float) -> Self:
        """The same fault with all that is open drawn; see `Fault.drawn`."""
        size = float(rng.uniform(*ends_of(self.size)))
        made = super().drawn(rng, steps=steps, segments=segments, rate=rate)
        return replace(made, size=size)

    def profile(self, steps: int, rate: float) -> NDArray:
        """The effect at each sample, (T,), for a fault of which nothing is open; 0 elsewhere."""
        onset = self.onset_range(steps, rate)[0]
        size = np.array([ends_of(self.size)[0]])
        return self.profiles(self.active(steps, rate)[None], size, np.array([onset]), rate)[0]

    def profiles(self, active: NDArray, size: NDArray, onset: NDArray, rate: float) -> NDArray:
        """The effects (J, T) of sizes (J,) from onsets (J,) in samples on, where they act."""
        made: NDArray = size[:, None] * active
        since = np.arange(active.shape[1]) / rate - onset[:, None] / rate
        return made * since if self.grows else made


@dataclass(frozen=True)
class ParameterFault(SizedFault):
    """The base of faults of a parameter; see `ParameterShift` and `ParameterDrift`."""

    parameter: str


@dataclass(frozen=True)
class ParameterShift(ParameterFault):
    """A parameter of the twin differs by a constant: a leak, a clogged valve, a worn bearing.

    Parameters
    ----------
    parameter : str
        Name of a parameter of a `StateTwin`, which it may be 0 in for a healthy system.
    size : float or (float, float)
        What is added to it, in its unit.
    onset, end, label
        See `TimedFault`.

    """


@dataclass(frozen=True)
class ParameterDrift(ParameterFault):
    """A parameter of the twin that moves away from its value: wear, fouling, ageing.

    Parameters
    ----------
    parameter : str
        Name of a parameter of a `StateTwin`.
    size : float or (float, float)
        What is added to it per second, in its unit.
    onset, end, label
        See `TimedFault`; at its end the parameter is as before.

    """

    grows: ClassVar[bool] = True


@dataclass(frozen=True)
class ActuatorGain(SizedFault):
    """An actuator that does more or less than it is commanded.

    Parameters
    ----------
    actuator : int
        The command channel, counted from 0.
    size : float or (float, float)
        Relative change of the command: -0.3 is an actuator that is 30 % weaker, -1 a dead one.
    onset, end, label
        See `TimedFault`.

    """

    actuator: int

    def command(self, commands: NDArray, segments: Segments, rate: float) -> NDArray:
        """The commands with another gain of one actuator; see `Fault.command`."""
        made = commands.copy()
        made[:, self.actuator] *= 1 + self.profile(len(commands), rate)
        return made


@dataclass(frozen=True)
class SensorError(SizedFault):
    """The base of errors of one output; see `SensorBias`, `SensorDrift` and `SensorGain`."""

    relative: ClassVar[bool] = False
    """Whether the size is a share of the output; else it is added to it."""
    output: int

    def measured(self, outputs: NDArray, rate: float) -> NDArray:
        """The outputs (T, d_y) with the error."""
        made = outputs.copy()
        own = outputs[:, self.output] if self.relative else 1.0
        made[:, self.output] += own * self.profile(len(outputs), rate)
        return made


@dataclass(frozen=True)
class SensorBias(SensorError):
    """A sensor that measures too much or too little.

    Parameters
    ----------
    output : int
        The output channel, counted from 0.
    size : float or (float, float)
        What is added to it, in its unit.
    onset, end, label
        See `TimedFault`.

    """


@dataclass(frozen=True)
class SensorDrift(SensorError):
    """A sensor whose error grows from the onset on.

    Parameters
    ----------
    output : int
        The output channel, counted from 0.
    size : float or (float, float)
        What is added to it per second, in its unit.
    onset, end, label
        See `TimedFault`; at its end the error is 0 again.

    """

    grows: ClassVar[bool] = True


@dataclass(frozen=True)
class SensorGain(SensorError):
    """A sensor that measures its output times 1 + size: its span is not what it was.

    It acts about zero of the output's unit, as the span of most transmitters does, and not about
    the mean, which depends on how the machine was used. Where the output hardly varies it is the
    same as a `SensorBias`. An inversion expects as much noise as without it.

    Parameters
    ----------
    output : int
        The output channel, counted from 0.
    size : float or (float, float)
        Relative error, above -1: 0.05 is a sensor that reads 5 % too high.
    onset, end, label
        See `TimedFault`.

    """

    relative: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        low, remedy = ends_of(self.size)[0], "take SensorFreeze where the output has no effect"
        require(low > -1, "size", expected="more than -1", got=repr(self.size), remedy=remedy)


@dataclass(frozen=True)
class SensorFreeze(TimedFault):
    """A sensor that repeats the sample of the onset.

    Parameters
    ----------
    output : int
        The output channel, counted from 0.
    onset, end, label
        See `TimedFault`.

    """

    output: int

    def measured(self, outputs: NDArray, rate: float) -> NDArray:
        """The outputs (T, d_y), one of them constant while the fault acts."""
        active = self.active(len(outputs), rate)
        made = outputs.copy()
        made[active, self.output] = outputs[np.argmax(active), self.output]
        return made


FAULTS: tuple[type, ...] = (
    Stuck,
    ActuatorBias,
    ActuatorGain,
    ParameterShift,
    ParameterDrift,
    SensorBias,
    SensorDrift,
    SensorGain,
    SensorFreeze,
)
"""The kinds of faults that a file may name."""


def measured_with(observed: NDArray, faults: Faults, rate: float) -> NDArray:
    """Outputs (n, T, d_y) as sensors with these faults, one per trajectory, measure them."""
    rows = [i for i, fault in enumerate(faults) if isinstance(fault, TimedFault)]
    if not rows:
        return observed
    made = observed.copy()
    for i in rows:
        made[i] = faults[i].measured(observed[i], rate)  # type: ignore[union-attr]
    return made


def without_sensor_faults(faults: Faults) -> list[Fault | None]:
    """The faults without those of sensors, which act on what a wrapper makes of the outputs."""
    sensors = (SensorError, SensorFreeze)
    return [None if isinstance(fault, sensors) else fault for fault in faults]


def parameter_changes(faults: Faults, names: Sequence[str], steps: int, rate: float) -> NDArray:
    """What faults add to the parameters `names` at each sample, (n, T, q)."""
    made = np.zeros((len(faults), steps, len(names)))
    for i, fault in enumerate(faults):
        if isinstance(fault, ParameterFault):
            made[i, :, names.index(fault.parameter)] = fault.profile(steps, rate)
    return made


def check_faults(faults: Faults, inputs: int, outputs: int, shiftable: Sequence[str]) -> None:
    """Refuse faults of actuators, outputs and parameters that a twin does not have.

    Parameters
    ----------
    faults : sequence of Fault or None
        One per trajectory.
    inputs, outputs : int
        Numbers of commands and outputs of the twin.
    shiftable : sequence of str
        Its parameters that can change during a simulation.

    Raises
    ------
    InputError
        See above.

    """
    for fault in {id(fault): fault for fault in faults}.values():  # thousands are the same object
        for name, count in (("actuator", inputs), ("output", outputs)):
            fits = 0 <= getattr(fault, name, 0) < count or not hasattr(fault, name)
            expected = f"an {name} from 0 to {count - 1}"
            remedy = f"count the {'command' if name == 'actuator' else name} channels from 0"
            require(fits, "faults", expected=expected, got=fault, remedy=remedy)
        if isinstance(fault, ParameterFault):
            require(
                fault.parameter in shiftable,
                "faults",
                expected=f"one of the parameters {', '.join(shiftable)}"
                if shiftable
                else "a twin whose parameters can change during a simulation",
                got=fault,
                remedy="check the spelling"
                if shiftable
                else "take a StateTwin, or its corrected dynamics (retwin fit --dynamics): other "
                "twins, and surrogates, have no such parameters",
            )
