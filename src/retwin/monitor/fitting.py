"""`fit_monitor`: calibrates a monitor on records of the healthy machine."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite, instance, require
from retwin.data.measured import check_magnitude
from retwin.data.quality.check import check_records
from retwin.data.quality.finding import summarise
from retwin.data.trajectories import Trajectories
from retwin.monitor.disturbance import fit_disturbance
from retwin.monitor.monitor import Monitor
from retwin.monitor.predictors import SLOWER, Predictor, agreeing, settled, standardised
from retwin.monitor.promise import false_alarms
from retwin.monitor.scores import fit_scores, resolution
from retwin.twins.twin import check_channels
from retwin.update.dynamics.twin import DynamicsTwin

SEPARATION = 200
"""Missing samples that are put between two calibration records, so that neither predicts the
other."""


def fit_monitor(
    twin: DynamicsTwin,
    healthy: Trajectories,
    false_alarms_at_most: str | float = "1 per month",
    *,
    blanking: float = 60.0,
    alpha: float = 0.01,
) -> Monitor:
    """Calibrate a monitor on records of the healthy machine.

    Parameters
    ----------
    twin : DynamicsTwin
        The corrected twin, of `fit_dynamics`.
    healthy : Trajectories
        Healthy records, best of several days, that the twin was not fitted to: the errors of those
        are smaller than of others, and the promise is that of these errors.
    false_alarms_at_most : str or float
        See `false_alarms`.
    blanking : float
        Time in s after an alarm in which no other is raised.
    alpha : float
        Probability of declaring the promise void although it applies.

    Returns
    -------
    Monitor
        With its promise.

    Raises
    ------
    InputError
        Other channels or another rate than those of the twin, too few samples, or a value that no
        sensor gives.

    """
    instance("twin", twin, DynamicsTwin, remedy="fit it by fit_dynamics")
    check_channels(twin, healthy, "healthy")
    check_magnitude("healthy", healthy)
    arl = false_alarms(false_alarms_at_most, twin.rate)
    finite("blanking", blanking, least=0.0, unit="s")
    for note in summarise(check_records(healthy).findings):
        warnings.warn(f"healthy: {note}", stacklevel=2)
    measured = np.where(healthy.mask, healthy.observed, np.nan).astype(float)
    steps = resolution(np.moveaxis(measured, 2, 0).reshape(measured.shape[2], -1))
    first = _calibrated(twin, Predictor(), healthy, measured, steps)
    require(
        first is not None,
        "healthy",
        expected="records with which the filter of the twin stays finite",
        got="others",
        remedy="leave them out, or give the twin more substeps",
    )
    found = [each for each in (first, *_slower(twin, healthy, measured, steps)) if each]
    error, width = (np.concatenate(each) for each in list(zip(*found, strict=True))[1:])
    disturbance = fit_disturbance(error)
    width = width / disturbance.deviation
    scores = fit_scores(disturbance.held_out, width)
    slack = scores.slack(disturbance.parameters)
    slack = agreeing(slack, *scores.score(disturbance.held_out, width))
    predictors = tuple(each[0] for each in found)
    return Monitor(twin, disturbance, scores, slack, steps, arl, blanking, float(alpha), predictors)


_Calibrated: TypeAlias = tuple[Predictor, NDArray, NDArray]
"""A model with its settled errors and widths of their rounding intervals, (d_y, n * T)."""


def _slower(
    twin: DynamicsTwin, healthy: Trajectories, measured: NDArray, steps: NDArray
) -> list[_Calibrated]:
    """The model that follows slowly, where it is another one and settles within the records."""
    if not (twin.process.any() or twin.proportional.any()):
        return []
    found = _calibrated(twin, Predictor(SLOWER), healthy, measured, steps)
    if found is None or found[0].warm_up * twin.rate >= healthy.steps // 2:
        return []
    return [found]


def _calibrated(
    twin: DynamicsTwin,
    predictor: Predictor,
    healthy: Trajectories,
    measured: NDArray,
    steps: NDArray,
) -> _Calibrated | None:
    """A model with its warm-up and errors on healthy records; None if it does not stay finite."""
    online = predictor.filter(twin)
    start, given = online.start(len(healthy)), (healthy.commands.astype(float), measured)
    _, mean, covariance = online.step(start, *given, healthy.mask)
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        return None
    warm_up = settled(online, start, (*given, healthy.mask), covariance)
    counted = (np.arange(healthy.steps) >= warm_up)[None, :, None]
    error, width = (
        np.pad(each, [(0, 0), (0, SEPARATION), (0, 0)], constant_values=np.nan)
        .reshape(-1, measured.shape[2])
        .T
        for each in standardised(measured - mean, covariance, healthy.mask & counted, steps)
    )
    return replace(predictor, warm_up=warm_up / twin.rate), error, width
