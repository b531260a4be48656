"""Commands of the ArmPi arm, recovered from the desired path of its end-effector.

The public arrays hold paths, not commands. Movements and their onsets are visible in the path, and
so is the vertical plane of the arm: the yaw motor is solved separately, by weighted least squares,
and leaves a planar arm with signed radius r and height h. Targets of the real robot are whole
command units, and enumeration decides exactly (`plane`). Targets of the simulated paths are not on
that grid; Gauss-Newton over all ramp combinations finds them (`search`). Other explanations of a
path with about the same error are counted, which makes `Recovery.ambiguous` a computed result.
`RECORDED` is what files of the arm's trajectories need of its case.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import check_finite
from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.cases.armpi_fpv.path_fit import PathFit, path_noise
from retwin.cases.armpi_fpv.twin import ARM, KINEMATIC, RAMPS, STRAIGHT
from retwin.cases.recorded import RecordedCase
from retwin.checks import require
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.progress import Progress

PATHS_PER_BATCH = 32
"""Number of paths that are solved together: they fit the cache, and every core has work."""
STUCK = tuple(f"Motor_{i}_Stuck" for i in range(1, 5))
"""Classes in which motor i stops moving."""
BIASED = tuple(f"Motor_{i}_Steady_state_error" for i in range(1, 5))
"""Classes in which motor i settles at a biased target: the paper's steady-state error (SSE)."""
CLASSES = (HEALTHY, *STUCK, *BIASED)
"""All classes in the order of probabilities and of confusion matrices."""


