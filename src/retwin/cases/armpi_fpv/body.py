"""Poses of the arm for drawing: joint angles behind a measured end-effector path.

Only the end-effector is measured, three numbers for four joints. The observed pose is therefore an
inference, used for pictures only: among all poses that put the end-effector at its measured
position, it is the one nearest to the commanded pose. The inferred pose of an arm with one stuck
motor may deviate from the command in several joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.gauss_newton import gauss_newton
from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.cases.armpi_fpv.twin import KinematicTwin
from retwin.checks import require
from retwin.data.trajectories import Trajectories

MODEL = Path(__file__).with_name("armpi.xml")
COMMAND_WEIGHT = 5e-4
"""Weight in m/rad of a joint's deviation from its command against the end-effector's error.

It is so small that the end-effector is met to a few µm. Near the straight pose, where the yaw
hardly affects the end-effector, it keeps the yaw at its command.
"""


@dataclass(frozen=True)
class ArmBody:
    """The arm as a chain from the ground over its joints to the end-effector; see `Body`.

    Parameters
    ----------
    twin : KinematicTwin
        Kinematics, and the joint angles of commands.
    model : Path, optional
        MJCF file with joints `joint_1`, … of the same order and sense of rotation.

    """

    twin: KinematicTwin
    model: Path | None = MODEL

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from the yaw joint to the last pitch joint."""
        return tuple(f"joint_{i + 1}" for i in range(self.twin.arm.joints))

    def poses(self, trajectories: Trajectories) -> tuple[NDArray, NDArray]:
        """Commanded poses, and the nearest poses that explain the observed outputs.

        Parameters
        ----------
        trajectories : Trajectories
            Trajectories of the arm; samples that were not measured are interpolated linearly.

        Returns
        -------
        nominal, observed : ndarray, shape (n, T, joints)
            Joint angles in rad.

        Raises
        ------
        InputError
            Commands or outputs are not those of the arm.

        """
        for name, has, needs in (
            ("commands", len(trajectories.inputs), self.twin.arm.joints),
            ("outputs", len(trajectories.outputs), 3),
        ):
            expected = f"{needs} channels, those of the arm"
            remedy = "load the file with the arm's case, which completes commands"
            require(has == needs, name, expected=expected, got=has, remedy=remedy)
        nominal = self.twin.angles(trajectories.commands.astype(float))
        return nominal, nearest_poses(self.twin.arm, nominal, _interpolate(trajectories))

    def skeleton(self, joints: NDArray) -> NDArray:
        """Ground, shoulder, elbow, wrist and end-effector.

        Parameters
        ----------
        joints : ndarray, shape (..., joints)
            Joint angles in rad.

        Returns
        -------
        ndarray, shape (..., 5, 3)
            Positions in m.

        """
        arm = self.twin.arm
        points = [np.zeros((*joints.shape[:-1], 3))]
        for count in range(len(arm.links) + 1):
            part = YawPitchArm(arm.base, arm.links[:count])
            points.append(part.position(joints[..., : part.joints]))
        return np.stack(points, axis=-2)


def nearest_poses(arm: YawPitchArm, commanded: NDArray, tip: NDArray) -> NDArray:
    """Poses that put the end-effector at given positions and are nearest to the commanded poses.

    Parameters
    ----------
    arm : YawPitchArm
        The kinematics.
    commanded : ndarray, shape (n, T, joints)
        Commanded joint angles in rad.
    tip : ndarray, shape (n, T, 3)
        End-effector positions in m.

    Returns
    -------
    ndarray, shape (n, T, joints)
        Joint angles in rad. For a position that the arm cannot attain, the pose points to it.

    Notes
    -----
    Each sample minimises |position(q) - tip|² + COMMAND_WEIGHT² |q - commanded|², once from the
    pose of the sample before and once from the command; the former is kept unless the latter has
    a clearly lower cost.

    """
    out = np.empty_like(commanded)
    before = commanded[:, 0]
    chosen = np.arange(len(commanded))
    stay = COMMAND_WEIGHT * np.eye(arm.joints)

    def evaluate(pose: NDArray, t: int) -> tuple[NDArray, NDArray]:
        deviation = COMMAND_WEIGHT * (pose - commanded[:, t])
        error = np.concatenate([arm.position(pose) - tip[:, t], deviation], axis=-1)
        slope = arm.jacobian(pose)
        fixed = np.broadcast_to(stay, (*slope.shape[:-2], *stay.shape))
        return error, np.concatenate([slope, fixed], axis=-2)

    for t in range(commanded.shape[1]):
        start = np.stack([before, commanded[:, t]])
        # Few steps suffice, since each sample starts at the pose of the sample before.
        found, cost = gauss_newton(partial(evaluate, t=t), start, rounds=8)
        # Ratio of costs below which the pose found from the command replaces the one that continues
        # the motion. Without this margin the picture would flicker between two poses of similar
        # cost.
        before = found[(cost[1] < 0.5 * cost[0]).astype(int), chosen]
        out[:, t] = before
    return out


def _interpolate(trajectories: Trajectories) -> NDArray:
    """The measured path (n, T, 3), interpolated; nominal where a channel was never measured."""
    path = trajectories.observed.astype(float)
    time = np.arange(trajectories.steps)
    for i, channel in np.argwhere(~trajectories.mask.all(axis=1)):
        seen = trajectories.mask[i, :, channel]
        if seen.any():
            path[i, :, channel] = np.interp(time, time[seen], path[i, seen, channel])
        else:
            path[i, :, channel] = trajectories.nominal[i, :, channel]
    return path
