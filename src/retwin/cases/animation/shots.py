"""`Shots`: the poses that the frames of a film show, independent of the renderer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Pictures = Iterable[NDArray]
"""Pictures (height, width, 4) of uint8, transparent where nothing is."""

GHOST = (0.47, 0.53, 0.60)
SOLID = (0.00, 0.41, 0.66)
UPDATED = (0.00, 0.53, 0.37)
PAPER = (0.97, 0.975, 0.98)
RING = (0.79, 0.81, 0.84)
"""Colours of the nominal motion, the observed one, the updated twin, background and rings."""


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
    poses : ndarray, shape (2, frames, joints)
        Joint positions in rad or m, nominal and observed.
    points : ndarray, shape (2, frames, k, 3)
        Points of the skeleton in m.
    drawn : ndarray, shape (draws, frames, 3), optional
        Positions of the tip in m that an updated twin draws; by default there are none.

    """

    title: str
    emulated: bool
    seconds: NDArray
    poses: NDArray
    points: NDArray
    drawn: NDArray = field(default_factory=lambda: np.empty((0, 0, 3)))

    def __len__(self) -> int:
        return len(self.seconds)

    def trails(self, frame: int, *, trail: float = 1.0) -> NDArray:
        """The paths (draws, frames, 3) of the draws that lead to a frame.

        Parameters
        ----------
        trail : float, default 1.0
            Seconds of its past path that a draw of the updated twin shows.

        """
        past = np.searchsorted(self.seconds, self.seconds[frame] - trail - 1e-9)
        return self.drawn[:, past : frame + 1]

    @property
    def root(self) -> NDArray:
        """Position (3,) of the base of the chain in m."""
        return self.points[0, 0, 0]

    @property
    def reach(self) -> float:
        """Largest possible distance from root to tip in m."""
        links = np.diff(self.points[0], axis=1)
        return float(np.linalg.norm(links, axis=2).sum(axis=1).max())

    @property
    def rings(self) -> list[NDArray]:
        """Circles (points, 3) in m on the floor around the root, at thirds of the reach."""
        angle = np.linspace(0, 2 * np.pi, 61)
        circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        return [self.root + fraction * self.reach * circle for fraction in (1 / 3, 2 / 3, 1)]


@dataclass(frozen=True)
class Camera:
    """A perspective camera that sees all that the tip can reach; MuJoCo's has the same parameters.

    Attributes
    ----------
    lookat : tuple of float
        Point (3,) in m in the middle of the picture.
    distance : float
        Distance of the camera from it in m.
    size : (int, int)
        Width and height of the picture in pixels.
    azimuth, elevation, field : float
        Direction of view, and vertical field of view, in degrees.

    """

    lookat: tuple[float, ...]
    distance: float
    size: tuple[int, int]
    azimuth: float = 130.0
    elevation: float = -18.0
    field: float = 45.0

    @classmethod
    def of(cls, shots: Shots, size: tuple[int, int]) -> Camera:
        """The camera of a film."""
        middle = np.add(shots.root, (0, 0, 0.38 * shots.reach)).tolist()
        return cls(tuple(middle), 2.75 * shots.reach * max(1.0, 4 / 3 * size[1] / size[0]), size)

    def project(self, points: NDArray) -> NDArray:
        """Pixels (..., 2), from the upper left corner, of points (..., 3) in m."""
        across, up = np.deg2rad((self.azimuth, self.elevation))
        view = np.array([np.cos(up) * np.cos(across), np.cos(up) * np.sin(across), np.sin(up)])
        right = np.array([np.sin(across), -np.cos(across), 0])
        seen = (points - self.lookat) @ np.stack([right, -np.cross(right, view), view], axis=1)
        width, height = self.size
        scale = height / 2 / np.tan(np.deg2rad(self.field / 2))
        return (width / 2, height / 2) + scale * seen[..., :2] / (self.distance + seen[..., 2:])