@dataclass(frozen=True)
class Recovery:
    """Commands behind n paths of T samples with at most M movements, on 4 motors.

    A trajectory with fewer than M movements is padded at the end: onset NaN, targets repeated.
    A motor that a movement leaves unchanged has no ramp to recover; its ramp is 60.

    Attributes
    ----------
    commands : ndarray, shape (n, T, 4)
        In units of 0.24 deg each, 500 being straight.
    onsets : ndarray, shape (n, M)
        Onset of each movement in samples, with fractions.
    ramps : ndarray, shape (n, M, 4)
        Ramp durations in samples.
    targets : ndarray, shape (n, M, 4)
        Commands at the end of each movement in units.
    start : ndarray, shape (n, 4)
        Commands before the first movement in units.
    closed : ndarray of bool, shape (n,)
        True where a ramp of L samples counts both its ends, so that it lasts L - 1 intervals (the
        simulated paths); False where it lasts L intervals (the real paths).
    whole : ndarray of bool, shape (n,)
        True where start and targets are whole units (the real paths); False where whole units
        cannot explain the path and they are estimates on a continuous scale (simulated).
    rms : ndarray, shape (n,)
        RMS distance in m of the forward kinematics of `commands` from the path.
    ambiguous : ndarray of bool, shape (n, M)
        True where other commands on the grid explain the movement equally well, where the end of
        the path cuts it off, or where no explanation has an error below 0.05 mm.

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
    """Recover commands from desired paths of an arm with one yaw and three pitch joints.

    Parameters
    ----------
    path : ndarray, shape (n, T, 3)
        Desired end-effector positions in m, T at least 2. The number and the spacing of movements
        are free as long as the arm rests between them.
    arm : YawPitchArm
        The arm that made the paths, with three links.
    progress : callable, optional
        Called with the finished fraction, ending at 1.

    Returns
    -------
    Recovery
        Commands and their parts. Of the two mirrored postures (yaw half a turn away, pitch
        negated) it has the one whose yaw is nearest to straight, and marks it as ambiguous where
        the other one is within +-120 deg too. A yaw that does not affect the path is 500.

    Raises
    ------
    InputError
        `path` has another shape or is not finite, or `arm` has not three links.

    """
    path = np.asarray(path)
    _check(path, arm)
    count, length = path.shape[:2]
    spans = [_movements(one) for one in path.astype(float)]
    counts = np.array([len(each) for each in spans], dtype=int)
    largest = int(counts.max(initial=0))
    result = Recovery(
        commands=np.full((count, length, 4), STRAIGHT),
        onsets=np.full((count, largest), np.nan),
        ramps=np.full((count, largest, 4), RAMPS[0]),
        targets=np.full((count, largest, 4), STRAIGHT),
        start=np.full((count, 4), STRAIGHT),
        closed=np.zeros(count, dtype=bool),
        whole=np.ones(count, dtype=bool),
        rms=np.zeros(count),
        ambiguous=np.zeros((count, largest), dtype=bool),
    )
    # Paths with equal numbers of movements form rectangular batches.
    batches = []
    for moves in np.unique(counts):
        same = np.flatnonzero(counts == moves)
        batches += np.array_split(same, -(-same.size // PATHS_PER_BATCH))

    def solve(rows: NDArray) -> int:
        shape = (rows.size, counts[rows[0]], 2)
        own = np.array([spans[row] for row in rows], dtype=int).reshape(shape)
        fit = PathFit(path[rows].astype(float), own, arm)
        fit.solve()
        _enter(fit, result, rows)
        return rows.size

    done = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for size in pool.map(solve, batches):
            done += size
            if progress is not None:
                progress(done / count)
    return result


def _check(path: NDArray, arm: YawPitchArm) -> None:
    """Refuse other shapes, values that are not finite, and other arms."""
    require(
        path.ndim == 3 and path.shape[2] == 3 and path.shape[1] >= 2,
        "path",
        expected="shape (n, T, 3) with T >= 2",
        got=path.shape,
        remedy="pass one end-effector path per row, path[None] for a single one",
    )
    expected = "3 pitch joints"
    remedy = "pass the arm that made the path"
    require(len(arm.links) == 3, "arm", expected=expected, got=len(arm.links), remedy=remedy)
    check_finite("path", path)


def _movements(path: NDArray, *, longest_stop: int = 25) -> list[tuple[int, int]]:
    """First and last moving step (from sample i to i + 1) of each movement in a path (T, 3).

    Parameters
    ----------
    longest_stop : int, default 25
        Number of samples below which a stop within a movement is bridged: rounding hides slow
        steps.

    """
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1)
    moving = np.flatnonzero(speed > 1e-9 + 6 * path_noise(path[None])[0])
    found: list[tuple[int, int]] = []
    for step in moving.tolist():
        # Short stops are bridged, but no movement lasts longer than the longest ramp.
        if found and step - found[-1][1] < longest_stop and step - found[-1][0] <= RAMPS[-1]:
            found[-1] = (found[-1][0], step)
        else:
            found.append((step, step))
    return found


def _enter(fit: PathFit, result: Recovery, rows: NDArray) -> None:
    """Enter the fit of some paths into those rows of the result."""
    moves = fit.moves
    result.commands[rows] = fit.commands(fit.onsets)
    result.onsets[rows, :moves] = fit.onsets
    result.ramps[rows, :moves] = fit.ramps
    result.targets[rows, :moves] = STRAIGHT - fit.steps[:, 1:]
    result.targets[rows, moves:] = STRAIGHT - fit.steps[:, -1:]
    result.start[rows] = STRAIGHT - fit.steps[:, 0]
    result.closed[rows], result.whole[rows] = fit.closed, fit.whole
    result.rms[rows] = fit.rms
    result.ambiguous[rows, :moves] = fit.ambiguous


def recover(trajectories: Trajectories, progress: Progress | None = None) -> Trajectories:
    """Recover commands from the desired path; a warning names ambiguous trajectories.

    Parameters
    ----------
    trajectories : Trajectories
        Trajectories whose `nominal` is the desired end-effector path in m.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    Trajectories
        The same with commands.

    """
    found = recover_commands(trajectories.nominal, arm=ARM, progress=progress)
    ambiguous = np.any(found.ambiguous, axis=1)
    if ambiguous.any():
        warnings.warn(
            f"commands of {ambiguous.sum()} of {len(ambiguous)} trajectories are not certain: "
            f"{', '.join(trajectories.ids[ambiguous][:5])}{' …' if ambiguous.sum() > 5 else ''}",
            stacklevel=2,
        )
    return trajectories.replace(
        commands=found.commands.astype(np.float32),
        inputs=KINEMATIC.inputs,
        outputs=KINEMATIC.outputs,
    )


RECORDED = RecordedCase(CLASSES, KINEMATIC, recover)
"""What files of the arm's trajectories need of its case."""
