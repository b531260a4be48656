"""`Shots`: what the pictures of a film show, whatever draws them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["GHOST", "PAPER", "RING", "SOLID", "Pictures", "Shots", "rings"]

Pictures = Iterable[NDArray]
"""Pictures (height, width, 3) of uint8."""

GHOST = (0.47, 0.53, 0.60)
SOLID = (0.00, 0.41, 0.66)
PAPER = (0.97, 0.975, 0.98)
RING = (0.79, 0.81, 0.84)
"""Colours of the nominal and the observed motion, of the background, and of the floor's rings."""


@dataclass(frozen=True, eq=False)
class Shots:
    """One trajectory at the moments of its pictures.

    Attributes
    ----------
    title: id and class.
    emulated: whether a model made what stands for measurements.
    seconds: (frames,) the moments.
    nominal, observed: (frames, joints) joint positions.
    nominal_points, observed_points: (frames, k, 3) the skeleton in m.

    """

    title: str
    emulated: bool
    seconds: NDArray
    nominal: NDArray
    observed: NDArray
    nominal_points: NDArray
    observed_points: NDArray

    def __len__(self) -> int:
        return len(self.seconds)

    @property
    def root(self) -> NDArray:
        """Where the chain stands (3,), in m."""
        root: NDArray = self.nominal_points[0, 0]
        return root

    @property
    def reach(self) -> float:
        """Greatest distance from root to tip that the chain allows, in m."""
        links = np.diff(self.nominal_points, axis=1)
        return float(np.linalg.norm(links, axis=2).sum(axis=1).max())


def rings(root: NDArray, reach: float) -> list[NDArray]:
    """Circles (points, 3) on the floor around the root, at thirds of the reach."""
    angle = np.linspace(0, 2 * np.pi, 61)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return [root + share * reach * circle for share in (1 / 3, 2 / 3, 1)]
