"""`fit_monitor`: calibrates a monitor on records of the healthy machine."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite, given, instance, positive
from retwin.data.measured import check_magnitude
from retwin.data.quality.check import check_records
from retwin.data.quality.finding import summarise
from retwin.data.trajectories import Trajectories
from retwin.monitor.detect.detector import Detector
from retwin.monitor.detect.disturbance import MIN_RESIDUALS, fit_disturbance
from retwin.monitor.detect.events import Rules
from retwin.monitor.detect.noise import DECAYS, features, fit_noise, own_scale
from retwin.monitor.detect.predictors import (
    SLOWER,
    Predictor,
    Scored,
    agreeing,
    settled,
    span_of,
    standardised,
)
from retwin.monitor.detect.promise import Tried, false_alarms
from retwin.monitor.detect.scores import fit_scores, resolution
from retwin.monitor.detect.slack import Slack
from retwin.monitor.models.free_simulation import free_errors, sizes_of_parts
from retwin.monitor.models.monitor import Monitor
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.twin import check_channels
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.blackbox import fit_black_box
from retwin.update.blackbox.levels import fit_levels
from retwin.update.dynamics import estimate_noise
from retwin.update.dynamics.filter.online import with_main_directions
from retwin.update.dynamics.filter.prediction import log_density
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.unknowns import state_names

SEPARATION = 200
"""Missing samples that are put between two calibration records, so that neither predicts the
other."""
EFFECTS = (1.0, 3.0, 10.0)
"""Posterior deviations by which machines or days may differ from the twin, of which the one with
the largest density of the calibration is taken, each sample predicted from those before."""
LARGEST_VARIANCE = 10.0
"""Mean square of standardised errors up to which a slower model describes the machine."""
LARGER_ERRORS = 3.0
"""Times the other records' largest errors, as root mean squares of short parts, from which on those
of a record are named."""
FOLDS = 8
"""Parts of the calibration that are left out in turn, at most."""


def fit_monitor(
    twin: DynamicsTwin | StateTwin | ParametricTwin | None,
    healthy: Trajectories,
    false_alarms_at_most: str | float = "1 per month",
    *,
    lasting: float = 3600.0,
    alpha: float = 0.01,
) -> Monitor:
    """Calibrate a monitor on records of the healthy machine.

    Parameters
    ----------
    twin : DynamicsTwin, StateTwin, ParametricTwin or None
        The corrected twin, of `fit_dynamics`; state equations, whose noise is that of these
        records; or None for a black box of these records, which is "arx" where they have commands,
        and else a level of each output.
    healthy : Trajectories
        Healthy records, best of several days, that the twin was not fitted to: the errors of those
        are smaller than of others, and the promise is that of these errors. Each is left out in
        turn and watched by the others; of a single one, each quarter.
    false_alarms_at_most : str or float
        See `false_alarms`.
    lasting : float
        Time in s after which an event that has not ended is a change: the machine of then is
        followed.
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
    model: object = twin
    if twin is None:
        known = len(healthy.inputs) > 0
        model = fit_black_box(healthy, "arx").twin if known else fit_levels(healthy)
    elif state_names(twin):
        model = estimate_noise(twin, healthy)  # type: ignore[arg-type]
    twin = instance("twin", model, DynamicsTwin, remedy="fit it by fit_dynamics")
    check_channels(twin, healthy, "healthy")
    check_magnitude("healthy", healthy)
    arl = false_alarms(false_alarms_at_most, twin.rate)
    positive("lasting", lasting, unit="s")
    finite("alpha", alpha, at_least=1e-12, at_most=0.5)
    for note in summarise(check_records(healthy).findings):
        warnings.warn(f"healthy: {note}", stacklevel=2)
    twin = with_main_directions(twin, healthy.commands.astype(float))
    measured = healthy.measured.astype(float)
    steps = resolution(np.moveaxis(measured, 2, 0).reshape(measured.shape[2], -1))
    expected = "records with which the filter of the twin stays finite"
    remedy = "leave them out, or give the twin more substeps"
    calibrated = partial(_calibrated, twin, healthy, measured, steps)
    first = given("healthy", calibrated(Predictor()), expected, got="others", remedy=remedy)
    found = [first, *_slower(twin, healthy.steps, calibrated)]
    errors = np.concatenate([each.error for each in found], axis=2)
    for note in _describe_larger_errors(healthy, errors):
        warnings.warn(f"healthy: {note}", stacklevel=2)
    error, width = (_joined([getattr(each, of) for each in found]) for of in ("error", "width"))
    names, folds = _folds(healthy, np.isfinite(error).all(axis=0))
    disturbance = fit_disturbance(error, folds=folds)
    width = width / disturbance.deviation
    inputs, outputs = len(twin.inputs), len(twin.outputs)
    sizes = (inputs, len(DECAYS) * inputs, outputs)
    noted = _joined([first.features]).T
    noise, mean, scale = fit_noise(disturbance.held_out, width, noted, sizes, folds)
    apart, width = (disturbance.held_out - mean) / scale, width / scale
    for each in np.array_split(np.arange(apart.shape[1]), len(healthy)):
        own = own_scale(np.zeros((len(apart), 2)), apart[:, each], noise.degrees)[0]
        apart[:, each], width[:, each] = apart[:, each] / own, width[:, each] / own
    scores = fit_scores(apart, width)
    parameters = disturbance.parameters + np.count_nonzero(noise.mean[:, :-1], axis=1)
    parts = _left_out(apart, width, folds)
    slack = agreeing(scores.slack(parameters), parts)
    events = [_events(slack, part, Rules.of(arl, 1)) for part in parts]
    counted = [int(np.isfinite(low).any(axis=0).sum()) for low, _ in parts]
    pairs = (dict(zip(names, each, strict=True)) for each in (events, counted))
    predictors = tuple(each.predictor for each in found)
    more = (noise, Tried(*pairs), lasting, float(alpha), predictors)
    free = free_errors(twin, healthy)
    largest = tuple(free[0].max(axis=(0, 1)).tolist()) if free else ()
    return Monitor(twin, disturbance, scores, slack, steps, arl, *more, free=largest)


