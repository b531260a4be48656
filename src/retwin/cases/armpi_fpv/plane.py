"""The arm in its own plane: postures and ramps of three pitch joints that explain a path.

Three joints determine two outputs, so that a rest of the path admits a whole curve of postures.
Two facts make them unique. The targets of the real robot are whole command units: for each
direction of the last link the two links before it are solved in closed form, and only whole units
are kept. Usually one posture per rest remains, and the chain of rests with the lowest cost decides
(`grid_chain`). Simulated targets are continuous: there the ramps decide, by Gauss-Newton over
their combinations (`search`).

Postures are in command steps of 0.24 deg from straight, with the signs of `YawPitchArm`'s angles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

STEP = np.deg2rad(0.24)
"""Angle in rad of one command step."""
TURN = 1500
"""Steps in a full turn."""
LIMIT = 500
"""Largest angle of a motor to either side, in steps."""
TIE = 1.21
"""Ratio of mean square errors below which two explanations count as equally good (10 % in RMS)."""
FLOOR = 1e-18
"""Mean square error in m^2 below which explanations count as equally good: double precision."""
POSTURES_PER_REST = 24
"""Largest number of postures that are kept per rest; usually one or two are found."""
EDGES_PER_BLOCK = 4000
"""Number of pairs of postures whose costs are computed together, which bounds the memory."""
COMBINATIONS = np.stack([axis.ravel() for axis in np.indices((3, 3, 3))], axis=1)
"""Combinations (27, 3) of ramp durations: the index of each motor's duration."""


@dataclass(frozen=True)
class _Paths:
    """Arrays with one row per path, and perhaps the links, which all paths share."""

    def rows(self, rows: NDArray) -> Self:
        """Select paths.

        Parameters
        ----------
        rows : ndarray of int or bool
            Index of the paths.

        Returns
        -------
        Self
            The same quantities of these paths.

        """
        arrays = {name: each for name, each in vars(self).items() if name != "links"}
        return replace(self, **{name: each[rows] for name, each in arrays.items()})


@dataclass(frozen=True)
class Plane(_Paths):
    """n paths of M movements in the arm's plane.

    Attributes
    ----------
    links : tuple of float
        Lengths of the three links in m.
    radius, height : ndarray, shape (n, M, K)
        Samples of each movement in m, the height above the first pitch joint.
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

    links: tuple[float, ...]
    radius: NDArray
    height: NDArray
    parts: NDArray
    rests: NDArray
    tolerance: NDArray
    kinks: NDArray
    noise: NDArray


@dataclass(frozen=True)
class PlaneSolution(_Paths):
    """Postures and ramps that explain n paths of M movements.

    Attributes
    ----------
    postures : ndarray, shape (n, M + 1, 3)
        Postures of the rests in steps.
    lengths : ndarray of int, shape (n, M, 3)
        Index of each motor's ramp duration.
    cost : ndarray, shape (n, M)
        Mean square error of each movement in m^2.
    tied : ndarray of bool, shape (n, M)
        Movements that another explanation fits equally well.

    """

    postures: NDArray
    lengths: NDArray
    cost: NDArray
    tied: NDArray

    def join(self, other: PlaneSolution) -> PlaneSolution:
        """Concatenate the paths of two solutions.

        Parameters
        ----------
        other : PlaneSolution
            Paths of as many movements.

        Returns
        -------
        PlaneSolution
            These paths, then the other ones.

        """
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return PlaneSolution(*(np.concatenate(pair) for pair in pairs))


def forward(angles: NDArray, links: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Forward kinematics in the plane.

    Parameters
    ----------
    angles : ndarray, shape (..., 3)
        Postures in steps.
    links : tuple of float
        Lengths of the links in m.

    Returns
    -------
    radius, height : ndarray, shape (...)
        In m, the height above the first pitch joint.

    """
    one, two, three = links
    # Written out: sums along an axis of three are slow, and this is the innermost loop.
    first = angles[..., 0] * STEP
    second = first + angles[..., 1] * STEP
    third = second + angles[..., 2] * STEP
    radius = one * np.sin(first) + two * np.sin(second) + three * np.sin(third)
    return radius, one * np.cos(first) + two * np.cos(second) + three * np.cos(third)


