"""`CommandSide`: any twin with a delay and offsets of its commands as parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import interpolated
from retwin.data.trajectories import Channels
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Chunk, Twin, nominal_outputs
from retwin.twins.wrappers.parameter_values import AdjustableTwin
from retwin.twins.wrappers.parametric import Parameter
from retwin.twins.wrappers.wrapper import TwinWrapper, simulate_chunk

DELAY = "delay"
"""Name of the parameter that is the delay."""
OFFSET = "offset"


@dataclass(frozen=True)
class CommandSide(AdjustableTwin, TwinWrapper):
    """Any twin whose commands are delayed and offset: parameters `delay` and `offset.CHANNEL`.

    The transport delay in s is the same for all actuators. Each actuator has an offset in its
    command unit, constant from the first sample on. Both act after the faults of the reference and
    before a stuck actuator is held; the result is clipped to the twin's limits. Other parameters
    are passed to the wrapped twin.

    Parameters
    ----------
    twin : Twin
        The wrapped twin.
    nominal : callable, optional
        From clean commands (n, T, d_u) to the ideal output (n, T, d_y); by default the wrapped
        twin's nominal output, which costs a second simulation.

    """

    twin: Twin
    nominal: Callable[[NDArray], NDArray] | None = None

    def _run(self, chunk: Chunk) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs."""
        count, steps, _ = chunk.commands.shape
        rows, inner = np.arange(count), dict(chunk.parameters)
        offsets = (f"{OFFSET}.{name}" for name in self.inputs.names)
        late = inner.pop(DELAY, np.zeros(count))[:, None] * self.rate
        offset = np.stack([inner.pop(name, np.zeros(count)) for name in offsets], axis=-1)
        delayed = interpolated(chunk.faulty_commands, np.arange(steps) - late)
        effective = delayed + offset[:, None]
        if self.limits is not None:  # an actuator goes no further
            effective = np.clip(effective, self.limits.low, self.limits.high)
        responses = [fault and _ResponseOnly(fault) for fault in chunk.faults]
        given: Any = {"seed": chunk.seed, "parameters": inner}
        _, observed = simulate_chunk(self.twin, chunk, rows, effective, responses, **given)
        if self.nominal is not None:
            return nominal_outputs(self.nominal, chunk.commands, len(self.outputs)), observed
        nominal, _ = simulate_chunk(self.twin, chunk, rows, faults=[None] * count, **given)
        return nominal, observed


def command_side_parameters(
    inputs: Channels, *, delay: tuple[float, float], offset: float
) -> tuple[Parameter, ...]:
    """Declare the parameters of `CommandSide`.

    Parameters
    ----------
    inputs : Channels
        The d_u command channels.
    delay : (float, float)
        Lowest and highest delay in s; the start is the value nearest to 0.
    offset : float
        Highest magnitude of an offset in command units; the start is 0.

    Returns
    -------
    tuple of Parameter
        1 + d_u parameters, the delay first.

    """
    offsets = (
        Parameter(f"{OFFSET}.{name}", unit, -offset, offset, 0.0)
        for name, unit in zip(inputs.names, inputs.units, strict=True)
    )
    start = min(max(0.0, delay[0]), delay[1])
    return Parameter(DELAY, "s", *delay, start), *offsets


@dataclass(frozen=True)
class _ResponseOnly(Fault):
    """A fault without its effect on the reference, which has been applied already."""

    fault: Fault

    @property
    def label(self) -> str:
        """Class name of the fault."""
        return self.fault.label

    def drawn(
        self, rng: np.random.Generator, *, steps: int, segments: int, rate: float
    ) -> _ResponseOnly:
        """The fault itself: its severity is fixed already."""
        return self

    def response(self, response: NDArray, rate: float) -> NDArray:
        """The response with the fault."""
        return self.fault.response(response, rate)
