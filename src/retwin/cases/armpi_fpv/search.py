"""The search for postures and ramps that explain paths, movement by movement.

A few explanations are kept until later movements decide between them. Two facts make them unique:
targets of the real robot are whole command units, which are enumerated (`grid_chain`). Simulated
targets are continuous: there the ramps decide, by Gauss-Newton from every direction that the last
link may have at the next rest, for every combination of ramps that agrees with the kinks of the
path (`free_chain`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.cases.armpi_fpv.gauss_newton import gauss_newton
from retwin.cases.armpi_fpv.plane import LIMIT, STEP, TURN, Plane, attain, bends, grid_postures

TIE = 1.21
"""Ratio of mean square errors below which two explanations count as equally good (10 % in RMS)."""
FLOOR = 1e-18
"""Mean square error in m^2 below which explanations count as equally good: double precision."""
COMBINATIONS = np.stack([axis.ravel() for axis in np.indices((3, 3, 3))], axis=1)
"""Combinations (27, 3) of ramp durations: the index of each motor's duration."""
DURATIONS_USED = (COMBINATIONS[:, None] == np.arange(3)[:, None]).any(axis=2)
"""Which (27, 3) of the three ramp durations occur in a combination."""
KEPT_GUESSES = 4
"""Number of explanations per path that are kept from one movement to the next."""
DIRECTIONS = 90
"""Number of directions of the last link from which the search starts, 4 degrees apart."""


