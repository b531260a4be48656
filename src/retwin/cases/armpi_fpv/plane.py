"""The arm in its own plane: postures of three pitch joints that attain the rests of a path.

Three joints determine two outputs, so that a rest of the path admits a whole curve of postures.
The targets of the real robot are whole command units: for each direction of the last link the two
links before it are solved in closed form, and only whole units are kept, usually one posture.

Postures are in command steps of 0.24 deg from straight, with the signs of `YawPitchArm`'s angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.kinematics import YawPitchArm

STEP = np.deg2rad(0.24)
"""Angle in rad of one command step."""
TURN = 1500
"""Steps in a full turn."""
LIMIT = 500
"""Largest angle of a motor to either side, in steps."""


@dataclass(frozen=True)
class Plane:
    """n paths of M movements in the arm's plane.

    Attributes
    ----------
    arm : YawPitchArm
        The arm, with three links.
    data : ndarray, shape (n, M, K, 2)
        Samples of each movement in m: radius, and height above the first pitch joint.
    parts : ndarray, shape (n, M, 3, K)
        Finished fraction, at the samples, of a ramp of each of the three durations.
    rests : ndarray, shape (n, M + 1, 2)
        Radius and height of each rest in m.
    tolerance : ndarray, shape (n,)
        Largest distance in m of a posture from a rest.
    kinks : ndarray of bool, shape (n, M, 3)
        Where the path has the kink at the end of a ramp of that duration.
    noise : ndarray, shape (n, M)
        Mean square error of the movements in m^2 that does not stem from this plane.

    """

    arm: YawPitchArm
    data: NDArray
    parts: NDArray
    rests: NDArray
    tolerance: NDArray
    kinks: NDArray
    noise: NDArray


def attain(points: NDArray, tip: NDArray, bend: NDArray, arm: YawPitchArm) -> NDArray:
    """Inverse kinematics for a given direction of the last link and a given elbow angle.

    Parameters
    ----------
    points : ndarray, shape (..., 2)
        Radius and height in m.
    tip : ndarray, shape (...)
        Direction of the last link in steps.
    bend : ndarray, shape (...)
        Angle of the elbow in steps.
    arm : YawPitchArm
        The arm.

    Returns
    -------
    ndarray, shape (..., 3)
        Postures in steps.

    """
    first, second, last = arm.links
    wrist = np.arctan2(
        points[..., 0] - last * np.sin(tip * STEP), points[..., 1] - last * np.cos(tip * STEP)
    )
    inner = np.arctan2(second * np.sin(bend * STEP), first + second * np.cos(bend * STEP))
    base = (wrist - inner) / STEP
    posture = np.stack([base, bend, tip - base - bend], axis=-1)
    return (posture + TURN / 2) % TURN - TURN / 2


def bends(
    points: NDArray, tip: NDArray, slack: NDArray, arm: YawPitchArm
) -> tuple[NDArray, NDArray]:
    """Range of elbow angles with which the arm attains points to within a tolerance.

    Parameters
    ----------
    points : ndarray, shape (p, 2)
        Radius and height in m.
    tip : ndarray, shape (q,)
        Directions of the last link in steps.
    slack : ndarray, shape (p,)
        Tolerance in m.
    arm : YawPitchArm
        The arm.

    Returns
    -------
    low, high : ndarray, shape (p, q)
        In steps; low is above high where the point cannot be attained.

    """
    first, second, last = arm.links
    wrist = points[:, None] - last * np.stack([np.sin(tip * STEP), np.cos(tip * STEP)], axis=-1)
    distance = np.hypot(*np.moveaxis(wrist, -1, 0))

    def bend(length: NDArray) -> NDArray:
        cosine = (length**2 - first**2 - second**2) / (2 * first * second)
        return np.arccos(np.clip(cosine, -1, 1)) / STEP

    near = np.maximum(distance - slack[:, None], 0)
    low = np.where(near <= first + second, bend(distance + slack[:, None]), np.inf)
    return low, bend(near)


def grid_postures(plane: Plane, paths: NDArray, rest: int) -> tuple[NDArray, NDArray]:
    """Postures on whole steps within the tolerance of one rest of some paths.

    Parameters
    ----------
    plane : Plane
        All paths.
    paths : ndarray of int
        Index of those paths.
    rest : int
        Number of the rest, from 0.

    Returns
    -------
    path : ndarray of int, shape (c,)
        Path of each posture, ascending.
    posture : ndarray, shape (c, 3)
        Postures in steps, at most 24 per path, the nearest ones first.

    """
    points, tolerance = plane.rests[paths, rest], plane.tolerance[paths]
    tip = np.arange(float(TURN))
    low, high = bends(points, tip, tolerance, plane.arm)
    low, high = np.ceil(low), np.floor(high)
    # Where the elbow is nearly straight the window is wide enough for several whole steps.
    number = np.where(high >= low, high - low + 1, 0).astype(int)
    owner, column = np.nonzero(number)
    number = number[owner, column]
    owner, column = np.repeat(owner, number), np.repeat(column, number)
    within = np.arange(owner.size) - np.repeat(np.cumsum(number) - number, number)
    bend = low[owner, column] + within
    owner, column, bend = np.tile(owner, 2), np.tile(column, 2), np.concatenate([bend, -bend])
    posture = np.rint(attain(points[owner], tip[column], bend, plane.arm))
    distance = plane.arm.in_plane(posture * STEP) - points[owner]
    error = np.hypot(*distance.T)
    keep = (error <= tolerance[owner]) & (np.abs(posture) <= LIMIT).all(axis=1)
    owner, posture, error = owner[keep], posture[keep], error[keep]
    keys = np.concatenate([owner[:, None], posture], axis=1)
    _, index = np.unique(keys, axis=0, return_index=True)
    index = index[np.lexsort((error[index], owner[index]))]
    rank = np.arange(index.size) - np.searchsorted(owner[index], owner[index])
    # Largest number of postures that are kept per rest; usually one or two are found.
    index = index[rank < 24]
    return paths[owner[index]], posture[index]
