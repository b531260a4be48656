"""`check_parity`: whether a written file gives what torch gives."""

from __future__ import annotations

from torch import Tensor

from retwin.checks import require

PARITY = 1e-5
"""Greatest difference between a written file and torch, in the units of its outputs."""


def check_parity(
    argument: str, what: str, found: Tensor, expected: Tensor, unit: Tensor | float
) -> float:
    """The greatest difference between outputs of a file and of torch, in a unit.

    Parameters
    ----------
    argument : str
        The name of what was exported, for the message.
    what : str
        The file, for the message.
    found, expected : Tensor
        The outputs of the file, and those of torch.
    unit : float or Tensor
        The unit of the outputs, or one for each channel.

    Raises
    ------
    InputError
        It is greater than 1e-5.

    """
    error = float(((found - expected) / unit).abs().max())
    require(
        error <= PARITY,
        argument,
        expected=f"{what} that agrees with torch to {PARITY:g}",
        got=f"a difference of {error:.2g}",
        remedy="use it with torch, and report this: the file is wrong",
    )
    return error
