"""Commands of the ArmPi arm, recovered from the desired path of its end-effector.

The public arrays hold paths, not commands. What makes the recovery exact is that every resting
position is one of finitely many grid points of the motors: for each direction of the last link
the two links before it are solved in closed form, and only whole command units are kept. Usually
one point per rest survives. Ramp lengths are then decided by forward kinematics of all their
combinations, for all trajectories at once, and by the cheapest chain of rests; onsets come from
Gauss-Newton. Everything that explains the path as well as the answer does is counted, so that
`Recovery.ambiguous` is a statement and not a guess.

Inside this module a motor's angle is an integer `500 - unit`, positive like `YawPitchArm`'s
angles, one step being 0.24 deg; the yaw joint is apart because the vertical plane of the arm is
seen in the path: it leaves a planar arm with signed radius r and height h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.twins.arm import YawPitchArm

__all__ = ["RAMPS", "Recovery", "ramp_commands", "recover_commands", "unit_angles"]

RAMPS = (60, 80, 100)
"""Ramp lengths of a motor, in samples."""

_STEP = np.deg2rad(0.24)  # one command unit
_STRAIGHT = 500  # command unit of angle 0
_TURN = 1500  # command units in a full turn
_ROUNDING = 1.5e-6  # m: more than the rounding of the published paths (1e-6 m per axis)
_LADDER = (1, 6, 36)  # tolerances to try on a rest, in units of its own
_MOST = 24  # grid points kept per rest
_EXPLAINED = 5e-5  # m: a movement with a larger RMS is not explained
_TIE = 1.21  # mean squares closer than this cannot be told apart ...
_FLOOR = 1e-18  # ... nor those below this, in m^2: double precision is reached
_CHUNK = 200  # trajectories at a time, to bound memory


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
    targets: (n, M, 4) whole units reached by each movement.
    start: (n, 4) whole units before the first movement.
    closed: (n,) True where a ramp of L samples counts both its ends, so it lasts L - 1 intervals
        (the simulated paths); False where it lasts L intervals (the real ones).
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
    rms: NDArray
    ambiguous: NDArray


def unit_angles(commands: NDArray) -> NDArray:
    """Angles in rad of commands in units, any shape: 120 deg - 0.24 deg per unit."""
    return (_STRAIGHT - commands) * _STEP


def ramp_commands(
    start: ArrayLike,
    targets: ArrayLike,
    ramps: ArrayLike,
    onsets: ArrayLike,
    length: int,
    *,
    closed: ArrayLike = False,
) -> NDArray:
    """Commands (n, length, motors) that ramp linearly from target to target and hold.

    Parameters
    ----------
    start: (n, motors) before the first movement.
    targets, ramps: (n, M, motors) value reached by each movement and length of its ramp in
        samples.
    onsets: (n, M) fractional sample at which a movement starts; NaN for a movement left out.
    closed: one bool or (n,): a ramp of L samples is `linspace(old, new, L)`, both ends counted,
        instead of lasting L intervals.

    """
    start, targets = np.asarray(start, float), np.asarray(targets, float)
    spans = np.asarray(ramps, float) - np.reshape(np.asarray(closed, float), (-1, 1, 1))
    onsets = np.asarray(onsets, float)
    time = np.arange(length)
    commands = np.repeat(start[:, None], length, axis=1)
    previous = start
    for move in range(targets.shape[1]):
        since = np.nan_to_num(time - onsets[:, move, None], nan=-1.0)
        part = np.clip(since[..., None] / spans[:, None, move], 0, 1)
        commands += (targets[:, move] - previous)[:, None] * part
        previous = targets[:, move]
    return commands


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
        commands=np.full((count, length, 4), float(_STRAIGHT)),
        onsets=np.full((count, most), np.nan),
        ramps=np.full((count, most, 4), RAMPS[0]),
        targets=np.full((count, most, 4), float(_STRAIGHT)),
        start=np.full((count, 4), float(_STRAIGHT)),
        closed=np.zeros(count, dtype=bool),
        rms=np.zeros(count),
        ambiguous=np.zeros((count, most), dtype=bool),
    )
    done = 0
    # Equal numbers of movements make rectangular batches.
    for moves in np.unique(counts):
        same = np.flatnonzero(counts == moves)
        for rows in np.array_split(same, -(-same.size // _CHUNK)):
            spans = np.array([runs[row] for row in rows]).reshape(rows.size, moves, 2)
            _Chunk(path[rows].astype(float), spans, arm).write(result, rows)
            done += rows.size
            if progress is not None:
                progress(done / count)
    return result


def _movements(path: NDArray) -> list[tuple[int, int]]:
    """First and last moving step (from sample i to i + 1) of each movement in a path (T, 3)."""
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1)
    # Rests are at least a quarter of a path, and noise, if any, is seen there.
    moving = np.flatnonzero(speed > 1e-9 + 6 * np.quantile(speed, 0.25))
    found: list[tuple[int, int]] = []
    for step in moving.tolist():
        # A slow movement seems to stop when rounding hides its steps: bridge short stops, but
        # nothing lasts longer than the longest ramp.
        if found and step - found[-1][1] < 25 and step - found[-1][0] <= RAMPS[-1]:
            found[-1] = (found[-1][0], step)
        else:
            found.append((step, step))
    return found


def _grid_points(
    radius: NDArray, height: NDArray, tolerance: NDArray, links: tuple[float, ...]
) -> tuple[NDArray, NDArray, NDArray]:
    """All whole-unit postures (., 3) within tolerance (m) of points (p,) of the arm's plane.

    Returns the point each posture belongs to, the postures, and their distance from the point.
    """
    first, second, last = links
    tip = np.arange(_TURN)
    wrist_r = radius[:, None] - last * np.sin(tip * _STEP)
    wrist_h = height[:, None] - last * np.cos(tip * _STEP)
    reach = np.hypot(wrist_r, wrist_h)
    slack = tolerance[:, None]

    def elbow(distance: NDArray) -> NDArray:
        cosine = (distance**2 - first**2 - second**2) / (2 * first * second)
        return np.arccos(np.clip(cosine, -1, 1)) / _STEP

    low, high = np.ceil(elbow(reach + slack)), np.floor(elbow(np.maximum(reach - slack, 0)))
    # Where the elbow is nearly straight the window is wide enough for several whole units.
    number = np.where(reach - slack <= first + second, high - low + 1, 0).clip(0).astype(int)
    point, column = np.nonzero(number)
    number = number[point, column]
    point, column = np.repeat(point, number), np.repeat(column, number)
    nth = np.arange(point.size) - np.repeat(np.cumsum(number) - number, number)
    bend = low[point, column] + nth
    point, column = np.tile(point, 2), np.tile(column, 2)
    bend = np.concatenate([bend, -bend])
    inner = np.arctan2(second * np.sin(bend * _STEP), first + second * np.cos(bend * _STEP))
    base = np.rint((np.arctan2(wrist_r[point, column], wrist_h[point, column]) - inner) / _STEP)
    posture = np.stack([base, bend, tip[column] - base - bend], axis=1)
    posture = (posture + _TURN // 2) % _TURN - _TURN // 2
    r, h = _plane(posture * _STEP, links)
    error = np.hypot(r - radius[point], h - height[point])
    keep = (error <= tolerance[point]) & (np.abs(posture) <= _STRAIGHT).all(axis=1)
    return _best_points(point[keep], posture[keep], error[keep])


def _best_points(
    point: NDArray, posture: NDArray, error: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Distinct postures of each point, the nearest `_MOST` of them, ordered by point."""
    keys = np.concatenate([point[:, None], posture], axis=1)
    _, index = np.unique(keys, axis=0, return_index=True)
    index = index[np.lexsort((error[index], point[index]))]
    point = point[index]
    rank = np.arange(point.size) - np.searchsorted(point, point)
    index, point = index[rank < _MOST], point[rank < _MOST]
    return point, posture[index], error[index]


