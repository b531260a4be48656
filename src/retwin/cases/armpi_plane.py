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
_DIRECTIONS = 72  # directions of the last link from which the search starts
_GUESSES = 4  # explanations of a path kept
_VALLEYS = 6  # starts per combination of ramps
_COMBINATIONS = np.stack([axis.ravel() for axis in np.indices((3, 3, 3))], axis=1)
# (27, 3): which of the three lengths occur in a combination.
_SHOWN = (_COMBINATIONS[:, None] == np.arange(3)[:, None]).any(axis=2)


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


@dataclass
class _Guesses:
    """Explanations still in play: the path (g,) each is of and its `Solution` so far."""

    path: NDArray
    found: Solution

    def keep(self, rows: NDArray) -> _Guesses:
        """Some of them."""
        return _Guesses(self.path[rows], self.found.rows(rows))


def free_chain(plane: Plane) -> Solution:
    """Continuous postures, movement by movement and then all of a path together."""
    count, moves = plane.noise.shape
    on_grid, postures = _starts(plane)
    found = Solution(
        np.repeat(postures[:, None], moves + 1, axis=1), np.zeros((count, moves, 3), dtype=int),
        np.zeros((count, moves)), np.zeros((count, moves), dtype=bool),
    )  # fmt: skip
    guesses = _Guesses(np.arange(count), found)
    for move in range(moves):
        # Every kink that is there needs a motor whose ramp ends there, and no motor's ramp ends
        # where there is none.
        kinks = plane.kinks[guesses.path, move]
        fits = (~kinks[:, None] | _SHOWN).all(axis=2) & (kinks[:, None] | ~_SHOWN).all(axis=2)
        more = _search(plane, move, guesses, fits, 8)
        best = np.full(count, np.inf)
        np.minimum.at(best, more.path, more.found.cost[:, move])
        # Where that explains nothing the kinks misled: try all combinations.
        again = guesses.keep(best[guesses.path] > 4 * plane.tolerance[guesses.path] ** 2)
        other = _search(plane, move, again, np.ones((again.path.size, 27), dtype=bool), 40)
        path = np.concatenate([more.path, other.path])
        fields = zip(vars(more.found).values(), vars(other.found).values(), strict=True)
        found = Solution(*(np.concatenate(pair) for pair in fields))
        guesses = _best(plane, move, _Guesses(path, found))
    _polish(plane, guesses, on_grid)
    return _settle(plane, guesses)


def _best(plane: Plane, move: int, guesses: _Guesses) -> _Guesses:
    """The few guesses per path that explain it about equally well up to a movement."""
    total = guesses.found.cost.sum(axis=1)
    same = np.concatenate([
        guesses.path[:, None], guesses.found.lengths[:, move],
        np.rint(guesses.found.postures[:, move: move + 2].reshape(-1, 6) / 2),
    ], axis=1)  # fmt: skip
    order = np.lexsort((total, guesses.path))
    _, first = np.unique(same[order], axis=0, return_index=True)
    order = order[np.sort(first)]
    path = guesses.path[order]
    begin = np.searchsorted(path, path)
    close = total[order] <= 2 * total[order][begin] + 4 * plane.tolerance[path] ** 2
    return guesses.keep(order[close & (np.arange(path.size) - begin < _GUESSES)])


def _settle(plane: Plane, guesses: _Guesses) -> Solution:
    """The best guess of each path; movements that another one explains otherwise are tied."""
    found, path = guesses.found, guesses.path
    total = found.cost.sum(axis=1)
    order = np.lexsort((total, path))
    chosen = order[np.searchsorted(path[order], np.arange(len(plane.noise)))]
    best = found.rows(chosen)
    limit = (TIE - 1) * (best.cost + plane.noise) + FLOOR + total[chosen, None]
    apart = np.abs(found.postures - best.postures[path]).max(axis=2)[:, 1:] > 0.5
    stays = np.abs(np.diff(found.postures, axis=1)) < 0.5
    apart |= ((found.lengths != best.lengths[path]) & ~stays).any(axis=2)
    np.logical_or.at(best.tied, path, apart & (total[:, None] <= limit[path]))
    return best


def _search(
    plane: Plane, move: int, guesses: _Guesses, fits: NDArray, starts: int
) -> _Guesses:
    """Good ramps out of those that fit (g, 27) and next postures for one movement of guesses."""
    links = plane.links
    scan, usable = _curve(plane.rests[guesses.path, move + 1], links)
    guess, combination = np.nonzero(fits & usable.any(axis=1)[:, None])
    path = guesses.path[guess]
    old = guesses.found.postures[guess, move]
    part = np.take_along_axis(
        plane.parts[path, move], _COMBINATIONS[combination][..., None], axis=1
    ).swapaxes(1, 2)
    data = np.stack([plane.radius[path, move], plane.height[path, move]], axis=-1)
    pick, at = np.nonzero(usable[guess])
    coarse = slice(4, None, 6)
    cost = np.full((guess.size, 2, _DIRECTIONS), np.inf)
    error = _misfit(old[pick], scan[guess[pick], at], part[pick, coarse], data[pick, coarse], links)
    cost.reshape(guess.size, -1)[pick, at] = error[1]
    # Start from the lowest valleys of each combination.
    valley = (cost <= np.roll(cost, 1, axis=2)) & (cost <= np.roll(cost, -1, axis=2))
    cost = np.where(valley, cost, np.inf).reshape(guess.size, -1)
    at = np.argpartition(cost, _VALLEYS, axis=1)[:, :_VALLEYS]
    which, nth = np.nonzero(np.isfinite(np.take_along_axis(cost, at, axis=1)))
    new = scan[guess[which], at[which, nth]]
    for rounds, some, kept in ((4, coarse, starts), (8, slice(None, None, 2), _GUESSES)):
        new, cost = _newton(old[which], new, part[which, some], data[which, some], links, rounds)
        order = np.lexsort((cost, guess[which]))
        owner = guess[which][order]
        order = order[np.arange(owner.size) - np.searchsorted(owner, owner) < kept]
        which, new, cost = which[order], new[order], cost[order]
    more = guesses.keep(guess[which])
    more.found.postures[:, move + 1] = new
    more.found.lengths[:, move] = _COMBINATIONS[combination[which]]
    more.found.cost[:, move] = _misfit(old[which], new, part[which], data[which], links)[1]
    return more


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