@dataclass(frozen=True)
class Explanations:
    """Postures and ramps that explain paths of M movements.

    Attributes
    ----------
    path : ndarray of int, shape (g,)
        Path of each explanation.
    postures : ndarray, shape (g, M + 1, 3)
        Postures of the rests in steps.
    lengths : ndarray of int, shape (g, M, 3)
        Index of each motor's ramp duration.
    cost : ndarray, shape (g, M)
        Mean square error of each movement in m^2.
    tied : ndarray of bool, shape (g, M)
        Movements that another explanation fits equally well.

    """

    path: NDArray
    postures: NDArray
    lengths: NDArray
    cost: NDArray
    tied: NDArray

    @classmethod
    def of(cls, path: NDArray, posture: NDArray, moves: int) -> Explanations:
        """Arms that rest in postures (g, 3)."""
        shape = (len(path), moves)
        rest = np.repeat(posture[:, None], moves + 1, axis=1)
        none = np.zeros((*shape, 3), dtype=int)
        return cls(path, rest, none, np.zeros(shape), np.zeros(shape, dtype=bool))

    def rows(self, rows: NDArray) -> Explanations:
        """Select explanations."""
        return Explanations(*(each[rows] for each in vars(self).values()))

    def join(self, other: Explanations) -> Explanations:
        """The explanations of both."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Explanations(*map(np.concatenate, pairs))

    def extend(
        self, rows: NDArray, move: int, posture: NDArray, lengths: ArrayLike, cost: ArrayLike
    ) -> Explanations:
        """Some explanations, with what comes after a movement."""
        more = self.rows(rows)
        more.postures[:, move + 1] = posture
        more.lengths[:, move], more.cost[:, move] = lengths, cost
        return more


def grid_chain(plane: Plane, paths: NDArray, *, grid_guesses: int = 24) -> Explanations:
    """Find whole-step postures.

    Parameters
    ----------
    plane : Plane
        All paths.
    paths : ndarray of int
        Index of the paths that are explained.
    grid_guesses : int, default 24
        The same on the grid, where each costs little.

    Returns
    -------
    Explanations
        The best explanation of each path that has a posture on whole steps for every rest.

    """
    moves = plane.noise.shape[1]
    guesses = Explanations.of(*grid_postures(plane, paths, 0), moves)
    for move in range(moves):
        owner, posture = grid_postures(plane, np.unique(guesses.path), move + 1)
        guess, at = np.nonzero(guesses.path[:, None] == owner)
        old, new = guesses.postures[guess, move], posture[at]
        ends = np.stack([old, new], axis=1)
        cost = np.empty((guess.size, len(COMBINATIONS)))
        for i, lengths in enumerate(COMBINATIONS):
            part, data = _movements(plane, owner[at], slice(move, move + 1), lengths[None, None])
            cost[:, i] = _costs(_errors(plane, ends, part, data))[:, 0]
        # A motor that stays has no ramp: leave one combination of the equal ones.
        idle = ((old == new)[:, None] & (COMBINATIONS > 0)).any(axis=2)
        pair, combination = np.nonzero(~idle)
        more = guesses.extend(
            guess[pair], move, new[pair], COMBINATIONS[combination], cost[pair, combination]
        )
        guesses = _best(plane, more, grid_guesses, 4.0)
    return _decide(plane, guesses)


def free_chain(plane: Plane, paths: NDArray, effort: int = 1) -> Explanations:
    """Find continuous postures, movement by movement and then for a whole path together.

    Parameters
    ----------
    plane : Plane
        All paths.
    paths : ndarray of int
        Index of the paths that are explained.
    effort : int, default 1
        Factor of the number of starts and of the number of explanations that are kept.

    Returns
    -------
    Explanations
        The best explanation of each path.

    """
    moves = plane.noise.shape[1]
    guesses, on_grid = _starts(plane, paths)
    for move in range(moves):
        # At every kink the ramp of a motor ends, and no ramp ends elsewhere.
        kinks = plane.kinks[guesses.path, move]
        fits = (kinks[:, None] == DURATIONS_USED).all(axis=2)
        more = _search(plane, move, guesses, fits, effort, 12)
        best = np.full(len(plane.noise), np.inf)
        np.minimum.at(best, more.path, more.cost[:, move])
        # Where none of these explains the movement, either the kinks are wrong, so that all
        # combinations are tried, or the rest before is inaccurate, so that all movements so far
        # are fitted together.
        poor = best > plane.tolerance**2 / 4
        again = guesses.rows(poor[guesses.path])
        every = np.ones((again.path.size, 27), dtype=bool)
        other = more.rows(poor[more.path]).join(_search(plane, move, again, every, effort, 40))
        # Number of explanations per path that are refined where none is good.
        other = _best(plane, other, 8 * effort, np.inf)
        _refine(plane, other, on_grid, move + 1, 12)
        # A rest that the arm cannot attain: the posture is kept and then refined.
        more = more.rows(~poor[more.path]).join(other)
        lost = np.flatnonzero(~np.isin(guesses.path, more.path))
        more = more.join(guesses.extend(lost, move, guesses.postures[lost, move], 0, 0.0))
        guesses = _best(plane, more, KEPT_GUESSES * effort, 4.0)
    _refine(plane, guesses, on_grid, moves, 4)
    return _decide(plane, guesses)


def _best(plane: Plane, guesses: Explanations, number: int, margin: float) -> Explanations:
    """The best explanations per path of about equal cost."""
    total = guesses.cost.sum(axis=1)
    order = np.lexsort((total, guesses.path))
    path, total = guesses.path[order], total[order]
    begin = np.searchsorted(path, path)
    allowed = plane.tolerance[path] ** 2 + plane.noise[path].sum(axis=1)
    close = total <= 2 * total[begin] + margin * allowed
    return guesses.rows(order[close & (np.arange(path.size) - begin < number)])


def _decide(plane: Plane, found: Explanations) -> Explanations:
    """The best explanation of each path; movements that another one explains as well are tied."""
    total = found.cost.sum(axis=1)
    order = np.lexsort((total, found.path))
    paths, first, group = np.unique(found.path[order], return_index=True, return_inverse=True)
    found, total = found.rows(order), total[order]
    best = found.rows(first)
    limit = (TIE - 1) * (best.cost + plane.noise[paths]) + FLOOR + total[first, None]
    far = (np.abs(found.postures - best.postures[group]) > 0.5).any(axis=2)
    differs = far[:, 1:]
    differs[:, :1] |= far[:, :1]
    stays = np.abs(np.diff(found.postures, axis=1)) < 0.5
    differs |= ((found.lengths != best.lengths[group]) & ~stays).any(axis=2)
    np.logical_or.at(best.tied, group, differs & (total[:, None] <= limit[group]))
    return best


def _search(
    plane: Plane, move: int, guesses: Explanations, fits: NDArray, effort: int, starts: int
) -> Explanations:
    """Ramps among those that fit (g, 27), and next postures, for one movement of guesses."""
    scan, usable = _curve(plane, guesses.path, move + 1, DIRECTIONS * min(effort, 2))
    guess, combination = np.nonzero(fits & np.any(usable, axis=1, keepdims=True))
    old, lengths = guesses.postures[guess, move], COMBINATIONS[combination]
    at = slice(move, move + 1)
    part, data = _movements(plane, guesses.path[guess], at, lengths[:, None])
    # A movement that the end of the path cuts off is extrapolated to its target.
    done = np.maximum(part[:, 0, -1], 0.05)
    coarse, half = slice(4, None, 6), slice(None, None, 2)

    def postures(which: NDArray, nth: NDArray) -> NDArray:
        new = old[which] + (scan[guess[which], nth] - old[which]) / done[which]
        return np.stack([old[which], new], axis=1)

    pick, nth = np.nonzero(usable[guess])
    few = part[pick][:, :, coarse], data[pick][:, :, coarse]
    cost = np.full((guess.size, *usable.shape[1:]), np.inf)
    cost[pick, nth] = _costs(_errors(plane, postures(pick, nth), *few))[:, 0]
    # The fits start from the lowest local minima of each combination, of either elbow.
    cost = cost.reshape(guess.size, 2, usable.shape[1] // 2)
    minimum = (cost <= np.roll(cost, 1, axis=2)) & (cost <= np.roll(cost, -1, axis=2))
    low = np.where(minimum, cost, np.inf).reshape(guess.size, usable.shape[1])
    # Number of local minima of the coarse scan from which each combination of ramps is fitted.
    number = 8 * effort
    nth = np.argpartition(low, number, axis=1)[:, :number]
    which, rank = np.nonzero(np.isfinite(np.take_along_axis(low, nth, axis=1)))
    ends = postures(which, nth[which, rank])
    free = np.array([False, True])
    for rounds, some, kept in ((4, coarse, starts * effort), (8, half, KEPT_GUESSES * effort)):
        ends, costs, _ = _fit_postures(
            plane, ends, part[which][:, :, some], data[which][:, :, some], free, rounds
        )
        order = np.lexsort((costs[:, 0], guess[which]))
        owner = guess[which][order]
        order = order[np.arange(owner.size) - np.searchsorted(owner, owner) < kept]
        which, ends = which[order], ends[order]
    # Several starts lead to the same end.
    same = np.concatenate([which[:, None], np.rint(ends[:, 1] / 2)], axis=1)
    _, index = np.unique(same, axis=0, return_index=True)
    which, ends = which[index], ends[index]
    cost = _costs(_errors(plane, ends, part[which], data[which]))
    return guesses.extend(guess[which], move, ends[:, 1], lengths[which], cost[:, 0])


def _starts(plane: Plane, paths: NDArray) -> tuple[Explanations, NDArray]:
    """Postures of the first rest of paths, and which paths (n,) have it on the grid."""
    owner, posture = grid_postures(plane, paths, 0)
    on_grid = np.isin(np.arange(len(plane.noise)), owner)
    scan, feasible = _curve(plane, paths, 0, DIRECTIONS)
    size = np.where(feasible, np.abs(scan).max(axis=2), np.inf)
    first = scan[np.arange(paths.size), np.argmin(size, axis=1)]
    first[~feasible.any(axis=1)] = 0.0
    _, nearest = np.unique(owner, return_index=True)
    first[on_grid[paths]] = posture[nearest]
    return Explanations.of(paths, first, plane.noise.shape[1]), on_grid


def _curve(plane: Plane, paths: NDArray, rest: int, directions: int) -> tuple[NDArray, NDArray]:
    """Postures (p, 2 * directions, 3) on the curve that attains each point, and usability."""
    points = plane.rests[paths, rest]
    tip = np.arange(directions) * (TURN / directions)
    # A small tolerance includes the outstretched arm.
    low, high = bends(points, tip, np.full(paths.size, 1e-3), plane.arm)
    usable = np.tile(low <= high, 2)
    bend = np.where(low <= high, (low + high) / 2, 0.0)
    ways = [attain(points[:, None], tip, way, plane.arm) for way in (bend, -bend)]
    posture = np.concatenate(ways, axis=1)
    return posture, usable & (np.abs(posture) <= LIMIT).all(axis=2)


def _movements(
    plane: Plane, paths: NDArray, moves: slice, lengths: NDArray
) -> tuple[NDArray, NDArray]:
    """Finished fractions (p, m, K, 3) of ramps (p, m, 3), and samples (p, m, K, 2)."""
    parts = np.take_along_axis(plane.parts[paths, moves], lengths[..., None], axis=2)
    return parts.swapaxes(2, 3), plane.data[paths, moves]


def _angles(postures: NDArray, part: NDArray) -> NDArray:
    """Angles (p, m, K, 3) in rad between postures (p, m + 1, 3)."""
    return STEP * (postures[:, :-1, None] + np.diff(postures, axis=1)[:, :, None] * part)


def _errors(plane: Plane, postures: NDArray, part: NDArray, data: NDArray) -> NDArray:
    """Errors (p, m, K, 2) in m of movements between postures (p, m + 1, 3)."""
    return plane.arm.in_plane(_angles(postures, part)) - data


def _costs(error: NDArray) -> NDArray:
    """Mean square errors (p, m) of movements."""
    return (error**2).sum(axis=3).mean(axis=2)


def _fit_postures(
    plane: Plane, postures: NDArray, part: NDArray, data: NDArray, free: NDArray, rounds: int
) -> tuple[NDArray, NDArray, NDArray]:
    """Postures (p, m + 1, 3) where they are free, fitted together; their costs and Jacobian."""
    count, moves, samples, _ = part.shape
    free = np.broadcast_to(free, (count, moves + 1))[..., None]

    def evaluate(x: NDArray) -> tuple[NDArray, NDArray]:
        ends = x.reshape(postures.shape)
        slope = plane.arm.jacobian_in_plane(_angles(ends, part))
        # The first joint rotates the whole arm: its column holds height and radius.
        error = np.stack([-slope[..., 1, 0], slope[..., 0, 0]], axis=-1) - data
        whole = np.zeros((count, moves, samples, 2, moves + 1, 3))
        for move in range(moves):
            done = part[:, move, :, None]
            whole[:, move, :, :, move] = slope[:, move] * (1 - done)
            whole[:, move, :, :, move + 1] = slope[:, move] * done
        whole *= STEP * free[:, None, None, None]
        rows = (count, moves * samples * 2)
        return error.reshape(rows), whole.reshape(*rows, x.shape[1])

    start = postures.reshape(count, 3 * (moves + 1))
    x, _ = gauss_newton(evaluate, start, rounds=rounds, limit=LIMIT)
    ends = x.reshape(postures.shape)
    return ends, _costs(_errors(plane, ends, part, data)), evaluate(x)[1]


def _refine(plane: Plane, guesses: Explanations, on_grid: NDArray, moves: int, rounds: int) -> None:
    """Fit all postures of the first movements together, ramps fixed, by Gauss-Newton.

    Movements whose target has a standard deviation above half a step are marked as tied.
    """
    path, first = guesses.path, slice(0, moves)
    part, data = _movements(plane, path, first, guesses.lengths[:, :moves])
    free = np.ones((path.size, moves + 1), dtype=bool)
    free[:, 0] = ~on_grid[path]
    ends, cost, slope = _fit_postures(
        plane, guesses.postures[:, : moves + 1], part, data, free, rounds
    )
    guesses.postures[:, : moves + 1], guesses.cost[:, :moves] = ends, cost
    matrix = slope.swapaxes(1, 2) @ slope + 1e-16 * np.eye(slope.shape[2])
    variance = np.abs(np.einsum("nii->ni", np.linalg.inv(matrix))).reshape(ends.shape)
    uncertain = (variance[:, 1:] * (cost + FLOOR)[..., None]).max(axis=2) > 0.5**2
    guesses.tied[:, :moves] = uncertain