def _plane(angles: NDArray, links: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Signed radius and height above the first pitch joint of pitch angles (..., 3) in rad."""
    total = np.cumsum(angles, axis=-1)
    return np.sin(total) @ np.array(links), np.cos(total) @ np.array(links)


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
        self.onsets = self._first_onsets()

    def _first_onsets(self) -> NDArray:
        """Onsets (n, M) from how much shorter the first step of a movement is than the second."""
        speed = np.linalg.norm(np.diff(self.path, axis=1, append=self.path[:, -1:]), axis=2)
        one = np.take_along_axis(speed, self.first, axis=1)
        two = np.take_along_axis(speed, np.minimum(self.first + 1, self.length - 1), axis=1)
        return self.first + 1 - np.minimum(one / np.maximum(two, 1e-12), 1)

    def write(self, result: Recovery, rows: NDArray) -> None:
        moves = self.moves
        point, posture, _ = self._rests()
        self.edges(point, posture)
        for _ in range(2):
            self._decide()
            self._refine()
        self._decide()
        commands = self._commands(self.onsets)
        error = self.path - self.arm.position(unit_angles(commands))
        square = (error**2).sum(axis=2)
        result.commands[rows] = commands
        result.onsets[rows, :moves] = self.onsets
        result.ramps[rows, :moves] = self.ramps
        result.targets[rows, :moves] = _STRAIGHT - self.grid[:, 1:]
        result.targets[rows, moves:] = _STRAIGHT - self.grid[:, -1:]
        result.start[rows] = _STRAIGHT - self.grid[:, 0]
        result.closed[rows] = self.closed
        result.rms[rows] = np.sqrt(square.mean(axis=1))
        # Half a turn of yaw away there is a second answer unless the motor could not go there.
        low, high = self.grid[..., 0].min(axis=1), self.grid[..., 0].max(axis=1)
        mirrored = np.maximum(abs(low), abs(high)) > 0
        mirrored &= (low - _TURN // 2 >= -_STRAIGHT) | (high + _TURN // 2 <= _STRAIGHT)
        poor = self._per_movement(square) > _EXPLAINED**2
        result.ambiguous[rows, :moves] = self.tied | poor | mirrored[:, None]

    def _per_movement(self, values: NDArray) -> NDArray:
        """Mean (n, M) of values (n, T) from just before a movement to just after it."""
        total = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
        low, high = np.maximum(self.first - 1, 0), np.minimum(self.last + 3, self.length)
        span = np.take_along_axis(total, high, axis=1) - np.take_along_axis(total, low, axis=1)
        return span / (high - low)

    def _rests(self) -> tuple[NDArray, NDArray, NDArray]:
        """Grid postures of every rest; rest j of path i is point i * (M + 1) + j."""
        none = np.zeros((self.count, 1), dtype=int)
        low = np.concatenate([none, self.last + 1], axis=1)
        high = np.concatenate([self.first, none + self.length - 1], axis=1)
        where = []
        noise = np.zeros(low.shape)
        for signal in (self.radius, self.height):
            total = np.cumsum(np.pad(signal, ((0, 0), (1, 0))), axis=1)
            size = high - low + 1
            mean = np.take_along_axis(total, high + 1, 1) - np.take_along_axis(total, low, 1)
            mean = np.where(size > 1, mean / size, np.take_along_axis(signal, high, 1))
            where.append(mean.ravel())
        radius, height = where
        found = []
        left = np.arange(radius.size)
        for factor in _LADDER:
            tolerance = np.full(left.size, factor * _ROUNDING) + noise.ravel()[left]
            point, posture, error = _grid_points(
                radius[left], height[left], tolerance, self.arm.links
            )
            found.append((left[point], posture, error))
            left = np.setdiff1d(left, left[point])
        # Nothing fits: stay straight, which `write` will find unexplained.
        found.append((left, np.zeros((left.size, 3)), np.zeros(left.size)))
        point, posture, error = (np.concatenate(part) for part in zip(*found, strict=True))
        order = np.argsort(point, kind="stable")
        return point[order], posture[order], error[order]

    def edges(self, point: NDArray, posture: NDArray) -> None:
        """All steps from a posture of a rest to a posture of the next one."""
        self.point, self.posture = point, posture
        rests = self.moves + 1
        begin = np.searchsorted(point, np.arange(self.count * rests + 1))
        number = np.diff(begin)
        head = np.flatnonzero(point % rests < self.moves)
        each = number[point[head] + 1]
        self.head = np.repeat(head, each)
        nth = np.arange(self.head.size) - np.repeat(np.cumsum(each) - each, each)
        self.tail = begin[point[self.head] + 1] + nth
        self.owner = point[self.head] // rests
        self.move = point[self.head] % rests

    def _samples(self) -> NDArray:
        """Samples (n, M, K) that judge a movement: every second one, from before to after it."""
        until = np.pad(self.first[:, 1:], ((0, 0), (0, 1)), constant_values=self.length - 1)
        offsets = np.arange(-4, RAMPS[-1] + 6, 2)
        index = np.floor(self.onsets).astype(int)[..., None] + offsets
        return np.clip(index, 0, until[..., None])

    def _parts(self, index: NDArray) -> NDArray:
        """Finished part (n, M, 2, 3, K) of each ramp, open and closed, at the samples `index`."""
        spans = np.array(RAMPS) - np.array([[0], [1]])
        since = index - self.onsets[..., None]
        return np.clip(since[:, :, None, None] / spans[..., None], 0, 1)

    def _plane_costs(self, index: NDArray, parts: NDArray) -> NDArray:
        """Mean square error (edges, 2, 27) in r and h of all ramp combinations of each step."""
        owner, move = self.owner, self.move
        at = index[owner, move]
        radius = self.radius[owner[:, None], at][:, None, None, None, None]
        height = self.height[owner[:, None], at][:, None, None, None, None]
        part = parts[owner, move]
        old, new = self.posture[self.head], self.posture[self.tail]
        angle = old[:, None, None, None] + (new - old)[:, None, None, None] * part[..., None]
        one, two, three = np.moveaxis(angle * _STEP, -1, 0)
        second = one[:, :, :, None] + two[:, :, None]
        third = second[:, :, :, :, None] + three[:, :, None, None]
        reach = [one[:, :, :, None, None], second[:, :, :, :, None], third]
        r = sum(link * np.sin(turn) for link, turn in zip(self.arm.links, reach, strict=True))
        h = sum(link * np.cos(turn) for link, turn in zip(self.arm.links, reach, strict=True))
        cost = ((r - radius) ** 2 + (h - height) ** 2).mean(axis=-1)
        # A motor that stays has no ramp: leave one combination of the equal ones.
        grid = np.moveaxis(np.indices((3, 3, 3)), 0, -1)
        idle = (old == new)[:, None, None, None] & (grid > 0)
        cost = np.where(idle.any(axis=-1)[:, None], np.inf, cost)
        return cost.reshape(owner.size, 2, 27)

    def _yaw_fit(self, index: NDArray, parts: NDArray) -> NDArray:
        """Mean square error (n, M, 2, 3) in m^2 of the best yaw ramp of each length."""
        row = np.arange(self.count)[:, None, None]
        self.weight = np.where(self.seen[row, index], self.radius[row, index] ** 2, 0)
        self.angle = self.yaw[row, index] / _STEP
        w, y = self.weight[:, :, None, None], self.angle[:, :, None, None]
        a, b = 1 - parts, parts
        aa, ab, bb = ((w * u * v).sum(-1) for u, v in ((a, a), (a, b), (b, b)))
        ay, by = (w * a * y).sum(-1), (w * b * y).sum(-1)
        aa, bb = aa + 1e-14, bb + 1e-14
        det = aa * bb - ab**2
        old, new = (bb * ay - ab * by) / det, (aa * by - ab * ay) / det
        fit = old[..., None] * a + new[..., None] * b
        return (w * (y - fit) ** 2).mean(axis=-1) * _STEP**2

    def _decide(self) -> None:
        """Cheapest chain of rests, ramps and convention for the onsets as they stand."""
        index = self._samples()
        parts = self._parts(index)
        cost = self._plane_costs(index, parts)
        turn = self._yaw_fit(index, parts)
        best = cost.min(axis=2)
        ahead = np.full((self.point.size, 2), np.inf)
        behind = np.full((self.point.size, 2), np.inf)
        place = self.point % (self.moves + 1)
        ahead[place == 0], behind[place == self.moves] = 0, 0
        for move in range(self.moves):
            at = self.move == move
            np.minimum.at(ahead, self.tail[at], ahead[self.head[at]] + best[at])
            at = self.move == self.moves - 1 - move
            np.minimum.at(behind, self.head[at], behind[self.tail[at]] + best[at])
        chain = ahead[self.head][..., None] + cost + behind[self.tail][..., None]
        chain += turn.min(axis=3).sum(axis=1)[self.owner][..., None]
        self._choose(cost, chain, turn, behind)
        self._set_yaw(index, parts, turn)

    def _choose(self, cost: NDArray, chain: NDArray, turn: NDArray, behind: NDArray) -> None:
        """Walk the cheapest chain; mark the movements another chain explains as well."""
        total = np.full((self.count, 2), np.inf)
        at = self.move == 0
        np.minimum.at(total, self.owner[at], chain[at].min(axis=2))
        family = np.argmin(total, axis=1)
        self.closed = family == 1
        rest_first = np.searchsorted(self.point, np.arange(self.count) * (self.moves + 1))
        self.grid = np.zeros((self.count, self.moves + 1, 4))
        self.grid[:, 0, 1:] = self.posture[rest_first]
        self.length_index = np.zeros((self.count, self.moves, 4), dtype=int)
        self.tied = np.zeros((self.count, self.moves), dtype=bool)
        rows = np.arange(self.count)
        standing = None
        for move in range(self.moves):
            edge = np.flatnonzero(self.move == move)
            if standing is not None:
                edge = edge[self.head[edge] == standing[self.owner[edge]]]
            own = self.owner[edge]
            value = cost[edge, family[own]].min(axis=1) + behind[self.tail[edge], family[own]]
            order = np.lexsort((value, own))
            edge = edge[order[np.searchsorted(own[order], rows)]]
            standing = self.tail[edge]
            if move == 0:
                self.grid[:, 0, 1:] = self.posture[self.head[edge]]
            self.grid[:, move + 1, 1:] = self.posture[standing]
            combination = np.argmin(cost[edge, family], axis=1)
            self.length_index[:, move, 1:] = np.stack(
                np.unravel_index(combination, (3, 3, 3)), axis=1
            )
            noise = cost[edge, family, combination] + turn[rows, move, family].min(axis=1)
            limit = total[rows, family] + (_TIE - 1) * noise + _FLOOR
            at = self.move == move
            as_good = (chain[at] <= limit[self.owner[at], None, None]).sum(axis=(1, 2))
            self.tied[:, move] = np.bincount(self.owner[at], as_good, self.count) > 1

    def _set_yaw(self, index: NDArray, parts: NDArray, turn: NDArray) -> None:
        """Ramps of the yaw motor, and its whole units at all rests by weighted least squares."""
        rows, moves = np.arange(self.count), np.arange(self.moves)
        turn = turn[rows, :, self.closed.astype(int)]
        length = np.argmin(turn, axis=2)
        part = parts[rows[:, None], moves, self.closed.astype(int)[:, None], length]
        matrix = np.zeros((self.count, self.moves + 1, self.moves + 1))
        vector = np.zeros((self.count, self.moves + 1))
        hats = np.stack([1 - part, part])
        for i, j in np.ndindex(2, 2):
            matrix[:, moves + i, moves + j] += (self.weight * hats[i] * hats[j]).sum(axis=2)
        for i in range(2):
            vector[:, moves + i] += (self.weight * hats[i] * self.angle).sum(axis=2)
        matrix += 1e-14 * np.eye(self.moves + 1)
        inverse = np.linalg.inv(matrix)
        self.grid[..., 0] = np.rint((inverse @ vector[..., None])[..., 0]).clip(
            -_STRAIGHT, _STRAIGHT
        )
        if self.moves == 0:
            middle = np.median(np.where(self.seen, self.yaw, 0), axis=1)
            self.grid[:, 0, 0] = np.rint(middle / _STEP)
            return
        ordered = np.sort(turn, axis=2)
        noise = ordered[..., 0] + _FLOOR
        moved = np.diff(self.grid[..., 0], axis=1) != 0
        self.length_index[..., 0] = np.where(moved, length, 0)
        self.tied |= moved & (ordered[..., 1] <= _TIE * noise)
        spread = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)) / _STEP
        unsure = np.maximum(spread[:, 1:], spread[:, :-1]) * np.sqrt(noise) > 0.15
        self.tied |= unsure

    @property
    def ramps(self) -> NDArray:
        return np.array(RAMPS)[self.length_index]

    def _commands(self, onsets: NDArray) -> NDArray:
        units = _STRAIGHT - self.grid
        return ramp_commands(
            units[:, 0], units[:, 1:], self.ramps, onsets, self.length, closed=self.closed
        )

    def _error(self, onsets: NDArray) -> NDArray:
        return self.arm.position(unit_angles(self._commands(onsets))) - self.path

    def _refine(self) -> None:
        """Gauss-Newton on the onsets: movements do not overlap, so each has its own equation."""
        step = 1e-3
        for _ in range(3):
            error = self._error(self.onsets)
            slope = (self._error(self.onsets + step) - error) / step
            power = self._per_movement((slope**2).sum(axis=2))
            shift = self._per_movement((slope * error).sum(axis=2)) / np.maximum(power, 1e-18)
            self.onsets = self.onsets - np.clip(shift, -2, 2)
        whole = np.rint(self.onsets)
        now = self._per_movement((self._error(self.onsets) ** 2).sum(axis=2))
        then = self._per_movement((self._error(whole) ** 2).sum(axis=2))
        self.onsets = np.where(then <= _TIE * now + _FLOOR, whole, self.onsets)
