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
        yaw, pitch, links, radius = self._in_plane(angles)
        height = np.cos(pitch) @ links
        return np.stack([np.sin(yaw) * radius, -np.cos(yaw) * radius, self.base + height], axis=-1)

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
        yaw, pitch, links, radius = self._in_plane(angles)
        sine, cosine = np.sin(yaw), np.cos(yaw)
        # A pitch joint rotates every link behind it: sums from the tip inwards.
        d_radius = np.cumsum((np.cos(pitch) * links)[..., ::-1], axis=-1)[..., ::-1]
        d_height = -np.cumsum((np.sin(pitch) * links)[..., ::-1], axis=-1)[..., ::-1]
        by_yaw = np.stack([cosine * radius, sine * radius, np.zeros_like(radius)], axis=-1)
        by_pitch = np.stack(
            [sine[..., None] * d_radius, -cosine[..., None] * d_radius, d_height], axis=-2
        )
        return np.concatenate([by_yaw[..., None], by_pitch], axis=-1)

    def _in_plane(self, angles: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Yaw, pitch of each link, lengths of the links, and distance of the tip from the axis."""
        pitch = np.cumsum(angles[..., 1:], axis=-1)
        links = np.asarray(self.links, dtype=angles.dtype)
        return angles[..., 0], pitch, links, np.sin(pitch) @ links
