"""The arm in its own plane: which postures and ramps of three pitch joints explain a path.

Three joints give two outputs, so a rest alone leaves a whole curve of postures. Two things
single one out. Real targets are whole command units: for each direction of the last link the two
links before it are solved in closed form, and only whole units are kept; usually one posture per
rest survives, and the cheapest chain of rests decides (`grid_chain`). Simulated targets are
continuous: there the ramps decide, by Gauss-Newton over their combinations (`free_chain`).

Postures are in command steps of 0.24 deg from straight, signed as `YawPitchArm`'s angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["LIMIT", "STEP", "TIE", "Plane", "Solution", "free_chain", "grid_chain"]

STEP = np.deg2rad(0.24)
LIMIT = 500  # steps a motor can turn to either side
TIE = 1.21  # mean squares closer than this cannot be told apart ...
FLOOR = 1e-18  # ... nor those below this, in m^2: double precision is reached

_TURN = 1500  # steps in a full turn
_MOST = 24  # postures kept per rest
_DIRECTIONS = 36  # directions of the last link from which the search starts
_COMBINATIONS = np.stack([axis.ravel() for axis in np.indices((3, 3, 3))], axis=1)


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
    (n, M) with another explanation."""

    postures: NDArray
    lengths: NDArray
    cost: NDArray
    tied: NDArray


