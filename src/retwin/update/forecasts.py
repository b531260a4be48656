"""Predictions by an updated twin: free simulation from commands, or from measurements on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import stdtrit

from retwin.data.trajectories import Trajectories
from retwin.twins.equations.interpolation import TAPS
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Additive
from retwin.update.dynamics.estimation import correlation_time
from retwin.update.dynamics.filter.filtering import arrays_of
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.windows import simulated
from retwin.update.forecast_errors import (
    BEYOND,
    LEVEL,
    USUAL,
    ForecastErrors,
    predictive_deviation,
    value_range,
)

LEADS = (1, 3, 10, 30, 100)
"""Samples ahead at which errors are calibrated."""
BEGIN = 10
"""The begin of a record is its part by this number."""


def free_moments(twin: Twin, commands: NDArray, *, seed: int = 0) -> tuple[NDArray, NDArray]:
    """Means and standard deviations (n, T, d_y) of the outputs of commands (n, T, d_u).

    They are exact for corrected dynamics and for corrections of each sample, and those of draws for
    other corrections; a plain twin is certain.
    """
    values = np.asarray(commands, np.float64)
    if isinstance(twin, DynamicsTwin):
        return twin.simulation.moments(values)
    if not isinstance(twin, CorrectedTwin):
        made = twin.simulate(values, seed=seed).observed.astype(np.float64)
        return made, np.zeros_like(made)
    if isinstance(twin.residual.correction, Additive):
        context = twin.residual.context(twin.surrogate, commands)
        with torch.no_grad():
            found = twin.residual(context)
            mean = context.nominal.double() + twin.residual.mean(context)
        return mean.numpy(), found.variance.double().sqrt().numpy()
    moments = []
    for i, each in enumerate(values):
        # Simulations of a trajectory whose mean and deviation stand for a distribution.
        drawn = twin.simulate(np.tile(each, (100, 1, 1)), seed=seed + i).observed
        moments.append((drawn.mean(axis=0, dtype=np.float64), drawn.std(axis=0, dtype=np.float64)))
    means, deviations = (np.stack(each) for each in zip(*moments, strict=True))
    return means, deviations


def unknown_starts(twin: object) -> TypeGuard[DynamicsTwin | CorrectedTwin]:
    """Whether a model has states whose starts the begin of a record gives."""
    return isinstance(twin, DynamicsTwin | CorrectedTwin) and twin.unknown_starts


def begin_of(records: Trajectories) -> float:
    """The first tenth of each record in s, by which starts are inferred; 0 if one is not measured.

    It is a tenth of the shortest record.
    """
    samples = max(1, int(records.lengths.min()) // BEGIN)
    measured = records.mask[:, :samples].any(axis=(1, 2)).all()
    return samples / records.rate if measured else 0.0


def started_mean(twin: Twin, records: Trajectories) -> NDArray | None:
    """Means of free simulations from starts by the first tenth of each record; see `LeftOut`."""
    begin = begin_of(records)
    if not (unknown_starts(twin) and begin):
        return None
    mean = started_moments(twin, records, begin)[0]
    mean[:, : round(begin * records.rate)] = np.nan
    return mean


def started_moments(
    twin: Twin, records: Trajectories, begin: float, *, seed: int = 0
) -> tuple[NDArray, NDArray]:
    """`free_moments` from starts that the first `begin` s of each record give.

    Of twins whose starts are known, or cannot be set, it is `free_moments`.
    """
    if unknown_starts(twin):
        rows = [records[[i]] for i in range(len(records))]
        pairs = [free_moments(twin.started(e.between(0.0, begin)), e.commands) for e in rows]
        means, deviations = (np.concatenate(each) for each in zip(*pairs, strict=True))
        return means, deviations
    if isinstance(twin, ParametricTwin):
        used = records.mask & (np.arange(records.steps) < round(begin * records.rate))[:, None]
        made = simulated(twin, records, used, seed=seed, own=True)
        return made, np.zeros_like(made)
    return free_moments(twin, records.commands, seed=seed)


@dataclass(frozen=True, eq=False)
class Forecasts:
    """Predictions of the samples of a record from measurements some time before.

    Attributes
    ----------
    mean : NDArray
        (L, n, T, d_y), predictions some samples ahead; NaN where none was made, infinite where a
        simulation from filtered states diverged.
    last : NDArray
        (L, n, T, d_y), the last error of the free simulation at that time, of which a share is
        still to be added; 0 where states are filtered, and NaN where no prediction was made.

    """

    mean: NDArray
    last: NDArray


def forecasts(twin: Twin, record: Trajectories, leads: Sequence[int]) -> Forecasts:
    """Predict the samples of a record so many samples ahead of the last measurement.

    Parameters
    ----------
    twin : Twin
        A `DynamicsTwin` continues from filtered states; another one simulates from the commands.
    record : Trajectories
        Measured outputs with their commands.
    leads : sequence of int
        Samples ahead, at least 1.

    """
    if isinstance(twin, DynamicsTwin):
        made = _from_states(twin, record, leads)
        return Forecasts(made, np.where(np.isnan(made), np.nan, 0.0))
    free = free_moments(twin, record.commands)[0]
    error = np.where(record.mask, record.observed - free, np.nan)
    mean, last = (np.full((len(leads), *free.shape), np.nan) for _ in range(2))
    steps = np.arange(error.shape[1])[:, None]
    place = np.maximum.accumulate(np.where(np.isfinite(error), steps, 0), axis=1)
    present = np.take_along_axis(error, place, axis=1)  # at each sample, the last that is no NaN
    for i, lead in enumerate(leads):
        if lead < free.shape[1]:
            mean[i, :, lead:] = free[:, lead:]
            last[i, :, lead:] = present[:, :-lead]
    return Forecasts(np.where(np.isfinite(last), mean, np.nan), last)


def _from_states(twin: DynamicsTwin, record: Trajectories, leads: Sequence[int]) -> NDArray:
    """Simulations that start from filtered states at some samples, (L, n, T, d_y)."""
    commands, *rest = arrays_of(record)
    states = twin.filter(commands, *rest)[2]
    count, steps = commands.shape[:2]
    longest = min(max(leads), steps - 1)
    # Samples from which predictions start, at most, of all trajectories together.
    stride = max(1, count * steps // 2000)
    row, origin = (each.ravel() for each in np.mgrid[:count, 0 : steps - 1 : stride])
    # Earlier commands, on which a spline between samples and dead times depend.
    delays = [twin.values[place] for _, place in twin.equations.delay_places]
    past = TAPS + ceil(max(delays, default=0.0) * record.rate) + 1
    place = np.clip(origin[:, None] + np.arange(-past, longest + 1), 0, steps - 1)
    theta = np.tile(twin.values, (len(row), 1))
    theta[:, -states.shape[2] :] = states[row, origin]
    found = twin.equations.steps().run(commands[row[:, None], place], theta, first=past)[0]
    found = np.where(np.isfinite(found), found, np.inf)
    made = np.full((len(leads), count, steps, found.shape[2]), np.nan)
    for i, lead in enumerate(leads):
        inside = origin + lead < steps
        if lead <= longest:
            made[i, row[inside], origin[inside] + lead] = found[inside, lead]
    return made


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Predictions of a part of some records by a model that was not fitted to it.

    Attributes
    ----------
    ahead : Forecasts
        Predictions some samples ahead of the last measurement.
    free : NDArray
        (r, T, d_y), means of the free simulation.
    record : Trajectories
        The r records of which something was left out.
    held : NDArray
        (r, T) bool, the samples that were left out.
    excess : NDArray
        (d_u + d_y,), how far their values leave the range of those that the model was fitted to,
        in widths.
    edge : bool
        Whether they are the largest commands and outputs of all.
    started : NDArray or None
        (r, T, d_y), means of free simulations from starts that the first tenth of each record
        gives, and NaN in that; None for models whose starts are known, or cannot be set.

    """

    ahead: Forecasts
    free: NDArray
    record: Trajectories
    held: NDArray
    excess: NDArray
    edge: bool
    started: NDArray | None = None


