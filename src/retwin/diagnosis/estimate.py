"""`Estimate`: a severity with its interval; and what no diagnosis can be made of."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray

from retwin.errors import InputError


@dataclass(frozen=True, eq=False)
class Estimate:
    """A severity and its central 90 % interval; NaN where a class has none."""

    value: NDArray
    low: NDArray
    high: NDArray


@dataclass(frozen=True)
class Calibration:
    """What the answer "unknown" of an inversion rests on.

    Parameters
    ----------
    runs : int, default 0
        Healthy trajectories from which its bound comes; 0 if that was not written.
    false_rate : float, default 0.01
        The largest share of healthy trajectories that is to be called unknown.
    outputs : tuple of str
        The outputs that were measured, without which a trajectory is unknown.
    simulated, below : int
        Healthy trajectories that the corrected twin simulated, and how many of them are unknown.

    """

    runs: int = 0
    false_rate: float = 0.01
    outputs: tuple[str, ...] = ()
    simulated: int = 0
    below: int = 0

    def __str__(self) -> str:
        if not self.runs:
            return "nothing is known of how often it calls a healthy trajectory unknown"
        few = self.runs < round(1 / self.false_rate) - 1
        doubt = ", which so few cannot show" if few else ""
        text = (
            f"the bound of unknown comes from {self.runs} healthy trajectories: "
            f"{self.false_rate:.2g} of further ones are to be unknown{doubt}; of "
            f"{self.simulated} that the corrected twin simulates, {self.below} are"
        )
        # Healthy trajectories below which their spread tells next to nothing of a further one.
        if self.runs < 3:
            text += (
                f". From {self.runs} of them foreign data cannot be recognised unless its errors "
                "are several times those in calibration"
            )
        return text


class ImplausibleError(InputError):
    """Measured values that no state of the system can have produced, whatever its noise."""
