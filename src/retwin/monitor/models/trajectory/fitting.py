"""`fit_trajectory_monitor`: calibrates a monitor on trajectories of the healthy machine."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from retwin.checks import finite, instance, nothing, require
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError
from retwin.monitor.detect.offsets import biases, fit_offsets
from retwin.monitor.detect.promise import false_alarms
from retwin.monitor.detect.scores import fit_scores
from retwin.monitor.models.trajectory.evidence import (
    Inversion,
    alternatives,
    checked,
    compared,
    factors,
)
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor
from retwin.progress import Progress
from retwin.twins.faults.actuator_faults import Fault
from retwin.update.dynamics.filter.noise import CERTAIN

MIN_TRAJECTORIES = 8
"""Healthy trajectories of a calibration, at least."""
FACTORS = np.arange(1.0, 10.005, 0.01)
"""Factors of the errors of which the smallest is taken with which the calibration agrees."""


def fit_trajectory_monitor(
    diagnoser: Inversion,
    healthy: Trajectories,
    false_alarms_at_most: str | float = "1 per month",
    *,
    causes: Mapping[str, Fault] | None = None,
    alpha: float = 0.01,
    progress: Progress | None = None,
) -> TrajectoryMonitor:
    """Calibrate a monitor on trajectories of the healthy machine.

    Parameters
    ----------
    diagnoser : InversionDiagnoser or StateInversionDiagnoser
        Of `fit_inversion`, with the faults.
    healthy : Trajectories
        Healthy trajectories, at least 8, best of several days, that the twin was not fitted to.
    false_alarms_at_most : str or float
        See `false_alarms`; "1 per month" is one of a machine that works without pause, and
        "1000 trajectories" or a number is the average run length itself.
    causes : mapping of str to Fault, optional
        Further faults to watch for, beside those of the diagnoser, such as `Case.causes`.
    alpha : float
        Probability of declaring the promise void although it applies.
    progress : callable, optional
        Called with the finished share.

    Returns
    -------
    TrajectoryMonitor
        With its promise.

    Raises
    ------
    InputError
        Too few trajectories, other channels or another rate than those of the twin, no diagnoser
        by inversion, or trajectories that look faulty to it.

    """
    diagnoser = checked(checked(diagnoser).with_faults(causes or {}))
    instance("healthy", healthy, Trajectories, remedy="load recorded ones")
    finite("alpha", alpha, at_least=1e-12, at_most=0.5)
    allowed = {HEALTHY, *(name for name, fault in diagnoser.faults.items() if fault is None)}
    faulty = [f"some labelled {name}" for name in sorted(healthy.known_labels - allowed)[:3]]
    expected = f"trajectories without labels, or labelled {' or '.join(sorted(allowed))}"
    nothing("healthy", faulty, expected, remedy="leave these out")
    length = healthy.steps / healthy.rate
    arl = false_alarms(false_alarms_at_most, 1 / length)
    found = compared(diagnoser, healthy, progress)
    used = np.isfinite(found.error) & ~found.outside
    require(
        used.sum() >= MIN_TRAJECTORIES,
        "healthy",
        expected=f"at least {MIN_TRAJECTORIES} trajectories",
        got=f"{len(healthy)}, of which {int(found.unmeasured.sum())} without measured samples, "
        f"{int(found.implausible.sum())} with implausible readings and "
        f"{int(found.outside.sum())} with commands outside their range in training",
        remedy="record more healthy trajectories, with commands as those of the twin's training",
    )
    ratio, count = found.ratio[used], found.measured[used]
    scores = fit_scores(found.error[None, used])
    (slack,) = scores.slack(1)
    some = bool(biases(diagnoser.faults.values()))
    offsets = fit_offsets(found.offset[used]) if some else None
    for kappa in FACTORS[slack.kappa <= FACTORS]:
        factor = factors(ratio, kappa).mean(axis=1)
        bound = factor.mean() + CERTAIN * factor.std(ddof=1) / np.sqrt(len(factor))
        if bound <= 1:
            measured = np.stack([count.min(axis=0), count.max(axis=0)]).astype(float)
            about = float(kappa), arl, length, measured, offsets, float(alpha)
            counts = int(used.sum()), len(healthy)
            return TrajectoryMonitor(diagnoser, scores, slack, *about, *counts)
    likely = alternatives(diagnoser)[int(np.median(ratio, axis=0).argmax())]
    raise InputError(
        "healthy",
        expected="trajectories that the diagnoser takes for healthy ones",
        got=f"some that look like {likely}",
        remedy="leave out faulty ones, or calibrate the twin on more healthy trajectories",
    )
