"""`Domain`: where states and commands were in calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["EXTRAPOLATED", "Domain"]

EXTRAPOLATED = 0.25
"""How far beyond its range in calibration, in widths of that, a variable of the discrepancy is
extrapolated. From there on it is held, since polynomials diverge."""


@dataclass(frozen=True)
class Domain:
    """The range of states and commands in calibration, by which variables are scaled.

    Attributes
    ----------
    low, high : NDArray
        (d_x + d_u,), of the states and then the commands.
    mean : NDArray
        (d_x + d_u,), their means.
    speed : NDArray
        (d_x,), root mean square of the time derivatives of the states, or of their steps.

    """

    low: NDArray
    high: NDArray
    mean: NDArray
    speed: NDArray

    @classmethod
    def visited(cls, states: NDArray, commands: NDArray, speed: NDArray) -> Domain:
        """The domain of states (n, T, d_x) and commands (n, T, d_u)."""
        both = np.concatenate([states, commands], axis=2)
        low, high, mean = (make(both, axis=(0, 1)) for make in (np.min, np.max, np.mean))
        return cls(low, high, np.clip(mean, low, high), speed)

    @cached_property
    def centre(self) -> NDArray:
        """Centres (d_x + d_u,): 0 where a range lies about it, for terms that are then simpler."""
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        return np.where(np.abs(middle) < half / 2, 0.0, middle)

    @cached_property
    def scale(self) -> NDArray:
        """Half widths (d_x + d_u,) about the centre; 1 for a constant."""
        half = np.maximum(self.high - self.centre, self.centre - self.low)
        return np.where(half > 0, half, 1.0)

    @cached_property
    def width(self) -> NDArray:
        """Widths (d_x + d_u,) of the ranges; that of a constant is its size, or 1 if it is 0."""
        size = np.where(self.high != 0, np.abs(self.high), 1.0)
        return np.where(self.high > self.low, self.high - self.low, size)

    def scaled(self, variables: Sequence[Any]) -> list[Any]:
        """States and commands, tensors, as variables of the discrepancy."""
        beyond = EXTRAPOLATED * (self.high - self.low)
        ends = (
            (each - self.centre) / self.scale for each in (self.low - beyond, self.high + beyond)
        )
        columns = (self.centre.tolist(), self.scale.tolist(), *(each.tolist() for each in ends))
        return [
            ((each - centre) / scale).clamp(low, high)
            for each, centre, scale, low, high in zip(variables, *columns, strict=True)
        ]

    def excess(self, states: NDArray, commands: NDArray) -> NDArray:
        """How far states (n, T, d_x) and commands (n, T, d_u) leave the domain, in widths of it.

        (d_x + d_u,), the most of all trajectories; those with states that are not finite do not
        count.
        """
        finite = np.isfinite(states).all(axis=(1, 2))
        if not finite.any():
            return np.zeros(len(self.low))
        both = np.concatenate([states[finite], commands[finite]], axis=2)
        beyond = np.maximum(both.max(axis=(0, 1)) - self.high, self.low - both.min(axis=(0, 1)))
        return np.maximum(beyond, 0.0) / self.width
