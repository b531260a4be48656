"""Continuous postures of the arm in its plane, found by Gauss-Newton over ramp combinations.

For targets off the grid, as in the simulated paths. Movement by movement, from every direction
the last link may have at the next rest and for every combination of ramps that agrees with the
kinks of the path; a few explanations are kept until later movements tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.plane import (
    COMBINATIONS,
    FLOOR,
    LIMIT,
    STEP,
    TIE,
    TURN,
    Plane,
    Solution,
    bends,
    forward,
    grid_postures,
    with_tip,
)

__all__ = ["free_chain"]

_POLISHED = 8  # explanations fitted once more where none is good
_GUESSES = 4  # explanations of a path kept
_VALLEYS = 8  # starts per combination of ramps
_DIRECTIONS = 90  # directions of the last link from which the search starts
# (27, 3): which of the three lengths occur in a combination.
_SHOWN = (COMBINATIONS[:, None] == np.arange(3)[:, None]).any(axis=2)


@dataclass
class _Guesses:
    """Explanations still in play: the path (g,) each is of and its `Solution` so far."""

    path: NDArray
    found: Solution

    def keep(self, rows: NDArray) -> _Guesses:
        """Some of them."""
        return _Guesses(self.path[rows], self.found.rows(rows))


def free_chain(plane: Plane, effort: int = 1) -> Solution:
    """Continuous postures, movement by movement and then all of a path together.

    The search starts from `effort` times more places and keeps so many times more of them.
    """
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
        more = _search(plane, move, guesses, fits, effort, 12)
        best = np.full(count, np.inf)
        np.minimum.at(best, more.path, more.found.cost[:, move])
        # Where that explains nothing either the kinks misled: try all combinations; or the
        # rest before was told apart too poorly: fit all movements so far together.
        poor = best > plane.tolerance**2 / 4
        again = guesses.keep(poor[guesses.path])
        every = np.ones((again.path.size, 27), dtype=bool)
        other = _search(plane, move, again, every, effort, 40)
        other = _join(more.keep(poor[more.path]), other)
        other = _best(plane, move, other, _POLISHED * effort, np.inf)
        _polish(plane, other, on_grid, move + 1, 12)
        more = _join(more.keep(~poor[more.path]), other)
        # A rest out of the arm's reach: stay, and let the polishing do what it can.
        lost = guesses.keep(~np.isin(guesses.path, more.path))
        lost.found.postures[:, move + 1] = lost.found.postures[:, move]
        guesses = _best(plane, move, _join(more, lost), _GUESSES * effort, 4.0)
    _polish(plane, guesses, on_grid, moves, 4)
    return _settle(plane, guesses)


def _join(one: _Guesses, two: _Guesses) -> _Guesses:
    return _Guesses(np.concatenate([one.path, two.path]), one.found.join(two.found))


def _best(plane: Plane, move: int, guesses: _Guesses, most: int, loose: float) -> _Guesses:
    """The best guesses per path, up to a movement, that explain it about equally well."""
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
    close = total[order] <= 2 * total[order][begin] + loose * plane.tolerance[path] ** 2
    return guesses.keep(order[close & (np.arange(path.size) - begin < most)])


def _settle(plane: Plane, guesses: _Guesses) -> Solution:
    """The best guess of each path; movements that another one explains otherwise are tied."""
    found, path = guesses.found, guesses.path
    total = found.cost.sum(axis=1)
    order = np.lexsort((total, path))
    chosen = order[np.searchsorted(path[order], np.arange(len(plane.noise)))]
    best = found.rows(chosen)
    limit = (TIE - 1) * (best.cost + plane.noise) + FLOOR + total[chosen, None]
    far = np.abs(found.postures - best.postures[path]) > 0.5
    apart: NDArray = np.any(far[:, 1:], axis=2)
    stays = np.abs(np.diff(found.postures, axis=1)) < 0.5
    apart |= np.any((found.lengths != best.lengths[path]) & ~stays, axis=2)
    np.logical_or.at(best.tied, path, apart & (total[:, None] <= limit[path]))
    return best


def _search(
    plane: Plane, move: int, guesses: _Guesses, fits: NDArray, effort: int, starts: int
) -> _Guesses:
    """Good ramps out of those that fit (g, 27) and next postures for one movement of guesses."""
    links = plane.links
    directions = _DIRECTIONS * min(effort, 2)
    scan, usable = _curve(plane.rests[guesses.path, move + 1], links, directions)
    guess, combination = np.nonzero(fits & np.any(usable, axis=1, keepdims=True))
    path = guesses.path[guess]
    old = guesses.found.postures[guess, move]
    part = np.take_along_axis(
        plane.parts[path, move], COMBINATIONS[combination][..., None], axis=1
    ).swapaxes(1, 2)
    data = np.stack([plane.radius[path, move], plane.height[path, move]], axis=-1)
    pick, at = np.nonzero(usable[guess])
    coarse, half = slice(4, None, 6), slice(None, None, 2)
    cost = np.full((guess.size, 2, directions), np.inf)
    # A movement cut off by the end of the path goes on to where it was heading.
    done = np.maximum(part[:, -1], 0.05)

    def begin(which: NDArray, at: NDArray) -> NDArray:
        return old[which] + (scan[guess[which], at] - old[which]) / done[which]

    error = _misfit(old[pick], begin(pick, at), part[pick, coarse], data[pick, coarse], links)
    cost.reshape(guess.size, 2 * directions)[pick, at] = error[1]
    # Start from the lowest valleys of each combination.
    valley = (cost <= np.roll(cost, 1, axis=2)) & (cost <= np.roll(cost, -1, axis=2))
    low = np.where(valley, cost, np.inf).reshape(guess.size, 2 * directions)
    at = np.argpartition(low, _VALLEYS * effort, axis=1)[:, : _VALLEYS * effort]
    which, nth = np.nonzero(np.isfinite(np.take_along_axis(low, at, axis=1)))
    new = begin(which, at[which, nth])
    for rounds, some, kept in ((4, coarse, starts * effort), (8, half, _GUESSES * effort)):
        new, cost = _newton(old[which], new, part[which, some], data[which, some], links, rounds)
        order = np.lexsort((cost, guess[which]))
        owner = guess[which][order]
        order = order[np.arange(owner.size) - np.searchsorted(owner, owner) < kept]
        which, new, cost = which[order], new[order], cost[order]
    more = guesses.keep(guess[which])
    more.found.postures[:, move + 1] = new
    more.found.lengths[:, move] = COMBINATIONS[combination[which]]
    more.found.cost[:, move] = _misfit(old[which], new, part[which], data[which], links)[1]
    return more


def _starts(plane: Plane) -> tuple[NDArray, NDArray]:
    """Postures (n, 3) of the first rest, and which (n,) of them are on the grid."""
    rest, posture = grid_postures(plane.rests[:, :1], plane.tolerance, plane.links)
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


def _curve(
    rest: NDArray, links: tuple[float, ...], directions: int = _DIRECTIONS
) -> tuple[NDArray, NDArray]:
    """Postures (p, 2 * directions, 3) around the curve that reaches each point, and usability."""
    radius, height = rest.T
    tip = np.arange(directions) * (TURN / directions)
    # A little slack keeps the outstretched arm in.
    low, high = bends(radius, height, tip, np.full(radius.size, 1e-3), links)
    usable = low <= high
    bend = np.where(usable, (low + high) / 2, 0.0)
    ways = [with_tip(radius[:, None], height[:, None], tip, way, links) for way in (bend, -bend)]
    posture = np.concatenate(ways, axis=1)
    usable = np.tile(usable, 2) & (np.abs(posture) <= LIMIT).all(axis=2)
    return posture, usable


def _slopes(angle: NDArray, links: tuple[float, ...]) -> NDArray:
    """Derivatives (..., 2, 3) of radius and height in m per step of postures (..., 3)."""
    one, two, three = links
    first = angle[..., 0] * STEP
    second = first + angle[..., 1] * STEP
    third = second + angle[..., 2] * STEP
    slope = np.empty((*angle.shape[:-1], 2, 3))
    # A joint turns every link behind it: sums from the tip inwards.
    slope[..., 0, 2] = STEP * three * np.cos(third)
    slope[..., 0, 1] = STEP * two * np.cos(second) + slope[..., 0, 2]
    slope[..., 0, 0] = STEP * one * np.cos(first) + slope[..., 0, 1]
    slope[..., 1, 2] = -STEP * three * np.sin(third)
    slope[..., 1, 1] = -STEP * two * np.sin(second) + slope[..., 1, 2]
    slope[..., 1, 0] = -STEP * one * np.sin(first) + slope[..., 1, 1]
    return slope


def _misfit(
    old: NDArray, new: NDArray, part: NDArray, data: NDArray, links: tuple[float, ...]
) -> tuple[NDArray, NDArray]:
    """Errors (p, k, 2) in m, and their mean square, of steps (p, 3) with parts done (p, k, 3)."""
    error = np.stack(forward(old[:, None] + (new - old)[:, None] * part, links), axis=-1) - data
    return error, (error**2).sum(axis=-1).mean(axis=-1)


def _newton(
    old: NDArray, new: NDArray, part: NDArray, data: NDArray, links: tuple[float, ...],
    rounds: int,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Damped Gauss-Newton on the posture (p, 3) at the end of a movement; mean square errors."""
    error, cost = _misfit(old, new, part, data, links)
    damping = np.full(cost.size, 1e-4)
    width = 2 * part.shape[1]
    for _ in range(rounds):
        slope = _slopes(old[:, None] + (new - old)[:, None] * part, links) * part[:, :, None]
        step = _damped(slope.reshape(cost.size, width, 3), error.reshape(cost.size, width), damping)
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


