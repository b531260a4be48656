"""`Estimate`: a severity with its interval."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray

__all__ = ["UNKNOWN", "Estimate"]

UNKNOWN = "unknown"
"""Name of what is none of the classes."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A severity and its central 90 % interval; NaN where a class has none."""

    value: NDArray
    low: NDArray
    high: NDArray