@dataclass(frozen=True, eq=False)
class _Calibrated:
    """A model with what it finds in healthy records (n, T, ...): standardised errors, widths of
    their rounding intervals, and features of their noise.
    """

    predictor: Predictor
    error: NDArray
    width: NDArray
    features: NDArray


def _slower(
    twin: DynamicsTwin, samples: int, calibrated: Callable[[Predictor], _Calibrated | None]
) -> list[_Calibrated]:
    """The model that follows slowly, where it is another one and settles within the records."""
    if not (twin.process.any() or twin.proportional.any()):
        return []
    for factor in SLOWER:
        found = calibrated(Predictor(factor))
        if found is None or found.predictor.warm_up * twin.rate >= samples // 2:
            continue
        if np.nanmean(found.error**2) <= LARGEST_VARIANCE:
            return [found]
    return []


def _calibrated(
    twin: DynamicsTwin, healthy: Trajectories, measured: NDArray, steps: NDArray, model: Predictor
) -> _Calibrated | None:
    """A model with the effect of the record that fits best; None if it does not stay finite."""
    given, best, found = (healthy.commands.astype(float), measured, healthy.mask), -np.inf, None
    for effect in EFFECTS:
        online = replace(model, effect=effect).filter(twin)
        _, mean, covariance = online.step(online.start(len(healthy)), *given)
        if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
            continue
        density = log_density(np.nan_to_num(measured - mean), covariance, healthy.mask).sum()
        if density > best:
            best, found = density, (effect, online, mean, covariance)
    if found is None:
        return None
    effect, online, mean, covariance = found
    warm_up = settled(model.filter(twin), len(healthy), given)
    counted = (np.arange(healthy.steps) >= warm_up)[None, :, None]
    errors = standardised(measured - mean, covariance, healthy.mask & counted, steps)
    count, d_u = len(healthy), healthy.commands.shape[2]
    before = np.zeros((count, len(DECAYS), d_u)), np.full((count, d_u), np.nan)
    noted = features(*before, given[0], mean, span_of(twin))[1]
    known = replace(model, warm_up=warm_up / twin.rate, effect=effect)
    return _Calibrated(known, *errors, noted)