def values_of(records: Trajectories) -> NDArray:
    """Commands and measured outputs (n, T, d_u + d_y); NaN where nothing was measured."""
    measured = np.where(records.mask, records.observed, np.nan).astype(np.float64)
    commands = np.where(records.mask.any(axis=2, keepdims=True), records.commands, np.nan)
    return np.concatenate([commands.astype(np.float64), measured], axis=2)


def calibrate_forecasts(
    records: Trajectories, found: Sequence[LeftOut], leads: Sequence[int], *, forgotten: float = 5.0
) -> ForecastErrors:
    """The errors of predictions, from parts of records that the models were not fitted to.

    Deviations are those of parts in time. Where these are whole records, errors are worth no more
    independent samples than their mean squares by record show. Where the bands of free simulation
    hold a part whose commands and outputs are beyond the range of the others, such as the largest
    ones, they are given as far beyond the range of the calibration.

    Parameters
    ----------
    records : Trajectories
        All of the calibration.
    found : sequence of LeftOut
        The parts.
    leads : sequence of int
        Samples ahead of the predictions.
    forgotten : float, default 5.0
        Correlation times of errors after which one of them is forgotten.

    """
    inner = [each for each in found if not each.edge]
    errors = [[_errors(each, i) for each in inner] for i in range(len(leads) + 1)]
    channels = range(len(records.outputs))
    whole = all(each.held[each.record.mask.any(axis=2)].all() for each in inner)
    rows = [[_calibrate(pairs, channel, whole=whole) for channel in channels] for pairs in errors]
    persistence, deviation, independent, correlation = np.moveaxis(np.array(rows), 2, 0)
    memory = float(forgotten * correlation[-1].max() / records.rate)
    started = _calibrate_started(inner, whole=whole)
    held = [each.excess for each in found if _hold_all(each, deviation[-1], started)]
    beyond = np.maximum(BEYOND, np.max([0.0 * found[0].excess, *held], axis=0))
    times = np.append(np.array(leads) / records.rate, np.inf)
    known, free = [values_of(records)], [each for each, _ in errors[-1]]
    # Errors are calibrated where outputs were predicted, and not only where they were measured.
    for each, error in zip(inner, free, strict=True):
        unknown = np.full(each.record.commands.shape, np.nan)
        known.append(np.concatenate([unknown, each.record.observed - error], axis=2))
    width = known[0].shape[2]
    low, high = value_range(np.concatenate([each.reshape(1, -1, width) for each in known], axis=1))
    by_lead = times, persistence, deviation, independent
    longest = float(records.lengths.max() / records.rate)
    drifts = errors_drift(np.concatenate(free))
    return ForecastErrors(*by_lead, memory, low, high, beyond, longest, drifts, started)