def _polish(plane: Plane, guesses: _Guesses, on_grid: NDArray, moves: int, rounds: int) -> None:
    """Gauss-Newton on the postures of guesses together, ramps fixed, for their first movements.

    Marks movements as tied whose targets the path leaves open by more than half a step.
    """
    found, path = guesses.found, guesses.path
    count = path.size
    lengths = found.lengths[:, :moves, :, None]
    part = np.take_along_axis(plane.parts[path, :moves], lengths, axis=2).swapaxes(2, 3)
    data = np.stack([plane.radius[path, :moves], plane.height[path, :moves]], axis=-1)
    width = 3 * moves + 3
    diagonal = np.arange(width)
    hold = np.zeros((count, width))
    hold[on_grid[path], :3] = 1e6

    def look(postures: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        angle = postures[:, :-1, None] + np.diff(postures, axis=1)[:, :, None] * part
        error = np.stack(forward(angle, plane.links), axis=-1) - data
        return angle, error, (error**2).sum(axis=-1).mean(axis=-1)

    new = found.postures[:, : moves + 1]
    angle, error, cost = look(new)
    damping = np.full(count, 1e-6)
    share = np.stack([1 - part, part], axis=3)[:, :, :, None]
    for _ in range(rounds):
        slope = _slopes(angle, plane.links)[:, :, :, :, None] * share
        slope = slope.reshape(count, moves, 2 * part.shape[2], 6)
        turned = slope.swapaxes(2, 3)
        block, pull = turned @ slope, turned @ error.reshape(count, moves, 2 * part.shape[2], 1)
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
    found.postures[:, : moves + 1], found.cost[:, :moves] = new, cost
    variance = np.abs(np.einsum("nii->ni", np.linalg.inv(matrix))).reshape(new.shape)
    unsure = (variance[:, 1:] * (cost + FLOOR)[..., None]).max(axis=2) > 0.5**2
    found.tied[:, :moves] = unsure
