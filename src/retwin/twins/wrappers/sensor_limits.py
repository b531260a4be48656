"""A twin whose outputs are read by sensors that stop at limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.wrappers.parametric import ParametricTwin, TakesParameters
from retwin.twins.wrappers.wrapper import TwinWrapper

TwinType = TypeVar("TwinType")


def limit_outputs(twin: ParametricTwin, limits: NDArray) -> ParametricTwin:
    """The same twin, whose outputs count as the limit where they are beyond it.

    Parameters
    ----------
    twin : ParametricTwin
        The twin.
    limits : NDArray
        (2, d_y), the lowest and the highest value of each output; infinite for none.

    """
    if isinstance(twin.twin, StateTwin) or not np.isfinite(limits).any():
        return limit_equations(twin, limits)
    return replace(twin, twin=_LimitedTwin(twin.twin, limits))


def limit_equations(twin: TwinType, limits: NDArray) -> TwinType:
    """State equations, alone or with their free parameters, whose outputs have limits (2, d_y).

    Derivatives are exact, and they can be saved. Any other twin is returned as it is.
    """
    made: Any = twin
    if not np.isfinite(limits).any():
        return twin
    if isinstance(twin, StateTwin):
        made = replace(twin, output=_limited_output(twin.output, limits))
    elif isinstance(twin, ParametricTwin):
        made = replace(twin, twin=limit_equations(twin.twin, limits))
    return made


def describe_limits(outputs: Sequence[str], limits: NDArray) -> str:
    """How limits (2, d_y) of the outputs' sensors were taken; "" if there are none."""
    ends = [
        f"{name} never {side} {end:.6g}"
        for name, own in zip(outputs, limits.T, strict=True)
        for side, end in zip(("below", "above"), own, strict=True)
        if np.isfinite(end)
    ]
    if not ends:
        return ""
    return (
        f"{', '.join(ends)}: taken for limits of the sensors, so that a simulated value beyond a "
        "limit agrees with a reading at it"
    )


def _limited_output(output: Callable[..., Any], limits: NDArray) -> Callable[..., Any]:
    """The outputs of state equations between limits (2, d_y)."""
    import torch

    from retwin.twins.compiled.model import with_parameters

    every = with_parameters(output)

    def read(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        made = every(x, u, p)
        if isinstance(made, torch.Tensor):
            made = made.unbind() if made.ndim else [made]
        values = made if isinstance(made, Sequence) else [made]
        return tuple(
            value.clamp(*ends)
            if isinstance(value, torch.Tensor) and np.isfinite(ends).any()
            else value
            for value, ends in zip(values, limits.T.tolist(), strict=True)
        )

    return read


@dataclass(frozen=True, eq=False)
class _LimitedTwin(TwinWrapper):
    """Any other twin with outputs between limits (2, d_y)."""

    twin: TakesParameters
    limits_of_outputs: NDArray

    @property
    def deterministic(self) -> bool:
        """Whether the wrapped twin declares that its outputs depend on no seed."""
        return getattr(self.twin, "deterministic", False)

    def simulate(self, commands: NDArray, **options: Any) -> Trajectories:
        """See `TakesParameters.simulate`."""
        made = self.twin.simulate(commands, **options)
        return made.replace(observed=np.clip(made.observed, *self.limits_of_outputs))