def with_tip(
    radius: NDArray, height: NDArray, tip: NDArray, bend: NDArray, links: tuple[float, ...]
) -> NDArray:
    """Inverse kinematics for a given direction of the last link and a given elbow angle.

    Parameters
    ----------
    radius, height : ndarray, shape (...)
        Points in m.
    tip : ndarray, shape (...)
        Direction of the last link in steps.
    bend : ndarray, shape (...)
        Angle of the elbow in steps.
    links : tuple of float
        Lengths of the links in m.

    Returns
    -------
    ndarray, shape (..., 3)
        Postures in steps.

    """
    first, second, last = links
    wrist = np.arctan2(radius - last * np.sin(tip * STEP), height - last * np.cos(tip * STEP))
    inner = np.arctan2(second * np.sin(bend * STEP), first + second * np.cos(bend * STEP))
    base = (wrist - inner) / STEP
    posture = np.stack([base, bend, tip - base - bend], axis=-1)
    return (posture + TURN / 2) % TURN - TURN / 2


def bends(
    radius: NDArray, height: NDArray, tip: NDArray, slack: NDArray, links: tuple[float, ...]
) -> tuple[NDArray, NDArray]:
    """Range of elbow angles with which the arm attains points to within a tolerance.

    Parameters
    ----------
    radius, height : ndarray, shape (p,)
        Points in m.
    tip : ndarray, shape (q,)
        Directions of the last link in steps.
    slack : ndarray, shape (p,)
        Tolerance in m.
    links : tuple of float
        Lengths of the links in m.

    Returns
    -------
    low, high : ndarray, shape (p, q)
        In steps; low is above high where the point cannot be attained.

    """
    first, second, last = links
    distance = np.hypot(
        radius[:, None] - last * np.sin(tip * STEP), height[:, None] - last * np.cos(tip * STEP)
    )

    def bend(length: NDArray) -> NDArray:
        cosine = (length**2 - first**2 - second**2) / (2 * first * second)
        return np.arccos(np.clip(cosine, -1, 1)) / STEP

    near = np.maximum(distance - slack[:, None], 0)
    low = np.where(near <= first + second, bend(distance + slack[:, None]), np.inf)
    return low, bend(near)


def grid_postures(
    rests: NDArray, tolerance: NDArray, links: tuple[float, ...]
) -> tuple[NDArray, NDArray]:
    """Postures on whole steps within a tolerance of the rests.

    Parameters
    ----------
    rests : ndarray, shape (n, R, 2)
        Radius and height of each rest in m.
    tolerance : ndarray, shape (n,)
        Largest distance from a rest in m.
    links : tuple of float
        Lengths of the links in m.

    Returns
    -------
    rest : ndarray of int, shape (c,)
        Rest of each posture, counted path by path and in order.
    posture : ndarray, shape (c, 3)
        Postures in steps, at most `POSTURES_PER_REST` per rest, the nearest ones first.

    """
    radius, height = rests.reshape(-1, 2).T
    tolerance = np.repeat(tolerance, rests.shape[1])
    tip = np.arange(float(TURN))
    low, high = bends(radius, height, tip, tolerance, links)
    low, high = np.ceil(low), np.floor(high)
    # Where the elbow is nearly straight the window is wide enough for several whole steps.
    number = np.where(high >= low, high - low + 1, 0).astype(int)
    rest, column = np.nonzero(number)
    number = number[rest, column]
    rest, column = np.repeat(rest, number), np.repeat(column, number)
    bend = low[rest, column] + _count_up(number)
    rest, column = np.tile(rest, 2), np.tile(column, 2)
    bend = np.concatenate([bend, -bend])
    posture = np.rint(with_tip(radius[rest], height[rest], tip[column], bend, links))
    r, h = forward(posture, links)
    error = np.hypot(r - radius[rest], h - height[rest])
    keep = (error <= tolerance[rest]) & (np.abs(posture) <= LIMIT).all(axis=1)
    rest, posture, error = rest[keep], posture[keep], error[keep]
    keys = np.concatenate([rest[:, None], posture], axis=1)
    _, index = np.unique(keys, axis=0, return_index=True)
    index = index[np.lexsort((error[index], rest[index]))]
    rank = np.arange(index.size) - np.searchsorted(rest[index], rest[index])
    index = index[rank < POSTURES_PER_REST]
    return rest[index], posture[index]


def _count_up(number: NDArray) -> NDArray:
    """0, 1, ... number[0] - 1, 0, 1, ... number[1] - 1, and so on."""
    return np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)


