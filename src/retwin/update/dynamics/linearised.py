"""Simulations at a point of the unknowns, and estimates near it, as `Estimation` makes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["HeldOut", "Linearised", "Point"]


@dataclass(frozen=True, eq=False)
class Point:
    """Values of the unknowns.

    Attributes
    ----------
    shared : NDArray
        (k,).
    starts : NDArray
        (n, m).

    """

    shared: NDArray
    starts: NDArray

    @property
    def flat(self) -> NDArray:
        """(k + n m,)."""
        return np.concatenate([self.shared, self.starts.ravel()])


@dataclass(frozen=True, eq=False)
class Linearised:
    """The simulation at a point, and sums over its samples of products of derivatives.

    Derivatives are those of the outputs by the P parameters and starts of the simulation.

    Attributes
    ----------
    point : Point
        Where it is, inside the bounds.
    residual : NDArray
        (n, T, d_y), measured minus simulated outputs, 0 where a sample does not count.
    products : NDArray
        (d_y, P, P + 1), of derivatives with each other and with the residual, over all samples.
    own : NDArray
        (d_y, n, m, P + 1), of derivatives by unknown starts with the same, over a trajectory.

    """

    point: Point
    residual: NDArray
    products: NDArray
    own: NDArray

    @property
    def finite(self) -> bool:
        """Whether the simulation and its derivatives are."""
        parts = (self.residual, self.products, self.own)
        return all(bool(np.isfinite(each).all()) for each in parts)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Estimates without each of K parts of the samples.

    Attributes
    ----------
    errors, variances : NDArray
        (n, T, d_y), the errors of each sample without the part to which it belongs, and their
        variances by the uncertainty of the unknowns.
    moves : NDArray
        (K, k), by how much the shared coordinates differ without each part.

    """

    errors: NDArray
    variances: NDArray
    moves: NDArray

    @property
    def variance(self) -> NDArray:
        """Variances (k,) of the shared coordinates by the jackknife over the parts.

        They hold for errors that are correlated in any way within a part.
        """
        count = len(self.moves)
        return (count - 1) * np.var(self.moves, axis=0)
