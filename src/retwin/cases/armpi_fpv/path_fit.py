"""`PathFit`: onsets, yaw and postures of n paths with equally many movements, fitted together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.cases.armpi_fpv.plane import LIMIT, STEP, TURN, Plane
from retwin.cases.armpi_fpv.search import FLOOR, TIE, free_chain, grid_chain
from retwin.cases.armpi_fpv.twin import KINEMATIC, RAMPS, STRAIGHT
from retwin.twins.commands.ramps import ramps_and_holds

HALF_TURN = TURN // 2
"""Command units in half a turn."""
EXPLAINED = 5e-5
"""RMS error in m above which a movement counts as not explained."""


def path_noise(path: NDArray, *, largest_noise: float = 1e-4) -> NDArray:
    """Estimate the noise of paths.

    Parameters
    ----------
    path : ndarray, shape (n, T, 3)
        End-effector positions in m.
    largest_noise : float, default 1e-4
        Distance in m between samples at rest above which it is not attributed to noise.

    Returns
    -------
    ndarray, shape (n,)
        Distance in m between successive samples at rest; 0 for paths without noise.

    """
    speed = np.linalg.norm(np.diff(path, axis=1), axis=2)
    # The arm rests for at least a quarter of its paths.
    return np.minimum(np.quantile(speed, 0.25, axis=1), largest_noise)


def _hats(part: NDArray) -> NDArray:
    """Weights (..., 2) of the rests before and after a ramp with these finished fractions."""
    return np.stack([1 - part, part], axis=-1)


def _means(values: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """Mean (n, k, ...) of values (n, T, ...) from samples `low` to before `high`, both (n, k)."""
    total = np.cumsum(np.insert(values, 0, 0, axis=1), axis=1)
    row = np.arange(len(values))[:, None]
    span = total[row, high] - total[row, low]
    return span / (high - low).reshape(*high.shape, *(1,) * (values.ndim - 2))


class PathFit:
    """The fit of n paths with M movements each.

    Inside, a motor's angle is a number of steps `500 - unit` of 0.24 deg, with the signs of
    `YawPitchArm`'s angles.

    Parameters
    ----------
    path : ndarray, shape (n, T, 3)
        End-effector positions in m.
    spans : ndarray of int, shape (n, M, 2)
        First and last moving step of each movement.
    arm : YawPitchArm
        The arm that made the paths.

    Attributes
    ----------
    moves : int
        Movements per path, M.
    onsets : ndarray, shape (n, M)
        Onsets in samples.
    steps : ndarray, shape (n, M + 1, 4)
        Angles of the motors at the rests in steps.
    closed, whole : ndarray of bool, shape (n,)
        See `Recovery`.

    """

    def __init__(self, path: NDArray, spans: NDArray, arm: YawPitchArm) -> None:
        self.path, self.arm = path, arm
        self.count, self.moves = spans.shape[:2]
        self.length = path.shape[1]
        self.first, self.last = spans[..., 0], spans[..., 1]
        x, y, z = np.moveaxis(path, 2, 0)
        rho = np.hypot(x, y)
        # On the axis the plane of the arm is undetermined; the sample before determines it.
        self.determined = rho > 2e-5
        index = np.where(self.determined, np.arange(self.length), -1)
        index = np.maximum.accumulate(index, axis=1)
        index = np.where(index < 0, np.argmax(self.determined, axis=1)[:, None], index)
        yaw = np.take_along_axis(np.arctan2(x, -y), index, axis=1)
        # Modulo half a turn the plane is continuous: r changes its sign on the axis.
        yaw = np.unwrap(yaw, period=np.pi, axis=1)
        middle = (yaw.max(axis=1) + yaw.min(axis=1)) / 2
        self.yaw = yaw - np.pi * np.rint(middle / np.pi)[:, None]
        radius = x * np.sin(self.yaw) - y * np.cos(self.yaw)
        self.point = np.stack([radius, z - arm.base], axis=2)
        self.steps = np.zeros((self.count, self.moves + 1, 4))
        self.index = np.zeros((self.count, self.moves, 4), dtype=int)
        self.whole = np.zeros(self.count, dtype=bool)
        self.tied = np.zeros((self.count, self.moves), dtype=bool)
        self._find_onsets()

    def _find_onsets(self) -> None:
        """Onsets (n, M), and whether ramps count both ends, from partial first and last steps."""
        row = np.arange(self.count)[:, None]
        speed = np.linalg.norm(np.diff(self.path, axis=1, append=self.path[:, -1:]), axis=2)

        def part_of_step(step: NDArray, towards: int) -> NDArray:
            one = np.take_along_axis(speed, step, axis=1)
            inside = np.clip(step[..., None] + [towards, 2 * towards], 0, self.length - 1)
            two, three = np.moveaxis(speed[row[:, None], inside.reshape(*step.shape, 2)], 2, 0)
            return np.clip(one / np.maximum(2 * two - three, 1e-12), 0, 1)

        self.onsets = self.first + 1 - part_of_step(self.first, 1)
        span = self.last + part_of_step(self.last, -1) - self.onsets
        spans = np.array(RAMPS)
        lasts = np.abs(span[..., None] - spans).min(axis=2, initial=9).sum(axis=1)
        counts = np.abs(span[..., None] - spans + 1).min(axis=2, initial=9).sum(axis=1)
        self.closed = counts < lasts
        # A ramp that counts both its ends has them on samples.
        whole = np.rint(self.onsets)
        near = self.closed & (np.abs(self.onsets - whole) < 0.1).all(axis=1)
        self.onsets = np.where(near[:, None], whole, self.onsets)

    def solve(self, *, similar: float = 0.002) -> None:
        """Fit commands and onsets, repeatedly and with more effort where that can help.

        Parameters
        ----------
        similar : float, default 0.002
            RMS error in m above which a movement is not similar to one of this arm.

        """
        some = np.arange(self.count)
        for effort in (1, 1, 2, 4):
            before = self.onsets
            self._solve(some, effort)
            self._refine()
            self.square = (self._error(self.onsets) ** 2).sum(axis=2)
            self.cost = self._per_movement(self.square)
            again = (self.cost > self.tolerance[:, None] ** 2).any(axis=1)
            # More effort does not help where no movement is similar to one of this arm.
            again &= (self.cost < similar**2).any(axis=1)
            if effort == 1 and some.size == self.count:
                # Commands depend on the onsets, and onsets on the commands.
                again |= (np.abs(self.onsets - before) > 1e-9).any(axis=1)
            some = np.flatnonzero(again)
            if some.size == 0:
                break

    @property
    def rms(self) -> NDArray:
        """RMS error (n,) of the paths in m."""
        return np.sqrt(self.square.mean(axis=1))

    @property
    def ambiguous(self) -> NDArray:
        """Movements (n, M) that are tied, cut off, not explained, or have a mirrored solution."""
        # Half a turn of yaw away there is a second solution unless it is beyond the motor's range.
        low, high = self.steps[..., 0].min(axis=1), self.steps[..., 0].max(axis=1)
        mirrored = (low - HALF_TURN >= -LIMIT) | (high + HALF_TURN <= LIMIT)
        cut = self.last >= self.length - 2
        return self.tied | (self.cost > EXPLAINED**2) | cut | mirrored[:, None]

    def _per_movement(self, values: NDArray) -> NDArray:
        """Mean (n, M) of values (n, T) from just before a movement to just after it."""
        return _means(values, np.maximum(self.first - 1, 0), np.minimum(self.last + 3, self.length))

    def _rests(self, *, rounding: float = 1.5e-6) -> tuple[NDArray, NDArray]:
        """Mean radius and height (n, M + 1, 2) of the rests in m, and their tolerance (n,).

        Parameters
        ----------
        rounding : float, default 1.5e-6
            Error in m, above that of rounding the published paths to 1e-6 m per axis.

        """
        none = np.zeros((self.count, 1), dtype=int)
        low = np.concatenate([none, self.last + 1], axis=1)
        high = np.concatenate([self.first + 1, none + self.length], axis=1)
        return _means(self.point, low, high), rounding + path_noise(self.path)

    def _kinks(self) -> NDArray:
        """Where the path has the kink at the end of a ramp (n, M, 3), well above the tolerance."""
        ends = self.onsets[..., None] + np.array(RAMPS) - self.closed[:, None, None]
        at = np.rint(ends).astype(int)[..., None]
        row = np.arange(self.count)[:, None, None, None]

        def speed(offsets: tuple[int, ...]) -> NDArray:
            index = np.clip(at + np.array(offsets), 0, self.length - 1)
            return np.diff(self.point[row, index], axis=3)

        # Without a kink, parabolas through the speed on either side meet at the end of the ramp.
        weights = np.linalg.pinv(np.vander(np.arange(-5.5, -1), 3))[-1]
        before, after = speed((-6, -5, -4, -3, -2, -1)), speed((1, 2, 3, 4, 5, 6))
        jump = np.einsum("nmlkd,k->nmld", before, weights)
        jump -= np.einsum("nmlkd,k->nmld", after, weights[::-1])
        return np.linalg.norm(jump, axis=3) > 10 * self.tolerance[:, None, None]

    def _solve(self, rows: NDArray, effort: int) -> None:
        """Fit the commands of some rows for the present onsets."""
        until = np.pad(self.first[:, 1:], ((0, 0), (0, 1)), constant_values=self.length - 1)
        offsets = np.arange(-4, RAMPS[-1] + 6, 2)
        index = np.floor(self.onsets).astype(int)[..., None] + offsets
        index = np.clip(index, 0, until[..., None][:, : self.moves])
        elapsed = index - self.onsets[..., None]
        spans = np.array(RAMPS) - self.closed[:, None, None]
        parts = np.clip(elapsed[:, :, None] / spans[..., None], 0, 1)
        yaw_error = self._yaw_error(index, parts)
        row = np.arange(self.count)[:, None, None]
        rests, self.tolerance = self._rests()
        samples, noise = self.point[row, index], yaw_error.min(axis=2)
        plane = Plane(self.arm, samples, parts, rests, self.tolerance, self._kinks(), noise)
        found = grid_chain(plane, rows)
        # A single rest may be near the grid by coincidence, all rests of a path are not.
        found = found.rows(np.flatnonzero((found.cost < EXPLAINED**2).all(axis=1)))
        self.whole[rows], self.whole[found.path] = False, True
        free = free_chain(plane, rows[~self.whole[rows]], effort)
        for each in (found, free):
            self.steps[each.path, :, 1:] = each.postures.clip(-LIMIT, LIMIT)
            self.index[each.path, :, 1:] = each.lengths
            self.tied[each.path] = each.tied
        self._set_yaw(rows, parts, yaw_error)

    def _yaw_error(self, index: NDArray, parts: NDArray) -> NDArray:
        """Mean square error (n, M, 3) in m^2 of the best yaw ramp of each length."""
        row = np.arange(self.count)[:, None, None]
        self.weight = np.where(self.determined[row, index], self.point[row, index, 0] ** 2, 0)
        self.angle = self.yaw[row, index] / STEP
        root = np.sqrt(self.weight)[:, :, None, :, None]
        design, target = root * _hats(parts), root * self.angle[:, :, None, :, None]
        # Where all weights are 0, so is the pseudo-inverse.
        fit = design @ (np.linalg.pinv(design) @ target)
        return ((target - fit) ** 2).mean(axis=(3, 4)) * STEP**2

    def _set_yaw(self, rows: NDArray, parts: NDArray, error: NDArray) -> None:
        """Ramps and rests of the yaw motor, by weighted least squares over each path."""
        parts, error, weight, angle = parts[rows], error[rows], self.weight[rows], self.angle[rows]
        length = np.argmin(error, axis=2)
        hats = _hats(np.take_along_axis(parts, length[..., None, None], axis=2)[:, :, 0])
        root = np.sqrt(weight)[..., None]
        design = np.zeros((*angle.shape, self.moves + 1))
        for move in range(self.moves):
            design[:, move, :, move : move + 2] = (root * hats)[:, move]
        design = design.reshape(rows.size, -1, self.moves + 1)
        transposed = design.swapaxes(1, 2)
        matrix = transposed @ design
        vector = transposed @ (root * angle[..., None]).reshape(rows.size, -1, 1)
        # Where the data do not determine the yaw, the regularisation makes it straight.
        # Weight in m^2 of a straight yaw: far less than that of a single sample off the axis.
        inverse = np.linalg.inv(matrix + 1e-14 * np.eye(self.moves + 1))
        yaw = (inverse @ vector)[..., 0]
        if self.moves == 0:
            yaw[:, 0] = np.median(self.yaw[rows], axis=1) / STEP * self.determined[rows].any(axis=1)
        whole = self.whole[rows, None]
        yaw = np.where(whole, np.rint(yaw), yaw).clip(-LIMIT, LIMIT)
        self.steps[rows, :, 0] = yaw
        ordered = np.sort(error, axis=2)
        noise = ordered[..., 0] + FLOOR
        moved = np.abs(np.diff(yaw, axis=1)) > np.where(whole, 0, 0.5)
        # A motor that stays has no ramp.
        self.index[rows, :, 0] = np.where(moved | ~whole, length, 0)
        deviation = np.sqrt(np.einsum("nii->ni", inverse)) / STEP
        uncertain = np.maximum(deviation[:, 1:], deviation[:, :-1]) * np.sqrt(noise) > 0.2
        self.tied[rows] |= uncertain | (moved & (ordered[..., 1] <= TIE * noise))

    @property
    def ramps(self) -> NDArray:
        """Ramp lengths (n, M, 4) in samples."""
        return np.array(RAMPS)[self.index]

    def commands(self, onsets: NDArray) -> NDArray:
        """Commands (n, T, 4) in units for onsets (n, M) in samples."""
        units = STRAIGHT - self.steps
        # A closed ramp of L samples lasts L - 1 intervals.
        spans = self.ramps - self.closed[:, None, None]
        made = ramps_and_holds(units[:, 0], units[:, 1:], spans, onsets, self.length)
        # A sum of ramps may exceed the range by rounding.
        return made.clip(STRAIGHT - LIMIT, STRAIGHT + LIMIT)

    def _error(self, onsets: NDArray) -> NDArray:
        """Error (n, T, 3) in m of the forward kinematics."""
        return self.arm.position(KINEMATIC.angles(self.commands(onsets))) - self.path

    def _refine(self) -> None:
        """Gauss-Newton on the onsets; movements do not overlap, so their equations are separate."""
        difference = 1e-3  # samples
        for _ in range(2):
            error = self._error(self.onsets)
            slope = (self._error(self.onsets + difference) - error) / difference
            power = self._per_movement((slope**2).sum(axis=2))
            shift = self._per_movement((slope * error).sum(axis=2)) / np.maximum(power, FLOOR)
            # A movement that the commands do not explain does not determine its onset.
            explained = self._per_movement((error**2).sum(axis=2)) < EXPLAINED**2
            self.onsets = self.onsets - np.where(explained, np.clip(shift, -2, 2), 0)
        whole = np.rint(self.onsets)
        fitted = self._per_movement((self._error(self.onsets) ** 2).sum(axis=2))
        rounded = self._per_movement((self._error(whole) ** 2).sum(axis=2))
        self.onsets = np.where(rounded <= TIE * fitted + FLOOR, whole, self.onsets)
