"""`Estimate`: a severity with its interval; and what no diagnosis can be made of."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray

from retwin.errors import InputError

UNKNOWN = "unknown"
"""Name of what is none of the classes."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A severity and its central 90 % interval; NaN where a class has none."""

    value: NDArray
    low: NDArray
    high: NDArray


class ImplausibleError(InputError):
    """Measured values that no state of the system can have produced, whatever its noise."""
