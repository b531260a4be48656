"""`Shots`: the poses that the frames of a film show, independent of the renderer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Pictures = Iterable[NDArray]
"""Pictures (height, width, 3) of uint8."""

GHOST = (0.47, 0.53, 0.60)
SOLID = (0.00, 0.41, 0.66)
UPDATED = (0.00, 0.53, 0.37)
PAPER = (0.97, 0.975, 0.98)
RING = (0.79, 0.81, 0.84)
"""Colours of the nominal motion, the observed one, the updated twin, background and rings."""
TRAIL = 1.0
"""Seconds of its past path that a draw of the updated twin shows."""


@dataclass(frozen=True, eq=False)
class Shots:
    """One trajectory at the times of its frames.

    Attributes
    ----------
    title : str
        Id and class of the trajectory.
    emulated : bool
        Whether a model made the data that stand in for measurements.
    seconds : ndarray, shape (frames,)
        Times in s.
    nominal, observed : ndarray, shape (frames, joints)
        Joint positions in rad or m.
    nominal_points, observed_points : ndarray, shape (frames, k, 3)
        Points of the skeleton in m.
    drawn : ndarray, shape (draws, frames, 3), optional
        Positions of the tip in m that an updated twin draws; by default there are none.

    """

    title: str
    emulated: bool
    seconds: NDArray
    nominal: NDArray
    observed: NDArray
    nominal_points: NDArray
    observed_points: NDArray
    drawn: NDArray = field(default_factory=lambda: np.empty((0, 0, 3)))

    def __len__(self) -> int:
        return len(self.seconds)

    def trails(self, frame: int) -> NDArray:
        """The paths (draws, frames, 3) of the draws that lead to a frame."""
        past = np.searchsorted(self.seconds, self.seconds[frame] - TRAIL - 1e-9)
        return self.drawn[:, past : frame + 1]

    @property
    def root(self) -> NDArray:
        """Position (3,) of the base of the chain in m."""
        return self.nominal_points[0, 0]

    @property
    def reach(self) -> float:
        """Largest possible distance from root to tip in m."""
        links = np.diff(self.nominal_points, axis=1)
        return float(np.linalg.norm(links, axis=2).sum(axis=1).max())


def rings(root: NDArray, reach: float) -> list[NDArray]:
    """Circles on the floor around the root, at thirds of the reach.

    Parameters
    ----------
    root : ndarray, shape (3,)
        Base of the chain in m.
    reach : float
        Largest distance from root to tip in m.

    Returns
    -------
    list of ndarray, shape (points, 3)
        Three closed polygons in m.

    """
    angle = np.linspace(0, 2 * np.pi, 61)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return [root + fraction * reach * circle for fraction in (1 / 3, 2 / 3, 1)]