def _calibrate_started(found: Sequence[LeftOut], *, whole: bool) -> NDArray | None:
    """Deviations (d_y,) of simulations from starts that records give; None where there are none."""
    known = [(each, each.started) for each in found if each.started is not None]
    if not known:
        return None
    errors = [_errors(replace(each, free=mean), len(each.ahead.mean)) for each, mean in known]
    channels = range(errors[0][0].shape[2])
    return np.array([_calibrate(errors, i, whole=whole)[1] for i in channels])


def errors_drift(errors: NDArray, *, drift: float = 0.01) -> bool:
    """Whether the mean error of an output has a linear trend over the time in a record.

    By Student's t test of the slope, with as many errors as are independent beside the trend.

    Parameters
    ----------
    errors : ndarray, shape (r, T, d_y)
        Of samples that were left out of a fit, NaN elsewhere; a row is a record, or a part of one.
    drift : float, default 0.01
        Probability of a trend of errors over the time in a record that is no chance.

    """
    for own in np.moveaxis(errors, 2, 0):
        seen = np.isfinite(own)
        if not seen.any():
            continue
        time = np.nonzero(seen)[1] - np.nonzero(seen)[1].mean()
        power = float(time @ time)
        slope = float(time @ own[seen]) / (power or 1.0)
        rest = np.zeros(own.shape)
        rest[seen] = own[seen] - own[seen].mean() - slope * time
        free = seen.sum() / correlation_time(rest[..., None]) - 2
        if free > 0 and power > 0:
            deviation = np.sqrt(np.sum(rest**2) / (free * power))
            if abs(slope) > stdtrit(free, 1 - drift / 2 / errors.shape[2]) * deviation:
                return True
    return False


