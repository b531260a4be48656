"""What every twin offers: commands in, trajectories out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.errors import InputError
from retwin.faults import Fault
from retwin.trajectories import Channels, Progress, Trajectories

__all__ = ["HEALTHY", "Progress", "Twin", "checked_commands", "fault_labels"]

HEALTHY = "Healthy"


@runtime_checkable
class Twin(Protocol):
    """A simulator: plain, learned or corrected, all look the same."""

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        ...

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        ...

    @property
    def rate(self) -> float:
        """Samples per second."""
        ...

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """Simulate `commands` (n, T, d_u), each with its fault, if any.

        `nominal` of the result is the ideal output for the clean commands, `observed` what the
        twin says happens, `labels` the label of each fault. The same seed gives the same bytes.

        Raises
        ------
        InputError: commands of another width, NaN or infinite; not one fault per trajectory.

        """
        ...


def checked_commands(commands: ArrayLike, inputs: Channels) -> NDArray:
    """`commands` as a finite float array (n, T, d_u), or an InputError."""
    array = np.asarray(commands)
    if (
        array.ndim != 3
        or len(array) == 0
        or array.shape[2] != len(inputs)
        or array.dtype.kind not in "fiu"
    ):
        raise InputError(
            "commands",
            expected=f"numbers of shape (n, T, {len(inputs)})",
            got=f"{array.dtype} of shape {array.shape}",
            remedy=f"give one column per input channel, {', '.join(inputs.names)}",
        )
    if not np.isfinite(array).all():
        raise InputError(
            "commands",
            expected="finite numbers",
            got="NaN or an infinite value",
            remedy="commands are known inputs: repair or drop that trajectory",
        )
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def fault_labels(faults: Sequence[Fault | None]) -> NDArray:
    """The class name of each fault, `Healthy` for none."""
    return np.array([HEALTHY if fault is None else fault.label for fault in faults])
