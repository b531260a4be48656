"""Continuous postures of the arm in its plane, found by Gauss-Newton over ramp combinations.

For targets that are not whole command units, as in the simulated paths. The search goes movement
by movement, from every direction that the last link may have at the next rest and for every
combination of ramps that agrees with the kinks of the path. A few explanations are kept until
later movements decide between them.
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
    PlaneSolution,
    bends,
    forward,
    grid_postures,
    with_tip,
)

REFINED_GUESSES = 8
"""Number of explanations per path that are refined where none is good."""
KEPT_GUESSES = 4
"""Number of explanations per path that are kept from one movement to the next."""
STARTS_PER_COMBINATION = 8
"""Number of local minima of the coarse scan from which each combination of ramps is fitted."""
DIRECTIONS = 90
"""Number of directions of the last link from which the search starts, 4 degrees apart."""
DURATIONS_USED = (COMBINATIONS[:, None] == np.arange(3)[:, None]).any(axis=2)
"""Which (27, 3) of the three ramp durations occur in a combination."""


@dataclass
class _Guesses:
    """Explanations that are kept: the path (g,) of each and its `PlaneSolution` so far."""

    path: NDArray
    found: PlaneSolution

    def keep(self, rows: NDArray) -> _Guesses:
        """Select explanations."""
        return _Guesses(self.path[rows], self.found.rows(rows))


def free_chain(plane: Plane, effort: int = 1) -> PlaneSolution:
    """Find continuous postures, movement by movement and then for a whole path together.

    Parameters
    ----------
    plane : Plane
        n paths.
    effort : int, default 1
        Factor of the number of starts and of the number of explanations that are kept.

    Returns
    -------
    PlaneSolution
        The best explanation of each path.

    """
    count, moves = plane.noise.shape
    on_grid, postures = _starts(plane)
    found = PlaneSolution(
        np.repeat(postures[:, None], moves + 1, axis=1), np.zeros((count, moves, 3), dtype=int),
        np.zeros((count, moves)), np.zeros((count, moves), dtype=bool),
    )  # fmt: skip
    guesses = _Guesses(np.arange(count), found)
    for move in range(moves):
        # At every kink the ramp of a motor ends, and no ramp ends elsewhere.
        kinks = plane.kinks[guesses.path, move]
        fits = (kinks[:, None] == DURATIONS_USED).all(axis=2)
        more = _search(plane, move, guesses, fits, effort, 12)
        best = np.full(count, np.inf)
        np.minimum.at(best, more.path, more.found.cost[:, move])
        # Where none of these explains the movement, either the kinks are wrong, so that all
        # combinations are tried, or the rest before is inaccurate, so that all movements so far
        # are fitted together.
        poor = best > plane.tolerance**2 / 4
        again = guesses.keep(poor[guesses.path])
        every = np.ones((again.path.size, 27), dtype=bool)
        other = _search(plane, move, again, every, effort, 40)
        other = _join(more.keep(poor[more.path]), other)
        other = _best(plane, move, other, REFINED_GUESSES * effort, np.inf)
        _refine(plane, other, on_grid, move + 1, 12)
        more = _join(more.keep(~poor[more.path]), other)
        # A rest that the arm cannot attain: the posture is kept and then refined.
        lost = guesses.keep(~np.isin(guesses.path, more.path))
        lost.found.postures[:, move + 1] = lost.found.postures[:, move]
        guesses = _best(plane, move, _join(more, lost), KEPT_GUESSES * effort, 4.0)
    _refine(plane, guesses, on_grid, moves, 4)
    return _decided(plane, guesses)


def _join(one: _Guesses, two: _Guesses) -> _Guesses:
    """The explanations of both."""
    return _Guesses(np.concatenate([one.path, two.path]), one.found.join(two.found))


def _best(plane: Plane, move: int, guesses: _Guesses, number: int, margin: float) -> _Guesses:
    """The best explanations per path, up to a movement, of about equal cost."""
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
    close = total[order] <= 2 * total[order][begin] + margin * plane.tolerance[path] ** 2
    return guesses.keep(order[close & (np.arange(path.size) - begin < number)])


def _decided(plane: Plane, guesses: _Guesses) -> PlaneSolution:
    """The best explanation of each path; movements that another one explains as well are tied."""
    found, path = guesses.found, guesses.path
    total = found.cost.sum(axis=1)
    order = np.lexsort((total, path))
    chosen = order[np.searchsorted(path[order], np.arange(len(plane.noise)))]
    best = found.rows(chosen)
    limit = (TIE - 1) * (best.cost + plane.noise) + FLOOR + total[chosen, None]
    far = np.abs(found.postures - best.postures[path]) > 0.5
    differs: NDArray = np.any(far[:, 1:], axis=2)
    stays = np.abs(np.diff(found.postures, axis=1)) < 0.5
    differs |= np.any((found.lengths != best.lengths[path]) & ~stays, axis=2)
    np.logical_or.at(best.tied, path, differs & (total[:, None] <= limit[path]))
    return best


def _search(
    plane: Plane, move: int, guesses: _Guesses, fits: NDArray, effort: int, starts: int
) -> _Guesses:
    """Ramps among those that fit (g, 27), and next postures, for one movement of guesses."""
    links = plane.links
    directions = DIRECTIONS * min(effort, 2)
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
    # A movement that the end of the path cuts off is extrapolated to its target.
    done = np.maximum(part[:, -1], 0.05)

    def begin(which: NDArray, at: NDArray) -> NDArray:
        return old[which] + (scan[guess[which], at] - old[which]) / done[which]

    error = _misfit(old[pick], begin(pick, at), part[pick, coarse], data[pick, coarse], links)
    cost.reshape(guess.size, 2 * directions)[pick, at] = error[1]
    # The fits start from the lowest local minima of each combination.
    minimum = (cost <= np.roll(cost, 1, axis=2)) & (cost <= np.roll(cost, -1, axis=2))
    low = np.where(minimum, cost, np.inf).reshape(guess.size, 2 * directions)
    number = STARTS_PER_COMBINATION * effort
    at = np.argpartition(low, number, axis=1)[:, :number]
    which, nth = np.nonzero(np.isfinite(np.take_along_axis(low, at, axis=1)))
    new = begin(which, at[which, nth])
    for rounds, some, kept in ((4, coarse, starts * effort), (8, half, KEPT_GUESSES * effort)):
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
    rest: NDArray, links: tuple[float, ...], directions: int = DIRECTIONS
) -> tuple[NDArray, NDArray]:
    """Postures (p, 2 * directions, 3) on the curve that attains each point, and usability."""
    radius, height = rest.T
    tip = np.arange(directions) * (TURN / directions)
    # A small tolerance includes the outstretched arm.
    low, high = bends(radius, height, tip, np.full(radius.size, 1e-3), links)
    usable = low <= high
    bend = np.where(usable, (low + high) / 2, 0.0)
    ways = [with_tip(radius[:, None], height[:, None], tip, way, links) for way in (bend, -bend)]
    posture = np.concatenate(ways, axis=1)
    usable = np.tile(usable, 2) & (np.abs(posture) <= LIMIT).all(axis=2)
    return posture, usable


def _jacobian(angle: NDArray, links: tuple[float, ...]) -> NDArray:
    """Derivatives (..., 2, 3) of radius and height in m per step of postures (..., 3)."""
    one, two, three = links
    first = angle[..., 0] * STEP
    second = first + angle[..., 1] * STEP
    third = second + angle[..., 2] * STEP
    slope = np.empty((*angle.shape[:-1], 2, 3))
    # A joint rotates every link behind it: sums from the tip inwards.
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
        slope = _jacobian(old[:, None] + (new - old)[:, None] * part, links) * part[:, :, None]
        step = _damped(slope.reshape(cost.size, width, 3), error.reshape(cost.size, width), damping)
        trial = np.clip(new - step, -LIMIT, LIMIT)
        trial_error, trial_cost = _misfit(old, trial, part, data, links)
        better = trial_cost < cost
        new = np.where(better[:, None], trial, new)
        error = np.where(better[:, None, None], trial_error, error)
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, damping / 10, damping * 10)
    return new, cost


def _damped(slope: NDArray, error: NDArray, damping: NDArray) -> NDArray:
    """Levenberg-Marquardt steps (p, 3) for slopes (p, k, 3) and errors (p, k)."""
    transposed = slope.swapaxes(1, 2)
    matrix = transposed @ slope
    size = np.trace(matrix, axis1=1, axis2=2) + 1e-20
    matrix = matrix + (size * (damping + 1e-13))[:, None, None] * np.eye(3)
    return np.linalg.solve(matrix, transposed @ error[..., None])[..., 0]


def _refine(plane: Plane, guesses: _Guesses, on_grid: NDArray, moves: int, rounds: int) -> None:
    """Fit all postures of the first movements together, ramps fixed, by Gauss-Newton.

    Movements whose target has a standard deviation above half a step are marked as tied.
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

    def evaluate(postures: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        angle = postures[:, :-1, None] + np.diff(postures, axis=1)[:, :, None] * part
        error = np.stack(forward(angle, plane.links), axis=-1) - data
        return angle, error, (error**2).sum(axis=-1).mean(axis=-1)

    new = found.postures[:, : moves + 1]
    angle, error, cost = evaluate(new)
    damping = np.full(count, 1e-6)
    weights = np.stack([1 - part, part], axis=3)[:, :, :, None]
    for _ in range(rounds):
        slope = _jacobian(angle, plane.links)[:, :, :, :, None] * weights
        slope = slope.reshape(count, moves, 2 * part.shape[2], 6)
        transposed = slope.swapaxes(2, 3)
        block = transposed @ slope
        gradient = transposed @ error.reshape(count, moves, 2 * part.shape[2], 1)
        matrix, vector = np.zeros((count, width, width)), np.zeros((count, width))
        for move in range(moves):
            at = slice(3 * move, 3 * move + 6)
            matrix[:, at, at] += block[:, move]
            vector[:, at] += gradient[:, move, :, 0]
        matrix[:, diagonal, diagonal] += hold + 1e-16
        normal = matrix.copy()
        normal[:, diagonal, diagonal] *= 1 + damping[:, None]
        trial = new - np.linalg.solve(normal, vector[..., None]).reshape(new.shape)
        trial_angle, trial_error, trial_cost = evaluate(trial)
        better = trial_cost.sum(axis=1) < cost.sum(axis=1)
        new = np.where(better[:, None, None], trial, new)
        angle[better], error[better] = trial_angle[better], trial_error[better]
        cost[better] = trial_cost[better]
        damping = np.where(better, damping / 100, damping * 10)
    found.postures[:, : moves + 1], found.cost[:, :moves] = new, cost
    variance = np.abs(np.einsum("nii->ni", np.linalg.inv(matrix))).reshape(new.shape)
    uncertain = (variance[:, 1:] * (cost + FLOOR)[..., None]).max(axis=2) > 0.5**2
    found.tied[:, :moves] = uncertain
