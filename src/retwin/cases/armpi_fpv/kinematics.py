"""Closed-form kinematics of a serial arm: one yaw joint, then pitch joints in one plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class YawPitchArm:
    """A yaw joint about z and pitch joints about x; links along z when all angles are 0.

    Parameters
    ----------
    base : float
        Height of the first pitch joint above the ground in m.
    links : tuple of float
        Length in m of the link behind each pitch joint.

    """

    base: float
    links: tuple[float, ...]

    @property
    def joints(self) -> int:
        """Number of joints: the yaw joint and one per link."""
        return 1 + len(self.links)

    @property
    def reach(self) -> float:
        """Height of the end-effector in m when the arm stands straight up."""
        return self.base + sum(self.links)

    def position(self, angles: NDArray) -> NDArray:
        """Forward kinematics.

        Parameters
        ----------
        angles : ndarray, shape (..., joints)
            Joint angles in rad.

        Returns
        -------
        ndarray, shape (..., 3)
            End-effector position in m.

        """
        radius, height = np.moveaxis(self.in_plane(angles[..., 1:]), -1, 0)
        sine, cosine = np.sin(angles[..., 0]), np.cos(angles[..., 0])
        return np.stack([sine * radius, -cosine * radius, self.base + height], axis=-1)

    def jacobian(self, angles: NDArray) -> NDArray:
        """Jacobian of `position`.

        Parameters
        ----------
        angles : ndarray, shape (..., joints)
            Joint angles in rad.

        Returns
        -------
        ndarray, shape (..., 3, joints)
            Derivatives in m/rad.

        """
        radius = self.in_plane(angles[..., 1:])[..., 0]
        sine, cosine = np.sin(angles[..., 0]), np.cos(angles[..., 0])
        d_radius, d_height = np.moveaxis(self.jacobian_in_plane(angles[..., 1:]), -2, 0)
        by_yaw = np.stack([cosine * radius, sine * radius, np.zeros_like(radius)], axis=-1)
        by_pitch = np.stack(
            [sine[..., None] * d_radius, -cosine[..., None] * d_radius, d_height], axis=-2
        )
        return np.concatenate([by_yaw[..., None], by_pitch], axis=-1)

    def in_plane(self, angles: NDArray) -> NDArray:
        """Forward kinematics of the pitch joints in the arm's vertical plane.

        Parameters
        ----------
        angles : ndarray, shape (..., links)
            Angles of the pitch joints in rad.

        Returns
        -------
        ndarray, shape (..., 2)
            Signed distance of the end-effector from the yaw axis, and its height above the first
            pitch joint, in m.

        """
        pitch, links = self._pitch(angles)
        return np.stack([np.sin(pitch) @ links, np.cos(pitch) @ links], axis=-1)

    def jacobian_in_plane(self, angles: NDArray) -> NDArray:
        """Jacobian of `in_plane`.

        Parameters
        ----------
        angles : ndarray, shape (..., links)
            Angles of the pitch joints in rad.

        Returns
        -------
        ndarray, shape (..., 2, links)
            Derivatives in m/rad.

        """
        pitch, links = self._pitch(angles)
        each = np.stack([np.cos(pitch) * links, -np.sin(pitch) * links], axis=-2)
        # A pitch joint rotates every link behind it: sums from the tip inwards.
        return each @ np.tri(len(links), dtype=angles.dtype)

    def _pitch(self, angles: NDArray) -> tuple[NDArray, NDArray]:
        """Pitch (..., links) of each link, and their lengths."""
        links = np.asarray(self.links, dtype=angles.dtype)
        # A product with ones is faster than a sum along a short axis.
        return angles @ np.tri(len(links), dtype=angles.dtype).T, links
