"""`Arrow`: the curvature of an objective whose unknowns are shared, or belong to one trajectory.

Its matrix has the shape of an arrow: a block of the shared unknowns, a block per trajectory, and
what couples each of these with the first. The trajectories are eliminated one by one by the Schur
complement, so that time and memory are proportional to their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Arrow", "bounded_step"]

RIM = 1.1
"""Longest step over the radius of its trust region."""


@dataclass(frozen=True, eq=False)
class Arrow:
    """A symmetric matrix of k shared unknowns and then m of each of n trajectories.

    Attributes
    ----------
    shared : NDArray
        (k, k), of the shared unknowns.
    cross : NDArray
        (n, m, k), of those of a trajectory and the shared ones.
    own : NDArray
        (n, m, m), of those of a trajectory.

    """

    shared: NDArray
    cross: NDArray
    own: NDArray

    @property
    def diagonal(self) -> NDArray:
        """(k + n m,)."""
        own = np.diagonal(self.own, axis1=1, axis2=2)
        return np.concatenate([np.diag(self.shared), own.ravel()])

    @property
    def unit(self) -> NDArray:
        """Units (k + n m,) of the unknowns in which the diagonal is 1."""
        return 1 / np.sqrt(np.maximum(self.diagonal, 1e-300))

    def plus(self, diagonal: NDArray) -> Arrow:
        """The sum with a diagonal matrix (k + n m,)."""
        shared, own = self._split(diagonal)
        return Arrow(
            self.shared + np.diag(shared),
            self.cross,
            self.own + own[..., None] * np.eye(own.shape[1]),
        )

    def scaled(self, unit: NDArray) -> Arrow:
        """The matrix for unknowns in such units (k + n m,)."""
        shared, own = self._split(unit)
        return Arrow(
            shared[:, None] * self.shared * shared,
            own[..., None] * self.cross * shared,
            own[..., None] * self.own * own[:, None],
        )

    def reduced(self) -> tuple[NDArray, NDArray, NDArray]:
        """The Schur complement and what leads back from it.

        Returns
        -------
        complement : NDArray
            (k, k), of the shared unknowns where those of the trajectories follow.
        follow : NDArray
            (n, m, k), by how much they follow, with the sign reversed.
        inverse : NDArray
            (n, m, m), of `own`.

        """
        inverse = np.linalg.inv(self.own)
        follow = inverse @ self.cross
        return self.shared - np.tensordot(self.cross, follow, ([0, 1], [0, 1])), follow, inverse

    def solve(self, right: NDArray) -> NDArray:
        """The solution (k + n m,) of linear equations."""
        complement, follow, inverse = self.reduced()
        shared, own = self._split(right)
        x = np.linalg.solve(complement, shared - np.einsum("nmk,nm->k", follow, own))
        y = np.einsum("nij,nj->ni", inverse, own) - follow @ x
        return np.concatenate([x, y.ravel()])

    def times(self, vector: NDArray) -> NDArray:
        """The product (k + n m,) with a vector."""
        shared, own = self._split(vector)
        x = self.shared @ shared + np.einsum("nmk,nm->k", self.cross, own)
        y = self.cross @ shared + np.einsum("nij,nj->ni", self.own, own)
        return np.concatenate([x, y.ravel()])

    def _split(self, vector: NDArray) -> tuple[NDArray, NDArray]:
        """The shared part (k,) and that of the trajectories (n, m)."""
        k = len(self.shared)
        return vector[:k], vector[k:].reshape(self.own.shape[:2])


def trust_region_step(curvature: Arrow, gradient: NDArray, radius: float) -> NDArray:
    """The step that minimises a quadratic function within a trust region of all unknowns.

    Newton's method on 1 / length finds the damping with which the step ends at the region's rim;
    it begins below, from where it cannot overshoot (Nocedal and Wright, Numerical Optimization,
    2006, algorithm 4.3).

    Parameters
    ----------
    curvature : Arrow
        Positive semidefinite.
    gradient : NDArray
        (k + n m,).
    radius : float
        Length of the longest step, up to 10 %.

    """
    # Share of the largest curvature that is added to all, since some directions may have none.
    damping = 1e-12 * float(curvature.diagonal.max())
    # Newton steps at most to the damping of a step; a few suffice.
    for _ in range(50):
        damped = curvature.plus(np.full(len(gradient), damping))
        step = -damped.solve(gradient)
        length = float(np.linalg.norm(step))
        if length <= RIM * radius:
            break
        damping += length**2 / float(step @ damped.solve(step)) * (length / radius - 1)
    return step


def bounded_step(
    curvature: Arrow, gradient: NDArray, radius: float, low: NDArray, high: NDArray
) -> NDArray:
    """A step as by `trust_region_step` with bounds (k + n m,) of each component.

    Where a component meets its bound, it stays there, and the others go on (the primal active-set
    method: Nocedal and Wright, algorithm 16.3). It is NaN where the curvature or the gradient is.
    """
    step, fixed = np.zeros(len(gradient)), np.zeros(len(gradient), dtype=bool)
    while not fixed.all():
        slope = np.where(fixed, 0.0, gradient + curvature.times(step))
        own = curvature.scaled(1.0 - fixed).plus(1.0 * fixed)
        further = trust_region_step(own, slope, radius - float(np.linalg.norm(step)))
        ends = np.where(further > 0, high, low) - step
        with np.errstate(over="ignore"):  # one that does not move meets no bound
            share = np.divide(ends, further, out=np.full(len(step), np.inf), where=further != 0)
        share[fixed] = np.inf
        if not share.min() < 1:  # so NaN ends it, too
            return step + further
        step = step + share.min() * further
        fixed |= share <= share.min()
        if np.linalg.norm(step) >= radius / RIM:
            break
    return step