def _ramp_costs(
    old: NDArray, new: NDArray, part: NDArray, radius: NDArray, height: NDArray, plane: Plane
) -> NDArray:
    """Mean square error (e, 27) of steps from postures (e, 3) to others for all ramps."""
    angle = old[:, None, None] + (new - old)[:, None, None] * part[..., None]
    one, two, three = np.moveaxis(angle * STEP, -1, 0)
    second = one[:, :, None] + two[:, None]
    third = second[:, :, :, None] + three[:, None, None]
    angles = [one[:, :, None, None], second[:, :, :, None], third]
    r = sum(link * np.sin(each) for link, each in zip(plane.links, angles, strict=True))
    h = sum(link * np.cos(each) for link, each in zip(plane.links, angles, strict=True))
    error = (r - radius[:, None, None, None]) ** 2 + (h - height[:, None, None, None]) ** 2
    cost = error.mean(axis=-1).reshape(-1, 27)
    # A motor that stays has no ramp: leave one combination of the equal ones.
    idle = ((old == new)[:, None] & (COMBINATIONS > 0)).any(axis=2)
    return np.where(idle, np.inf, cost)


def grid_chain(plane: Plane) -> tuple[NDArray, PlaneSolution]:
    """Find the chain of whole-step postures with the lowest cost.

    Parameters
    ----------
    plane : Plane
        n paths.

    Returns
    -------
    on_grid : ndarray of bool, shape (n,)
        Paths that have a posture on whole steps for every rest.
    solution : PlaneSolution
        Their explanation.

    """
    rests = plane.rests.shape[1]
    rest, posture = grid_postures(plane.rests, plane.tolerance, plane.links)
    number = np.bincount(rest, minlength=plane.tolerance.size * rests).reshape(-1, rests)
    on_grid: NDArray = np.all(number > 0, axis=1)
    keep = on_grid[rest // rests]
    rest, posture = rest[keep], posture[keep]
    rest = (np.cumsum(on_grid) - 1)[rest // rests] * rests + rest % rests
    return on_grid, _cheapest(plane.rows(on_grid), rest, posture)


def _cheapest(plane: Plane, rest: NDArray, posture: NDArray) -> PlaneSolution:
    """Chain of lowest cost through postures (c, 3) of `rest` (c,), at least one per rest."""
    count, moves = plane.noise.shape
    begin = np.searchsorted(rest, np.arange(count * (moves + 1) + 1))
    head = np.flatnonzero(rest % (moves + 1) < moves)
    number = np.diff(begin)[rest[head] + 1]
    head = np.repeat(head, number)
    tail = begin[rest[head] + 1] + _count_up(number)
    owner, move = np.divmod(rest[head], moves + 1)
    cost = np.empty((head.size, 27))
    for some in np.array_split(np.arange(head.size), head.size // EDGES_PER_BLOCK + 1):
        at = owner[some], move[some]
        cost[some] = _ramp_costs(
            posture[head[some]], posture[tail[some]],
            plane.parts[at], plane.radius[at], plane.height[at], plane,
        )  # fmt: skip
    best = cost.min(axis=1)
    ahead, behind = np.full((2, rest.size), np.inf)
    ahead[rest % (moves + 1) == 0], behind[rest % (moves + 1) == moves] = 0, 0
    for step in range(moves):
        at = move == step
        np.minimum.at(ahead, tail[at], ahead[head[at]] + best[at])
        at = move == moves - 1 - step
        np.minimum.at(behind, head[at], behind[tail[at]] + best[at])
    chain = ahead[head][:, None] + cost + behind[tail][:, None]
    solution = PlaneSolution(
        np.zeros((count, moves + 1, 3)), np.zeros((count, moves, 3), dtype=int),
        np.zeros((count, moves)), np.zeros((count, moves), dtype=bool),
    )  # fmt: skip
    # Postures of a rest are in order of their distance from it: this matters without movements.
    standing = begin[np.arange(count) * (moves + 1)]
    solution.postures[:, 0] = posture[standing]
    for step in range(moves):
        edge = np.flatnonzero(move == step)
        # The first step may start anywhere, the others where the one before ended.
        follow = edge if step == 0 else edge[head[edge] == standing[owner[edge]]]
        order = follow[np.lexsort((best[follow] + behind[tail[follow]], owner[follow]))]
        chosen = order[np.searchsorted(owner[order], np.arange(count))]
        standing = tail[chosen]
        if step == 0:
            solution.postures[:, 0] = posture[head[chosen]]
        solution.postures[:, step + 1] = posture[standing]
        solution.lengths[:, step] = COMBINATIONS[np.argmin(cost[chosen], axis=1)]
        solution.cost[:, step] = best[chosen]
        limit = chain[chosen].min(axis=1) + FLOOR
        limit += (TIE - 1) * (best[chosen] + plane.noise[:, step])
        as_good = (chain[edge] <= limit[owner[edge], None]).sum(axis=1)
        solution.tied[:, step] = np.bincount(owner[edge], as_good, count) > 1
    return solution