def _describe_larger_errors(healthy: Trajectories, error: NDArray) -> list[str]:
    """What to say of records that the twin follows much worse than most of the others, for a time.

    Parameters
    ----------
    healthy : Trajectories
        The calibration; nothing is said of fewer than three records.
    error : NDArray
        (n, T, S), standardised errors of the predictions of each model and output.

    """
    if len(healthy) < 3:
        return []
    size, length = sizes_of_parts(error)
    largest = size.max(axis=1)
    ratio = largest / np.maximum(np.median(largest, axis=0), 1.0)
    made = []
    for i in np.flatnonzero(ratio.max(axis=1) >= LARGER_ERRORS):
        stream = int(ratio[i].argmax())
        begin = int(size[i, :, stream].argmax()) * length / healthy.rate
        made.append(
            f"in {healthy.ids[i]} errors of {healthy.outputs.names[stream % len(healthy.outputs)]} "
            f"are {ratio[i, stream]:.2g} times the largest of most other records, from "
            f"{begin:.3g} s to {begin + length / healthy.rate:.3g} s. The monitor takes what it is "
            "calibrated on for healthy, so it sees no fault that is smaller: fit the twin to "
            "records like this one, or leave it out, after which such times raise alarms"
        )
    return made


def _joined(values: Sequence[NDArray]) -> NDArray:
    """Streams (S, n * (T + SEPARATION)) of values (n, T, ...), NaN between records."""
    pad = [(0, 0), (0, SEPARATION), (0, 0)]
    padded = np.pad(np.concatenate(values, axis=2), pad, constant_values=np.nan)
    return padded.reshape(-1, padded.shape[2]).T


def _folds(healthy: Trajectories, seen: NDArray) -> tuple[list[str], list[NDArray]]:
    """Names and samples of the parts of the calibration that are left out in turn."""
    count = min(len(healthy), FOLDS)
    if count > 1:
        groups = np.array_split(np.arange(len(healthy)), count)
        places = np.arange(len(seen)).reshape(len(healthy), -1)
        folds = [places[each].ravel() for each in groups]
        names = [" to ".join(dict.fromkeys(healthy.ids[each[[0, -1]]].tolist())) for each in groups]
        if seen.sum() - max(seen[each].sum() for each in folds) >= 2 * MIN_RESIDUALS:
            return names, folds
    return [f"part {i + 1}" for i in range(4)], np.array_split(np.arange(len(seen)), 4)


def _left_out(errors: NDArray, width: NDArray, folds: Sequence[NDArray]) -> list[Scored]:
    """Scores of each part by the ranks among the others."""
    made = []
    for fold in folds:
        others = errors.copy()
        others[:, fold] = np.nan
        made.append(fit_scores(others, width).score(errors[:, fold], width[:, fold]))
    return made


def _events(slack: tuple[Slack, ...], scored: Scored, rules: Rules) -> int:
    """How many events a detector finds in scores, which it sees as those of one machine."""
    detector, first, count = Detector(slack), 0, 0
    low, high = scored
    while first < low.shape[1]:
        _, evidence = detector.run(detector.start(len(slack)), low[:, first:], high[:, first:])
        alarms = np.flatnonzero(rules.alarms(evidence.mean(axis=0)))
        if not len(alarms):
            break
        count += 1
        first += int(alarms[0]) + rules.wanted
    return count