def _errors(part: LeftOut, i: int) -> tuple[NDArray, NDArray]:
    """Errors (r, T, d_y) of what was left out, NaN elsewhere, and the last errors before.

    `i` counts the times ahead, and then free simulation.
    """
    mean, last = part.free, 0.0 * part.free
    if i < len(part.ahead.mean):
        mean, last = part.ahead.mean[i], part.ahead.last[i]
    seen = part.record.mask & part.held[..., None] & np.isfinite(mean)
    return np.where(seen, part.record.observed - mean, np.nan), np.where(seen, last, 0.0)


def _hold_all(part: LeftOut, deviation: NDArray, started: NDArray | None) -> bool:
    """Whether bands of free simulation hold, and those from starts that the record gives."""
    if not _hold(part, deviation):
        return False
    if part.started is None or started is None:
        return True
    known = part.held & np.isfinite(part.started).all(axis=2)
    return _hold(replace(part, free=part.started, held=known), started)


def _hold(part: LeftOut, deviation: NDArray) -> bool:
    """Whether 90 % bands of free simulation hold so much of each output, within chance."""
    seen = part.record.mask & part.held[..., None]
    inside = np.abs(part.record.observed - part.free) <= USUAL * deviation  # False for a divergence
    for own, hits in zip(np.moveaxis(seen, 2, 0), np.moveaxis(inside, 2, 0), strict=True):
        if own.any():
            share = hits[own].mean()
            number = own.sum() / correlation_time(np.where(own, hits - share, 0.0)[..., None])
            if share < LEVEL - USUAL * np.sqrt(LEVEL * (1 - LEVEL) / number):
                return False
    return True


def _calibrate(
    pairs: Sequence[tuple[NDArray, NDArray]], channel: int, *, whole: bool
) -> tuple[float, ...]:
    """Persistence, deviation, number of independent errors, and their correlation time.

    Where `whole` records were left out, errors are no more independent than these show.
    """
    errors = [each[..., channel] for each, _ in pairs]
    last = np.concatenate(
        [each[..., channel][np.isfinite(e)] for (_, each), e in zip(pairs, errors, strict=True)]
    )
    flat = np.concatenate([each[np.isfinite(each)] for each in errors])
    if not len(flat):
        return 0.0, 0.0, 0.0, 0.0
    power = float(last @ last)
    share = float(np.clip(last @ flat / power, 0.0, 1.0)) if power > 0 else 0.0
    left = flat - share * last
    rest = [
        error - share * each[..., channel] for (_, each), error in zip(pairs, errors, strict=True)
    ]
    number = alone = sum(
        np.isfinite(own).sum() / correlation_time(np.nan_to_num(own)[..., None]) for own in rest
    )
    if whole:
        number = min(number, _independent_between(np.concatenate(rest)))
    return share, predictive_deviation(left, number), number, len(flat) / alone


def _independent_between(errors: NDArray) -> float:
    """How many independent samples errors (n, T) of n records are worth, NaN where there is none.

    As many as would let the mean square vary between records as it does (Satterthwaite, "An
    approximate distribution of estimates of variance components", Biometrics Bulletin 2, 1946).
    """
    count = np.isfinite(errors).sum(axis=1)
    square, count = np.nansum(errors[count > 0] ** 2, axis=1) / count[count > 0], count[count > 0]
    weight = count / count.sum()
    mean, n = float(weight @ square), len(square)
    if n < 2:
        return np.inf
    variance = n / (n - 1) * float(weight**2 @ (square - mean) ** 2)
    return 2 * mean**2 / variance if variance > 0 else np.inf
