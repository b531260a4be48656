"""`Limits`: the range of every command channel, and what happens to commands outside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import row_blocks
from retwin.checks import one_of, one_per, require
from retwin.data.trajectories import Channels
from retwin.errors import InputError

UNLIMITED = "give -inf and inf where a channel has no limit"


@dataclass(frozen=True)
class Limits:
    """Lowest and highest command of every input channel.

    Parameters
    ----------
    low, high : tuple of float
        One per channel, in its unit; -inf and inf where a channel has no limit. Equal limits are
        those of a constant.
    outside : {"refuse", "clip"}
        Whether commands outside the limits are an error or are clipped to the limit.

    Raises
    ------
    InputError
        Not one low and one high per channel in order, or another word for `outside`.

    Notes
    -----
    Limits apply to the commands that an operator gives. A fault may move an effective command
    beyond them; what happens then is up to the twin.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    outside: Literal["refuse", "clip"] = "refuse"

    def __post_init__(self) -> None:
        paired = len(self.low) == len(self.high)
        fits = paired and all(a <= b for a, b in zip(self.low, self.high, strict=True))
        expected = "one low and one high per input channel, low at most high"
        got = f"low {self.low}, high {self.high}"
        require(fits, "limits", expected=expected, got=got, remedy=UNLIMITED)
        one_of("outside", self.outside, ("refuse", "clip"))

    def keep(self, commands: NDArray, inputs: Channels) -> NDArray:
        """Commands within the limits.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u)
            Commands in the channels' units.
        inputs : Channels
            The command channels, as many as there are limits.

        Returns
        -------
        ndarray, shape (n, T, d_u)
            The commands, clipped where `outside` is "clip".

        Raises
        ------
        InputError
            A command outside the limits where `outside` is "refuse", or another number of limits
            than of channels.

        """
        one_per("limits", self.low, len(inputs), "input channel", remedy=UNLIMITED)
        low = np.asarray(self.low, commands.dtype)
        high = np.asarray(self.high, commands.dtype)
        if self.outside == "clip":
            return np.clip(commands, low, high)
        for rows in row_blocks(commands):
            beyond = (commands[rows] < low) | (commands[rows] > high)
            if beyond.any():
                trajectory, sample, channel = np.argwhere(beyond)[0] + (rows.start, 0, 0)
                expected = f"{inputs.names[channel]} from {low[channel]:g} to {high[channel]:g} "
                expected += f"{inputs.units[channel]}"
                got = f"{commands[trajectory, sample, channel]:g} in trajectory {trajectory}, "
                got += f"sample {sample}"
                remedy = "keep the limits, or have commands clipped (outside='clip', or --clip)"
                raise InputError("commands", expected=expected, got=got, remedy=remedy)
        return commands