def _forward(angles: NDArray, links: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Radius and height of postures (..., 3) in steps."""
    total = np.cumsum(angles, axis=-1) * STEP
    return np.sin(total) @ np.array(links), np.cos(total) @ np.array(links)


def _elbow(
    radius: NDArray, height: NDArray, tip: NDArray, bend: NDArray, links: tuple[float, ...]
) -> NDArray:
    """Postures (..., 3) in steps that have the last link in direction `tip` and elbow `bend`."""
    first, second, last = links
    wrist = np.arctan2(radius - last * np.sin(tip * STEP), height - last * np.cos(tip * STEP))
    inner = np.arctan2(second * np.sin(bend * STEP), first + second * np.cos(bend * STEP))
    base = (wrist - inner) / STEP
    posture = np.stack([base, bend, tip - base - bend], axis=-1)
    return (posture + _TURN / 2) % _TURN - _TURN / 2


def _bends(
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


def _grid_postures(plane: Plane) -> tuple[NDArray, NDArray]:
    """All postures on whole steps within tolerance of the rests, `_MOST` per rest at most.

    Returns the rests they belong to, in order, numbered path by path, and the postures (., 3).
    """
    radius, height = plane.rests.reshape(-1, 2).T
    tolerance = np.repeat(plane.tolerance, plane.rests.shape[1])
    tip = np.arange(float(_TURN))
    low, high = _bends(radius, height, tip, tolerance, plane.links)
    low, high = np.ceil(low), np.floor(high)
    # Where the elbow is nearly straight the window is wide enough for several whole steps.
    number = np.where(high >= low, high - low + 1, 0).astype(int)
    rest, column = np.nonzero(number)
    number = number[rest, column]
    rest, column = np.repeat(rest, number), np.repeat(column, number)
    bend = low[rest, column] + _count_up(number)
    rest, column = np.tile(rest, 2), np.tile(column, 2)
    bend = np.concatenate([bend, -bend])
    posture = np.rint(_elbow(radius[rest], height[rest], tip[column], bend, plane.links))
    r, h = _forward(posture, plane.links)
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
    idle = ((old == new)[:, None] & (_COMBINATIONS > 0)).any(axis=2)
    return np.where(idle, np.inf, cost)


def grid_chain(plane: Plane) -> tuple[NDArray, Solution]:
    """Cheapest chain of whole-step postures.

    Returns which paths (n,) have a posture on the grid for every rest, and their `Solution`.
    """
    rests = plane.rests.shape[1]
    rest, posture = _grid_postures(plane)
    number = np.bincount(rest, minlength=plane.tolerance.size * rests).reshape(-1, rests)
    on_grid = (number > 0).all(axis=1)
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
        solution.lengths[:, step] = _COMBINATIONS[np.argmin(cost[chosen], axis=1)]
        solution.cost[:, step] = best[chosen]
        limit = chain[chosen].min(axis=1) + FLOOR
        limit += (TIE - 1) * (best[chosen] + plane.noise[:, step])
        as_good = (chain[edge] <= limit[owner[edge], None]).sum(axis=1)
        solution.tied[:, step] = np.bincount(owner[edge], as_good, count) > 1
    return solution


def free_chain(plane: Plane) -> Solution:
    """Continuous postures, movement by movement and then all of a path together."""
    count, moves = plane.noise.shape
    on_grid, postures = _starts(plane)
    solution = Solution(
        np.repeat(postures[:, None], moves + 1, axis=1), np.zeros((count, moves, 3), dtype=int),
        np.zeros((count, moves)), np.zeros((count, moves), dtype=bool),
    )  # fmt: skip
    for move in range(moves):
        _search(plane, move, np.arange(count), plane.kinks[:, move], solution)
        # Where the kinks misled, try all combinations.
        again = np.flatnonzero(solution.cost[:, move] > 4 * plane.tolerance**2)
        _search(plane, move, again, np.ones((again.size, 3), dtype=bool), solution)
    _polish(plane, solution, on_grid)
    return solution


def _starts(plane: Plane) -> tuple[NDArray, NDArray]:
    """Postures (n, 3) of the first rest, and which (n,) of them are on the grid."""
    first = Plane(
        plane.links, *np.empty((3, 1)), plane.rests[:, :1], plane.tolerance, *np.empty((2, 1))
    )
    rest, posture = _grid_postures(first)
    count = plane.tolerance.size
    begin = np.searchsorted(rest, np.arange(count))
    on_grid = np.bincount(rest, minlength=count) > 0
    found = np.zeros((count, 3))
    found[on_grid] = posture[begin[on_grid]]
    scan, feasible = _curve(plane.rests[:, 0], plane.links)
    size = np.where(feasible, np.abs(scan).max(axis=2), np.inf)
    nearest = scan[np.arange(count), np.argmin(size, axis=1)]
    usable = ~on_grid & feasible.any(axis=1)
    found[usable] = nearest[usable]
    return on_grid, found


def _curve(rest: NDArray, links: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Postures (p, 2 * directions, 3) around the curve that reaches each point, and usability."""
    radius, height = rest.T
    tip = np.arange(_DIRECTIONS) * (_TURN / _DIRECTIONS)
    # A little slack keeps the outstretched arm in.
    low, high = _bends(radius, height, tip, np.full(radius.size, 1e-3), links)
    usable = low <= high
    bend = np.where(usable, (low + high) / 2, 0.0)
    ways = [_elbow(radius[:, None], height[:, None], tip, way, links) for way in (bend, -bend)]
    posture = np.concatenate(ways, axis=1)
    usable = np.tile(usable, 2) & (np.abs(posture) <= LIMIT).all(axis=2)
    return posture, usable


def _search(
    plane: Plane, move: int, rows: NDArray, allowed: NDArray, solution: Solution
) -> None:
    """Best ramps and next posture of one movement of some paths, from the posture before it."""
    if rows.size == 0:
        return
    allowed = allowed | ~allowed.any(axis=1, keepdims=True)
    fits = allowed[:, _COMBINATIONS].all(axis=2)
    # Every kink that is there needs a motor whose ramp ends there.
    shown = (_COMBINATIONS[:, None] == np.arange(3)[:, None]).any(axis=2)
    fits &= (shown | ~allowed[:, None]).all(axis=2) | allowed.all(axis=1)[:, None]
    owner, combination = np.nonzero(fits)
    at = rows[owner]
    lengths = _COMBINATIONS[combination]
    part = np.take_along_axis(plane.parts[at, move], lengths[..., None], axis=1)
    radius, height = plane.radius[at, move], plane.height[at, move]
    scan, feasible = _curve(plane.rests[rows, move + 1], plane.links)
    pick, posture = np.nonzero(feasible[owner])
    old = solution.postures[at, move]
    coarse = slice(None, None, 5)
    new = scan[owner[pick], posture]
    angle = old[pick, None] + (new - old[pick])[:, None] * part[pick, :, coarse].swapaxes(1, 2)
    r, h = _forward(angle, plane.links)
    error = ((r - radius[pick, coarse]) ** 2 + (h - height[pick, coarse]) ** 2).mean(axis=1)
    table = np.full((owner.size, scan.shape[1]), np.inf)
    table[pick, posture] = error
    best = np.argmin(table.reshape(owner.size, 2, -1), axis=2) + [0, _DIRECTIONS]
    new = scan[owner[:, None], best].reshape(-1, 3)
    twice = np.repeat(np.arange(owner.size), 2)
    new, cost = _newton(
        old[twice], new, part[twice], radius[twice], height[twice], plane.links
    )
    owner, at, lengths = owner[twice], at[twice], lengths[twice]
    order = np.lexsort((cost, owner))
    chosen = order[np.searchsorted(owner[order], np.arange(rows.size))]
    solution.postures[rows, move + 1] = new[chosen]
    solution.lengths[rows, move] = lengths[chosen]
    solution.cost[rows, move] = cost[chosen]
    limit = cost[chosen] + (TIE - 1) * (cost[chosen] + plane.noise[rows, move]) + FLOOR
    # The same commands found twice are no tie; a motor that stays has no ramp.
    stays = np.abs(new - old[twice]) < 0.5
    apart = (np.abs(new - new[chosen][owner]) > 0.5).any(axis=1)
    apart |= ((lengths != lengths[chosen][owner]) & ~stays).any(axis=1)
    tied = np.bincount(owner, apart & (cost <= limit[owner]), rows.size) > 0
    solution.tied[rows, move] = tied


def _slopes(angle: NDArray, links: tuple[float, ...]) -> NDArray:
    """Derivatives (..., 2, 3) of radius and height in m per step of postures (..., 3)."""
    total = np.cumsum(angle, axis=-1) * STEP
    reach = np.stack([np.cos(total), -np.sin(total)], axis=-2) * np.array(links) * STEP
    return np.cumsum(reach[..., ::-1], axis=-1)[..., ::-1]


def _newton(
    old: NDArray, new: NDArray, part: NDArray, radius: NDArray, height: NDArray,
    links: tuple[float, ...],
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Damped Gauss-Newton on the posture (p, 3) at the end of a movement; mean square errors."""
    part = part.swapaxes(1, 2)
    data = np.stack([radius, height], axis=-1)

    def residual(new: NDArray) -> tuple[NDArray, NDArray]:
        angle = old[:, None] + (new - old)[:, None] * part
        return angle, np.stack(_forward(angle, links), axis=-1) - data

    angle, error = residual(new)
    cost = (error**2).sum(axis=-1).mean(axis=-1)
    damping = np.full(cost.size, 1e-3)
    live = np.arange(cost.size)
    return _descend(residual, angle, error, new, cost, damping, live, part, links)
