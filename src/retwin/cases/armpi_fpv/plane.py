"""The arm in its own plane: which postures and ramps of three pitch joints explain a path.

Three joints give two outputs, so a rest alone leaves a whole curve of postures. Two things
single one out. Real targets are whole command units: for each direction of the last link the two
links before it are solved in closed form, and only whole units are kept; usually one posture per
rest survives, and the cheapest chain of rests decides (`grid_chain`). Simulated targets are
continuous: there the ramps decide, by Gauss-Newton over their combinations (`armpi_search`).

Postures are in command steps of 0.24 deg from straight, signed as `YawPitchArm`'s angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "COMBINATIONS",
    "FLOOR",
    "LIMIT",
    "STEP",
    "TIE",
    "TURN",
    "Plane",
    "Solution",
    "bends",
    "forward",
    "grid_chain",
    "grid_postures",
    "with_tip",
]

STEP = np.deg2rad(0.24)
TURN = 1500  # steps in a full turn
LIMIT = 500  # steps a motor can turn to either side
TIE = 1.21  # mean squares closer than this cannot be told apart ...
FLOOR = 1e-18  # ... nor those below this, in m^2: double precision is reached

_MOST = 24  # postures kept per rest
# (27, 3): indices of the ramp lengths of the three motors.
COMBINATIONS = np.stack([axis.ravel() for axis in np.indices((3, 3, 3))], axis=1)


@dataclass(frozen=True)
class Plane:
    """n paths of M movements in the arm's plane.

    Attributes
    ----------
    links: lengths of the three links in m.
    radius, height: (n, M, K) samples of each movement in m, height above the first pitch joint.
    parts: (n, M, 3, K) finished part of a ramp of each of the three lengths at the samples.
    rests: (n, M + 1, 2) radius and height in m of each rest.
    tolerance: (n,) how far in m a posture may be from a rest.
    kinks: (n, M, 3) True where the path surely has the kink of a ramp of that length ending.
    noise: (n, M) mean square error in m^2 that movements have apart from this plane.

    """

    links: tuple[float, ...]
    radius: NDArray
    height: NDArray
    parts: NDArray
    rests: NDArray
    tolerance: NDArray
    kinks: NDArray
    noise: NDArray

    def rows(self, rows: NDArray) -> Plane:
        """Some of the paths."""
        return Plane(
            self.links,
            *(getattr(self, name)[rows] for name in list(self.__dataclass_fields__)[1:]),
        )


@dataclass(frozen=True)
class Solution:
    """What explains n paths: postures of the rests (n, M + 1, 3) in steps, indices (n, M, 3) of
    the ramp lengths, mean square errors `cost` (n, M) in m^2, and which movements are `tied`
    (n, M) with another explanation.
    """

    postures: NDArray
    lengths: NDArray
    cost: NDArray
    tied: NDArray

    def rows(self, rows: NDArray) -> Solution:
        """Some of the paths."""
        return Solution(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def join(self, other: Solution) -> Solution:
        """These paths and then the other ones."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return Solution(*(np.concatenate(pair) for pair in pairs))


def forward(angles: NDArray, links: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Radius and height of postures (..., 3) in steps."""
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
    """Postures (..., 3) in steps that have the last link in direction `tip` and elbow `bend`."""
    first, second, last = links
    wrist = np.arctan2(radius - last * np.sin(tip * STEP), height - last * np.cos(tip * STEP))
    inner = np.arctan2(second * np.sin(bend * STEP), first + second * np.cos(bend * STEP))
    base = (wrist - inner) / STEP
    posture = np.stack([base, bend, tip - base - bend], axis=-1)
    return (posture + TURN / 2) % TURN - TURN / 2


def bends(
    radius: NDArray, height: NDArray, tip: NDArray, slack: NDArray, links: tuple[float, ...]
) -> tuple[NDArray, NDArray]:
    """Least and greatest bend of the elbow in steps that reach points (p,) to within `slack`.

    Both are (p, tips); the least is above the greatest where the point is out of reach.
    """
    first, second, last = links
    reach = np.hypot(
        radius[:, None] - last * np.sin(tip * STEP), height[:, None] - last * np.cos(tip * STEP)
    )

    def bend(distance: NDArray) -> NDArray:
        cosine = (distance**2 - first**2 - second**2) / (2 * first * second)
        return np.arccos(np.clip(cosine, -1, 1)) / STEP

    near = np.maximum(reach - slack[:, None], 0)
    least = np.where(near <= first + second, bend(reach + slack[:, None]), np.inf)
    return least, bend(near)


def grid_postures(
    rests: NDArray, tolerance: NDArray, links: tuple[float, ...]
) -> tuple[NDArray, NDArray]:
    """All postures on whole steps within tolerance (n,) of rests (n, R, 2), `_MOST` per rest.

    Returns the rests they belong to, in order, numbered path by path, and the postures (., 3).
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
    index = index[rank < _MOST]
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
    turns = [one[:, :, None, None], second[:, :, :, None], third]
    r = sum(link * np.sin(turn) for link, turn in zip(plane.links, turns, strict=True))
    h = sum(link * np.cos(turn) for link, turn in zip(plane.links, turns, strict=True))
    error = (r - radius[:, None, None, None]) ** 2 + (h - height[:, None, None, None]) ** 2
    cost = error.mean(axis=-1).reshape(-1, 27)
    # A motor that stays has no ramp: leave one combination of the equal ones.
    idle = ((old == new)[:, None] & (COMBINATIONS > 0)).any(axis=2)
    return np.where(idle, np.inf, cost)


def grid_chain(plane: Plane) -> tuple[NDArray, Solution]:
    """Cheapest chain of whole-step postures.

    Returns which paths (n,) have a posture on the grid for every rest, and their `Solution`.
    """
    rests = plane.rests.shape[1]
    rest, posture = grid_postures(plane.rests, plane.tolerance, plane.links)
    number = np.bincount(rest, minlength=plane.tolerance.size * rests).reshape(-1, rests)
    on_grid: NDArray = np.all(number > 0, axis=1)
    keep = on_grid[rest // rests]
    rest, posture = rest[keep], posture[keep]
    rest = (np.cumsum(on_grid) - 1)[rest // rests] * rests + rest % rests
    return on_grid, _cheapest(plane.rows(on_grid), rest, posture)


def _cheapest(plane: Plane, rest: NDArray, posture: NDArray) -> Solution:
    """Cheapest chain through postures (c, 3) of `rest` (c,), every rest having at least one."""
    count, moves = plane.noise.shape
    begin = np.searchsorted(rest, np.arange(count * (moves + 1) + 1))
    head = np.flatnonzero(rest % (moves + 1) < moves)
    number = np.diff(begin)[rest[head] + 1]
    head = np.repeat(head, number)
    tail = begin[rest[head] + 1] + _count_up(number)
    owner, move = np.divmod(rest[head], moves + 1)
    cost = np.empty((head.size, 27))
    for some in np.array_split(np.arange(head.size), head.size // 4000 + 1):
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
    solution = Solution(
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
