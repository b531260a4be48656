"""What can be drawn of the arm: its joints, and the pose behind a measured end-effector.

Only the end-effector is measured, three numbers for four joints. The observed pose is therefore an
inference for pictures: of all poses that put the end-effector where it was seen, the nearest to the
commanded one. A stuck motor may look like several that are a little off.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.closed_form import KinematicTwin
from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError

__all__ = ["ArmBody", "nearest_poses"]

MODEL = Path(__file__).with_name("armpi.xml")
NEARNESS = 5e-4
"""Weight of a joint's distance from its command against the end-effector's, in m/rad.

So small that the end-effector is met to some µm; near the straight pose, where the yaw is hardly
seen, it keeps the yaw at its command.
"""
STEPS = 8
BETTER = 0.5
"""The pose found from the command replaces the one that continues the motion at this share of its
cost: without the margin the picture would flicker between two that are as good.
"""


@dataclass(frozen=True)
class ArmBody:
    """The arm as a chain from the ground over its joints to the end-effector; see `Body`.

    Parameters
    ----------
    twin: kinematics, and what a command means in rad.
    model: MJCF file with joints `joint_1` … of the same order and sense.

    """

    twin: KinematicTwin
    model: Path | None = MODEL

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from the yaw joint to the last pitch joint."""
        return tuple(f"joint_{i + 1}" for i in range(self.twin.arm.joints))

    def poses(self, trajectories: Trajectories) -> tuple[NDArray, NDArray]:
        """Joint angles (n, T, joints) in rad: commanded, and nearest to what was observed.

        Where nothing was measured, the measured path is joined linearly.
        Raises InputError when commands or outputs are not those of the arm.
        """
        for name, has, needs in (
            ("commands", len(trajectories.inputs), self.twin.arm.joints),
            ("outputs", len(trajectories.outputs), 3),
        ):
            if has != needs:
                raise InputError(
                    name,
                    expected=f"{needs} channels, those of the arm",
                    got=f"{has}",
                    remedy="load the file with the arm's case, which completes commands",
                )
        nominal = self.twin.angles(trajectories.commands.astype(float))
        return nominal, nearest_poses(self.twin.arm, nominal, _joined(trajectories))

    def skeleton(self, joints: NDArray) -> NDArray:
        """Ground, shoulder, elbow, wrist and end-effector (..., 5, 3) in m."""
        arm = self.twin.arm
        points = [np.zeros((*joints.shape[:-1], 3))]
        for count in range(len(arm.links) + 1):
            part = YawPitchArm(arm.base, arm.links[:count])
            points.append(part.position(joints[..., : part.joints]))
        return np.stack(points, axis=-2)


def nearest_poses(arm: YawPitchArm, commanded: NDArray, tip: NDArray) -> NDArray:
    """Joint angles (n, T, joints) in rad that put the end-effector at `tip`, nearest to commanded.

    `commanded` (n, T, joints) in rad, `tip` (n, T, 3) in m. Minimises
    |position(q) - tip|² + NEARNESS² |q - commanded|² sample by sample, from the sample before and
    from the command, and stays with the former unless the latter is clearly better. A tip out of
    reach gives a pose that points to it.
    """
    out = np.empty_like(commanded)
    before = commanded[:, 0]
    chosen = np.arange(len(commanded))
    for t in range(commanded.shape[1]):
        goal = commanded[:, t]
        found, cost = _descend(arm, np.stack([before, goal]), goal, tip[:, t])
        before = found[(cost[1] < BETTER * cost[0]).astype(int), chosen]
        out[:, t] = before
    return out


def _descend(
    arm: YawPitchArm, start: NDArray, commanded: NDArray, tip: NDArray
) -> tuple[NDArray, NDArray]:
    """Damped Gauss-Newton from `start` (..., joints): the poses, and their cost (...)."""

    def cost_of(pose: NDArray) -> NDArray:
        miss, stray = tip - arm.position(pose), NEARNESS * (commanded - pose)
        return (miss**2).sum(axis=-1) + (stray**2).sum(axis=-1)

    pose, cost = start, cost_of(start)
    damping = np.full(cost.shape, 1e-4)
    eye = np.eye(start.shape[-1])
    for _ in range(STEPS):
        slope = arm.jacobian(pose)
        turned = np.swapaxes(slope, -1, -2)
        pull = turned @ (tip - arm.position(pose))[..., None]
        pull += NEARNESS**2 * (commanded - pose)[..., None]
        normal = turned @ slope + (NEARNESS**2 + damping)[..., None, None] * eye
        tried = pose + np.linalg.solve(normal, pull)[..., 0]
        new = cost_of(tried)
        better = new < cost
        pose = np.where(better[..., None], tried, pose)
        cost = np.where(better, new, cost)
        damping = np.where(better, damping / 10, damping * 10)
    return pose, cost


def _joined(trajectories: Trajectories) -> NDArray:
    """The measured path (n, T, 3) without gaps; nominal where a channel was never measured."""
    path = trajectories.observed.astype(float)
    time = np.arange(trajectories.steps)
    for i, channel in np.argwhere(~trajectories.mask.all(axis=1)):
        seen = trajectories.mask[i, :, channel]
        if seen.any():
            path[i, :, channel] = np.interp(time, time[seen], path[i, seen, channel])
        else:
            path[i, :, channel] = trajectories.nominal[i, :, channel]
    return path
