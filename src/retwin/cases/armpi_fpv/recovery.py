"""Commands of the ArmPi arm, recovered from the desired path of its end-effector.

The public arrays hold paths, not commands. Movements and their onsets are seen in the path, and
so is the vertical plane of the arm: the yaw motor is solved apart, by weighted least squares, and
leaves a planar arm with signed radius r and height h. For it there are two ways. Targets of the
real robot are whole command units, and then enumeration decides exactly (`armpi_plane`). Targets
of the simulated paths are not on that grid, and Gauss-Newton over all ramp combinations finds
them (`armpi_search`). Whatever else explains a path as well as the answer is counted, so that
`Recovery.ambiguous` is a statement and not a guess.

Inside, a motor's angle is a number of steps `500 - unit` of 0.24 deg, signed as `YawPitchArm`'s.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.cases.armpi_fpv.plane import LIMIT, STEP, TIE, Plane, grid_chain
from retwin.cases.armpi_fpv.ramps import RAMPS, STRAIGHT, ramp_commands, unit_angles
from retwin.cases.armpi_fpv.search import free_chain

__all__ = ["RAMPS", "Recovery", "ramp_commands", "recover_commands", "unit_angles"]

_HALF_TURN = 750  # command units in half a turn
_ROUNDING = 1.5e-6  # m: more than the rounding of the published paths (1e-6 m per axis)
_NOISIEST = 1e-4  # m: no more than this is taken for noise
_EXPLAINED = 5e-5  # m: a movement with a larger RMS is not explained
_NEARLY = 2e-3  # m: a movement with a larger RMS is nothing like one of this arm
_PULL = 1e-14  # m^2: far less than what a single sample off the axis says about the yaw
_BATCH = 32  # paths solved at a time: they fit the cache, and there is work for each core


@dataclass(frozen=True)
class Recovery:
    """Commands behind n paths of T samples with at most M movements, on 4 motors.

    A trajectory with fewer than M movements is padded at the end: onset NaN, targets repeated.
    A motor that a movement leaves where it is has no ramp to recover; its ramp says 60.

    Attributes
    ----------
    commands: (n, T, 4) in units, 0.24 deg each, 500 being straight.
    onsets: (n, M) fractional sample at which each movement starts.
    ramps: (n, M, 4) ramp lengths in samples.
    targets: (n, M, 4) units reached by each movement.
    start: (n, 4) units before the first movement.
    closed: (n,) True where a ramp of L samples counts both its ends, so it lasts L - 1 intervals
        (the simulated paths); False where it lasts L intervals (the real ones).
    whole: (n,) True where start and targets are whole units (the real paths); False where whole
        units cannot explain the path and they are estimates on a continuous scale (simulated).
    rms: (n,) RMS distance in m of the forward kinematics of `commands` from the path.
    ambiguous: (n, M) True where other commands on the grid explain the movement as well, where it
        is cut off by the end of the path, or where nothing found explains it to 0.05 mm.

    """

    commands: NDArray
    onsets: NDArray
    ramps: NDArray
    targets: NDArray
    start: NDArray
    closed: NDArray
    whole: NDArray
    rms: NDArray
    ambiguous: NDArray


def recover_commands(
    path: NDArray, *, arm: YawPitchArm, progress: Callable[[float], None] | None = None
) -> Recovery:
    """Commands behind desired paths (n, T, 3) in m of an arm with one yaw and three pitch joints.

    Movements are found in the path itself; number and spacing are free as long as the arm rests
    between them. Of the two mirrored postures (yaw half a turn away, pitch negated) the one with
    the yaw nearest to straight is returned, and flagged where the other is within +-120 deg too.
    A yaw that nothing in the path shows is reported as straight (500).

    `progress`, if given, is called with the finished fraction, ending at 1.

    Raises
    ------
    ValueError: `path` is not (n, T, 3) with T >= 2 or not finite, `arm` has not three links.

    """
    path = np.asarray(path)
    if path.ndim != 3 or path.shape[2] != 3 or path.shape[1] < 2:
        raise ValueError(
            f"path must have shape (n, T, 3) with T >= 2, got {path.shape}; "
            "pass one end-effector path per row, path[None] for a single one"
        )
    if len(arm.links) != 3:
        raise ValueError(
            f"arm must have 3 pitch joints, got {len(arm.links)}; pass the arm that made the path"
        )
    if not np.isfinite(path).all():
        bad = np.flatnonzero(~np.isfinite(path).all(axis=(1, 2)))
        raise ValueError(
            f"path must be finite, got NaN or inf in {bad.size} trajectories, the first at index "
            f"{bad[0]}; drop or repair them"
        )
    count, length = path.shape[:2]
    runs = [_movements(one) for one in path.astype(float)]
    counts = np.array([len(run) for run in runs], dtype=int)
    most = int(counts.max(initial=0))
    result = Recovery(
        commands=np.full((count, length, 4), float(STRAIGHT)),
        onsets=np.full((count, most), np.nan),
        ramps=np.full((count, most, 4), RAMPS[0]),
        targets=np.full((count, most, 4), float(STRAIGHT)),
        start=np.full((count, 4), float(STRAIGHT)),
        closed=np.zeros(count, dtype=bool),
        whole=np.ones(count, dtype=bool),
        rms=np.zeros(count),
        ambiguous=np.zeros((count, most), dtype=bool),
    )
    # Equal numbers of movements make rectangular batches.
    batches = []
    for moves in np.unique(counts):
        same = np.flatnonzero(counts == moves)
        batches += np.array_split(same, -(-same.size // _BATCH))

    def solve(rows: NDArray) -> int:
        spans = np.array([runs[row] for row in rows], dtype=int).reshape(
            rows.size, counts[rows[0]], 2
        )
        _Chunk(path[rows].astype(float), spans, arm).write(result, rows)
        return rows.size

    done = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for size in pool.map(solve, batches):
            done += size
            if progress is not None:
                progress(done / count)
    return result


def _noise(path: NDArray) -> NDArray:
    """Distance in m (n,) between noisy samples of paths (n, T, 3) at rest, if there is noise."""
    speed = np.linalg.norm(np.diff(path, axis=1), axis=2)
    # Rests are at least a quarter of a path; what is not so is no path of this arm.
    return np.minimum(np.quantile(speed, 0.25, axis=1), _NOISIEST)


def _movements(path: NDArray) -> list[tuple[int, int]]:
    """First and last moving step (from sample i to i + 1) of each movement in a path (T, 3)."""
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1)
    moving = np.flatnonzero(speed > 1e-9 + 6 * _noise(path[None])[0])
    found: list[tuple[int, int]] = []
    for step in moving.tolist():
        # A slow movement seems to stop when rounding hides its steps: bridge short stops, but
        # nothing lasts longer than the longest ramp.
        if found and step - found[-1][1] < 25 and step - found[-1][0] <= RAMPS[-1]:
            found[-1] = (found[-1][0], step)
        else:
            found.append((step, step))
    return found


class _Chunk:
    """n paths with M movements each, solved together; `write` puts the answer into a result."""

    def __init__(self, path: NDArray, spans: NDArray, arm: YawPitchArm) -> None:
        self.path, self.arm = path, arm
        self.count, self.moves = spans.shape[:2]
        self.length = path.shape[1]
        self.first, self.last = spans[..., 0], spans[..., 1]
        x, y, z = np.moveaxis(path, 2, 0)
        rho = np.hypot(x, y)
        # On the axis the plane of the arm is not seen; carry it over from the nearest sample.
        self.seen = rho > 2e-5
        index = np.where(self.seen, np.arange(self.length), -1)
        index = np.maximum.accumulate(index, axis=1)
        index = np.where(index < 0, np.argmax(self.seen, axis=1)[:, None], index)
        yaw = np.take_along_axis(np.arctan2(x, -y), index, axis=1)
        # Modulo half a turn the plane never jumps, so r changes its sign where the arm passes.
        yaw = np.unwrap(yaw, period=np.pi, axis=1)
        middle = (yaw.max(axis=1) + yaw.min(axis=1)) / 2
        self.yaw = yaw - np.pi * np.rint(middle / np.pi)[:, None]
        self.radius = x * np.sin(self.yaw) - y * np.cos(self.yaw)
        self.height = z - arm.base
        self._time()

    def _time(self) -> None:
        """Onsets (n, M), and whether ramps count both ends, from broken first and last steps."""
        row = np.arange(self.count)[:, None]
        speed = np.linalg.norm(np.diff(self.path, axis=1, append=self.path[:, -1:]), axis=2)

        def broken(step: NDArray, towards: int) -> NDArray:
            one = np.take_along_axis(speed, step, axis=1)
            inside = np.clip(step[..., None] + [towards, 2 * towards], 0, self.length - 1)
            two, three = np.moveaxis(speed[row[:, None], inside.reshape(*step.shape, 2)], 2, 0)
            return np.clip(one / np.maximum(2 * two - three, 1e-12), 0, 1)

        self.onsets = self.first + 1 - broken(self.first, 1)
        span = self.last + broken(self.last, -1) - self.onsets
        spans = np.array(RAMPS)
        lasts = np.abs(span[..., None] - spans).min(axis=2, initial=9).sum(axis=1)
        counts = np.abs(span[..., None] - spans + 1).min(axis=2, initial=9).sum(axis=1)
        self.closed = counts < lasts
        # A ramp that counts both its ends has them on samples.
        whole = np.rint(self.onsets)
        near = self.closed & (np.abs(self.onsets - whole) < 0.1).all(axis=1)
        self.onsets = np.where(near[:, None], whole, self.onsets)

    def write(self, result: Recovery, rows: NDArray) -> None:
        """Solve, more than once where that helps, and fill in rows of the result."""
        self.steps = np.zeros((self.count, self.moves + 1, 4))
        self.index = np.zeros((self.count, self.moves, 4), dtype=int)
        self.whole = np.zeros(self.count, dtype=bool)
        self.tied = np.zeros((self.count, self.moves), dtype=bool)
        some = np.arange(self.count)
        for effort in (1, 1, 2, 4):
            before = self.onsets
            self._solve(some, effort)
            self._refine()
            square = (self._error(self.onsets) ** 2).sum(axis=2)
            cost = self._per_movement(square)
            again = (cost > self.tolerance[:, None] ** 2).any(axis=1)
            # More effort is in vain where not one movement is nearly like one of this arm.
            again &= (cost < _NEARLY**2).any(axis=1)
            if effort == 1 and some.size == self.count:
                # Commands and onsets need one another.
                again |= (np.abs(self.onsets - before) > 1e-9).any(axis=1)
            some = np.flatnonzero(again)
            if some.size == 0:
                break
        moves = self.moves
        commands = self._commands(self.onsets)
        result.commands[rows] = commands
        result.onsets[rows, :moves] = self.onsets
        result.ramps[rows, :moves] = self.ramps
        result.targets[rows, :moves] = STRAIGHT - self.steps[:, 1:]
        result.targets[rows, moves:] = STRAIGHT - self.steps[:, -1:]
        result.start[rows] = STRAIGHT - self.steps[:, 0]
        result.closed[rows], result.whole[rows] = self.closed, self.whole
        result.rms[rows] = np.sqrt(square.mean(axis=1))
        # Half a turn of yaw away there is a second answer unless the motor could not go there.
        low, high = self.steps[..., 0].min(axis=1), self.steps[..., 0].max(axis=1)
        mirrored = (low - _HALF_TURN >= -LIMIT) | (high + _HALF_TURN <= LIMIT)
        poor = cost > _EXPLAINED**2
        cut = self.last >= self.length - 2
        result.ambiguous[rows, :moves] = self.tied | poor | cut | mirrored[:, None]

    def _per_movement(self, values: NDArray) -> NDArray:
        """Mean (n, M) of values (n, T) from just before a movement to just after it."""
        total = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
        low, high = np.maximum(self.first - 1, 0), np.minimum(self.last + 3, self.length)
        span = np.take_along_axis(total, high, axis=1) - np.take_along_axis(total, low, axis=1)
        return span / (high - low)

    def _rests(self) -> tuple[NDArray, NDArray]:
        """Mean radius and height (n, M + 1, 2) of the rests, and the tolerance (n,) on them."""
        none = np.zeros((self.count, 1), dtype=int)
        low = np.concatenate([none, self.last + 1], axis=1)
        high = np.concatenate([self.first, none + self.length - 1], axis=1)
        where = []
        for signal in (self.radius, self.height):
            total = np.cumsum(np.pad(signal, ((0, 0), (1, 0))), axis=1)
            sums = np.take_along_axis(total, high + 1, 1) - np.take_along_axis(total, low, 1)
            where.append(sums / (high + 1 - low))
        return np.stack(where, axis=2), _ROUNDING + _noise(self.path)

    def _kinks(self) -> NDArray:
        """Where the path in the plane (n, M, 3) surely has the kink of a ramp's end."""
        plane = np.stack([self.radius, self.height], axis=2)
        ends = self.onsets[..., None] + np.array(RAMPS) - self.closed[:, None, None]
        at = np.rint(ends).astype(int)[..., None]
        row = np.arange(self.count)[:, None, None, None]

        def speed(offsets: tuple[int, ...]) -> NDArray:
            index = np.clip(at + np.array(offsets), 0, self.length - 1)
            return np.diff(plane[row, index], axis=3)

        # Parabolas through the speed on either side meet at the end where there is no kink.
        meet = np.linalg.pinv(np.vander(np.arange(-5.5, -1), 3))[-1]
        before, after = speed((-6, -5, -4, -3, -2, -1)), speed((1, 2, 3, 4, 5, 6))
        jump = np.einsum("nmlkd,k->nmld", before, meet)
        jump -= np.einsum("nmlkd,k->nmld", after, meet[::-1])
        return np.linalg.norm(jump, axis=3) > 10 * self.tolerance[:, None, None]

    def _solve(self, rows: NDArray, effort: int) -> None:
        """Commands of some rows for the onsets as they stand."""
        until = np.pad(self.first[:, 1:], ((0, 0), (0, 1)), constant_values=self.length - 1)
        offsets = np.arange(-4, RAMPS[-1] + 6, 2)
        index = np.floor(self.onsets).astype(int)[..., None] + offsets
        index = np.clip(index, 0, until[..., None][:, : self.moves])
        since = index - self.onsets[..., None]
        spans = np.array(RAMPS) - self.closed[:, None, None]
        parts = np.clip(since[:, :, None] / spans[..., None], 0, 1)
        turn = self._yaw_fit(index, parts)
        row = np.arange(self.count)[:, None, None]
        rests, self.tolerance = self._rests()
        plane = Plane(
            self.arm.links, self.radius[row, index], self.height[row, index], parts,
            rests, self.tolerance, self._kinks(), turn.min(axis=2),
        )  # fmt: skip
        plane = plane.rows(rows)
        whole, found = grid_chain(plane)
        # A rest is near the grid by accident once in a while; a whole path never is.
        good: NDArray = np.all(found.cost < _EXPLAINED**2, axis=1)
        whole[whole] = good
        self.whole[rows] = whole
        free = free_chain(plane.rows(~whole), effort)
        for some, solution in ((rows[whole], found.rows(good)), (rows[~whole], free)):
            self.steps[some, :, 1:] = solution.postures.clip(-LIMIT, LIMIT)
            self.index[some, :, 1:] = solution.lengths
            self.tied[some] = solution.tied
        self._set_yaw(rows, parts, turn)

    def _yaw_fit(self, index: NDArray, parts: NDArray) -> NDArray:
        """Mean square error (n, M, 3) in m^2 of the best yaw ramp of each length."""
        row = np.arange(self.count)[:, None, None]
        self.weight = np.where(self.seen[row, index], self.radius[row, index] ** 2, 0)
        self.angle = self.yaw[row, index] / STEP
        w, y = self.weight[:, :, None], self.angle[:, :, None]
        a, b = 1 - parts, parts
        aa, ab, bb = ((w * u * v).sum(-1) for u, v in ((a, a), (a, b), (b, b)))
        ay, by = (w * a * y).sum(-1), (w * b * y).sum(-1)
        aa, bb = aa + _PULL, bb + _PULL
        det = aa * bb - ab**2
        old, new = (bb * ay - ab * by) / det, (aa * by - ab * ay) / det
        fit = old[..., None] * a + new[..., None] * b
        return (w * (y - fit) ** 2).mean(axis=-1) * STEP**2

    def _set_yaw(self, rows: NDArray, parts: NDArray, turn: NDArray) -> None:
        """Ramps of the yaw motor, and where it rests, by weighted least squares over a path."""
        moves = np.arange(self.moves)
        parts, turn, weight, angle = parts[rows], turn[rows], self.weight[rows], self.angle[rows]
        length = np.argmin(turn, axis=2)
        part = np.take_along_axis(parts, length[..., None, None], axis=2)[:, :, 0]
        matrix = np.zeros((rows.size, self.moves + 1, self.moves + 1))
        vector = np.zeros((rows.size, self.moves + 1))
        hats = (1 - part, part)
        for i in range(2):
            vector[:, moves + i] += (weight * hats[i] * angle).sum(axis=2)
            for j in range(2):
                matrix[:, moves + i, moves + j] += (weight * hats[i] * hats[j]).sum(axis=2)
        # What nothing shows is pulled to straight.
        inverse = np.linalg.inv(matrix + _PULL * np.eye(self.moves + 1))
        yaw = (inverse @ vector[..., None])[..., 0]
        if self.moves == 0:
            yaw[:, 0] = np.median(self.yaw[rows], axis=1) / STEP * self.seen[rows].any(axis=1)
        whole = self.whole[rows, None]
        yaw = np.where(whole, np.rint(yaw), yaw).clip(-LIMIT, LIMIT)
        self.steps[rows, :, 0] = yaw
        ordered = np.sort(turn, axis=2)
        noise = ordered[..., 0] + 1e-18
        moved = np.abs(np.diff(yaw, axis=1)) > np.where(whole, 0, 0.5)
        # A motor that stays has no ramp.
        self.index[rows, :, 0] = np.where(moved | ~whole, length, 0)
        spread = np.sqrt(np.einsum("nii->ni", inverse)) / STEP
        unsure = np.maximum(spread[:, 1:], spread[:, :-1]) * np.sqrt(noise) > 0.2
        self.tied[rows] |= unsure | (moved & (ordered[..., 1] <= TIE * noise))

    @property
    def ramps(self) -> NDArray:
        """Ramp lengths (n, M, 4) in samples."""
        return np.array(RAMPS)[self.index]

    def _commands(self, onsets: NDArray) -> NDArray:
        units = STRAIGHT - self.steps
        return ramp_commands(
            units[:, 0], units[:, 1:], self.ramps, onsets, self.length, closed=self.closed
        )

    def _error(self, onsets: NDArray) -> NDArray:
        return self.arm.position(unit_angles(self._commands(onsets))) - self.path

    def _refine(self) -> None:
        """Gauss-Newton on the onsets: movements do not overlap, so each has its own equation."""
        nudge = 1e-3
        for _ in range(2):
            error = self._error(self.onsets)
            slope = (self._error(self.onsets + nudge) - error) / nudge
            power = self._per_movement((slope**2).sum(axis=2))
            shift = self._per_movement((slope * error).sum(axis=2)) / np.maximum(power, 1e-18)
            # What the commands do not explain says nothing about its onset.
            good = self._per_movement((error**2).sum(axis=2)) < _EXPLAINED**2
            self.onsets = self.onsets - np.where(good, np.clip(shift, -2, 2), 0)
        whole = np.rint(self.onsets)
        now = self._per_movement((self._error(self.onsets) ** 2).sum(axis=2))
        then = self._per_movement((self._error(whole) ** 2).sum(axis=2))
        self.onsets = np.where(then <= TIE * now + 1e-18, whole, self.onsets)