def _slopes(angle: NDArray, links: tuple[float, ...]) -> NDArray:
    """Derivatives (..., 2, 3) of radius and height in m per step of postures (..., 3)."""
    total = np.cumsum(angle, axis=-1) * STEP
    reach = np.stack([np.cos(total), -np.sin(total)], axis=-2) * np.array(links) * STEP
    return np.cumsum(reach[..., ::-1], axis=-1)[..., ::-1]


def _misfit(
    old: NDArray, new: NDArray, part: NDArray, data: NDArray, links: tuple[float, ...]
) -> tuple[NDArray, NDArray]:
    """Errors (p, k, 2) in m, and their mean square, of steps (p, 3) with parts done (p, k, 3)."""
    error = np.stack(_forward(old[:, None] + (new - old)[:, None] * part, links), axis=-1) - data
    return error, (error**2).sum(axis=-1).mean(axis=-1)


def _newton(
    old: NDArray, new: NDArray, part: NDArray, data: NDArray, links: tuple[float, ...],
    rounds: int,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Damped Gauss-Newton on the posture (p, 3) at the end of a movement; mean square errors."""
    error, cost = _misfit(old, new, part, data, links)
    damping = np.full(cost.size, 1e-4)
    for _ in range(rounds):
        slope = _slopes(old[:, None] + (new - old)[:, None] * part, links) * part[:, :, None]
        step = _damped(slope.reshape(cost.size, -1, 3), error.reshape(cost.size, -1), damping)
        trial = np.clip(new - step, -LIMIT, LIMIT)
        its_error, its_cost = _misfit(old, trial, part, data, links)
        better = its_cost < cost
        new = np.where(better[:, None], trial, new)
        error = np.where(better[:, None, None], its_error, error)
        cost = np.where(better, its_cost, cost)
        damping = np.where(better, damping / 10, damping * 10)
    return new, cost


def _damped(slope: NDArray, error: NDArray, damping: NDArray) -> NDArray:
    """Levenberg-Marquardt steps (p, 3) for slopes (p, k, 3) and errors (p, k)."""
    turned = slope.swapaxes(1, 2)
    matrix = turned @ slope
    size = np.trace(matrix, axis1=1, axis2=2) + 1e-20
    matrix = matrix + (size * (damping + 1e-13))[:, None, None] * np.eye(3)
    return np.linalg.solve(matrix, turned @ error[..., None])[..., 0]


def _polish(plane: Plane, guesses: _Guesses, on_grid: NDArray) -> None:
    """Gauss-Newton on all postures of guesses, ramps fixed; ties of what it cannot tell apart."""
    found, path = guesses.found, guesses.path
    count, moves = found.cost.shape
    part = np.take_along_axis(plane.parts[path], found.lengths[..., None], axis=2).swapaxes(2, 3)
    data = np.stack([plane.radius[path], plane.height[path]], axis=-1)
    width = 3 * moves + 3
    diagonal = np.arange(width)
    hold = np.zeros((count, width))
    hold[on_grid[path], :3] = 1e6

    def look(postures: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        angle = postures[:, :-1, None] + np.diff(postures, axis=1)[:, :, None] * part
        error = np.stack(_forward(angle, plane.links), axis=-1) - data
        return angle, error, (error**2).sum(axis=-1).mean(axis=-1)

    new = found.postures
    angle, error, cost = look(new)
    damping = np.full(count, 1e-6)
    share = np.stack([1 - part, part], axis=3)[:, :, :, None]
    for _ in range(4):
        slope = _slopes(angle, plane.links)[:, :, :, :, None] * share
        slope = slope.reshape(count, moves, -1, 6)
        turned = slope.swapaxes(2, 3)
        block, pull = turned @ slope, turned @ error.reshape(count, moves, -1, 1)
        matrix, vector = np.zeros((count, width, width)), np.zeros((count, width))
        for move in range(moves):
            at = slice(3 * move, 3 * move + 6)
            matrix[:, at, at] += block[:, move]
            vector[:, at] += pull[:, move, :, 0]
        matrix[:, diagonal, diagonal] += hold + 1e-16
        normal = matrix.copy()
        normal[:, diagonal, diagonal] *= 1 + damping[:, None]
        trial = new - np.linalg.solve(normal, vector[..., None]).reshape(new.shape)
        its_angle, its_error, its_cost = look(trial)
        better = its_cost.sum(axis=1) < cost.sum(axis=1)
        new = np.where(better[:, None, None], trial, new)
        angle[better], error[better] = its_angle[better], its_error[better]
        cost[better] = its_cost[better]
        damping = np.where(better, damping / 100, damping * 10)
    found.postures[:], found.cost[:] = new, cost
    variance = np.abs(np.einsum("nii->ni", np.linalg.inv(matrix))).reshape(new.shape)
    found.tied[:] |= (variance[:, 1:] * (cost + FLOOR)[..., None]).max(axis=2) > 0.5**2
