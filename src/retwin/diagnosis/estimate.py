"""`Estimate`: a severity with its interval."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray

__all__ = ["Estimate"]


@dataclass(frozen=True, eq=False)
class Estimate:
    """A severity and its central 90 % interval; NaN where a class has none."""

    value: NDArray
    low: NDArray
    high: NDArray
