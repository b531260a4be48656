"""`score_model`: an updated twin on records that it was not fitted to, beside plain baselines."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite, positive, require
from retwin.data.trajectories import Trajectories
from retwin.scores.distributions import crps_normal
from retwin.scores.intervals import grouped_share_interval
from retwin.twins.twin import Twin, check_channels
from retwin.update.forecast_errors import USUAL, ForecastErrors, channel_excess, warn_unlike
from retwin.update.forecasts import forecasts, free_moments, started_moments
from retwin.update.training_range import OutsideTrainingWarning


@dataclass(frozen=True)
class ModelScore:
    """The errors of one predictor in one output.

    Attributes
    ----------
    who : str
        "model"; "twin", as it was before, with a horizon plus its last error before that; "mean",
        that of the record itself; or "hold", the last sample measured before the horizon, of free
        simulation the first one of the record.
    output : str
        Name of the output.
    horizon : float or None
        Time ahead in s; None for free simulation from the commands.
    rmse, crps : float
        In the unit of the output; the CRPS of a predictor without distribution is its mean absolute
        error.
    coverage, width : float
        Share of samples inside the 90 % band, and its mean width in the unit of the output; NaN
        for a predictor without bands.
    interval : (float, float) or None
        95 % interval of the coverage, from what varies between records; None for fewer than five.
    shares : tuple of (float or None)
        The coverage of each record; None of one without a measured sample that has a band.

    """

    who: str
    output: str
    horizon: float | None
    rmse: float
    crps: float
    coverage: float
    width: float
    interval: tuple[float, float] | None = None
    shares: tuple[float | None, ...] = ()


@dataclass(frozen=True, eq=False)
class ScoredPrediction:
    """Predictions of a record by a model, with bands.

    Attributes
    ----------
    mean, deviation : NDArray
        (n, T, d_y); the mean is NaN where nothing is predicted, and the deviation where no band
        was calibrated.

    """

    mean: NDArray
    deviation: NDArray


def predict_records(
    model: Twin,
    records: Trajectories,
    *,
    horizon: float | None = None,
    started: float = 0.0,
    seed: int = 0,
) -> ScoredPrediction:
    """The distribution of each sample, by free simulation or from measurements `horizon` s before.

    Parameters
    ----------
    model : Twin
        An updated twin, or any other one.
    records : Trajectories
        Commands, and measured outputs, which are used up to `horizon` before each sample.
    horizon : float, optional
        Time ahead in s; by default free simulation, which uses no measured output.
    started : float
        Time in s at the begin of each record by whose measured outputs a free simulation infers the
        start of the states, where it is unknown; 0 is none.
    seed : int
        Of draws.

    Warns
    -----
    OutsideTrainingWarning
        Commands or predicted outputs leave the range for which bands were calibrated, so that
        there is none until the errors there are forgotten. Or a free simulation is longer than the
        records by which they were calibrated; there is none after that time if errors depended on
        the time in the record.

    """
    check_channels(model, records, "records")
    warn_unlike(model, records)
    errors: ForecastErrors | None = getattr(model, "forecast", None)
    if horizon is None:
        mean, deviation = _simulate_free(model, records, started, seed)
        if started and errors is not None and errors.started is not None:
            deviation = np.broadcast_to(errors.started, mean.shape)
    else:
        ahead = max(1, round(positive("horizon", horizon) * records.rate))
        require(
            ahead < records.steps,
            "horizon",
            expected=f"a time shorter than the records, {records.steps / records.rate:g} s",
            got=f"{horizon:g} s",
            remedy="give a shorter one, or none for free simulation",
        )
        made = forecasts(model, records, [ahead])
        share, constant = (0.0, np.nan) if errors is None else errors.at(ahead / records.rate)
        mean = made.mean[0] + share * made.last[0]
        deviation = np.broadcast_to(constant, mean.shape)
    if errors is not None:
        values = np.concatenate([records.commands, mean], axis=2)
        outside = errors.outside(values, records.rate)
        _warn_outside(errors, values, outside, records)
        late = errors.late(records.steps, records.rate) & (horizon is None)
        _warn_late(errors, late, records)
        outside |= late & errors.drifts
        deviation = np.where(outside[..., None], np.nan, deviation)
    return ScoredPrediction(mean, deviation)


def _simulate_free(
    model: Twin, records: Trajectories, started: float, seed: int
) -> tuple[NDArray, NDArray]:
    """Means and deviations of free simulations, with starts by the first measurements or not."""
    begin = finite("started", started, at_least=0.0, unit="s")
    if begin:
        return started_moments(model, records, begin, seed=seed)
    return free_moments(model, records.commands, seed=seed)


def _warn_outside(
    errors: ForecastErrors, values: NDArray, outside: NDArray, records: Trajectories
) -> None:
    """Warn of records in which samples (n, T) have no band, with the `values` (n, T, d) why."""
    measured = np.arange(outside.shape[1]) < records.lengths[:, None]
    missing = outside & measured
    if not missing.any():
        return
    some = missing.any(axis=1)
    first = int(np.argmin(np.where(some, missing.argmax(axis=1), missing.shape[1])))
    excess = channel_excess(values, errors.low, errors.high) * measured[..., None]
    names = (*records.inputs.names, *(f"predicted {name}" for name in records.outputs.names))
    reached = "; ".join(
        f"{name} is {values[..., i].flat[excess[..., i].argmax()]:.4g} (calibration: "
        f"{errors.low[i]:.4g} to {errors.high[i]:.4g})"
        for i, name in enumerate(names)
        if excess[..., i].max() > errors.beyond[i]
    )
    warnings.warn(
        f"no band is given for {missing.sum() / measured.sum():.1%} of the samples, in "
        f"{some.sum()} of {len(records)} records, first in {records.ids[first]} after "
        f"{missing[first].argmax() / records.rate:.4g} s, since values leave the range for which "
        f"bands were calibrated: {reached}. Calibrate with records that contain these",
        OutsideTrainingWarning,
        stacklevel=3,
    )


def _warn_late(errors: ForecastErrors, late: NDArray, records: Trajectories) -> None:
    """Warn of records with samples (T,) after the time of the longest one of the calibration."""
    own = int((late & (np.arange(late.size) < records.lengths[:, None])).any(axis=1).sum())
    text = "bands were not tried after that time"
    if errors.drifts:
        text = "no band is given after that time, since errors depended on the time in the record"
    if own:
        warnings.warn(
            f"{own} of {len(records)} records are longer than those by which bands were "
            f"calibrated, {errors.longest:.4g} s; {text}. Calibrate with longer records",
            OutsideTrainingWarning,
            stacklevel=3,
        )


def score_model(
    model: Twin,
    records: Trajectories,
    *,
    horizon: float | None = None,
    warm_up: float = 0.0,
    started: float = 0.0,
    twin: Twin | None = None,
    seed: int = 0,
) -> list[ModelScore]:
    """Score an updated twin on records that it was not fitted to.

    Parameters
    ----------
    model : Twin
        What `rt.fit` returned as `twin`, or `rt.load_twin` read.
    records : Trajectories
        Measured outputs with commands.
    horizon : float, optional
        Time in s between the last measurement that a prediction uses and the predicted sample; by
        default free simulation from the commands.
    warm_up : float
        Time in s at the begin of each record that is not scored.
    started : float
        See `predict_records`.
    twin : Twin, optional
        The twin before its update, which is scored too.
    seed : int
        Of draws.

    Returns
    -------
    list of ModelScore
        Of the model, the twin, the mean of the record and a measured sample of it, per output.

    Raises
    ------
    InputError
        Other channels or another rate than those of the model, a horizon as long as the records,
        or nothing left to score.

    """
    skipped = round(finite("warm_up", warm_up, at_least=0.0) * records.rate)
    found = predict_records(model, records, horizon=horizon, started=started, seed=seed)
    seen = records.mask & np.isfinite(found.mean)
    seen[:, :skipped] = False
    require(
        seen.any(),
        "records",
        expected="measured samples after the warm-up",
        got="none",
        remedy="give longer records, or a shorter warm-up",
    )
    measured = records.observed.astype(np.float64)
    predictions = {"model": found}
    if twin is not None:
        nothing = np.full(measured.shape, np.nan)
        if horizon is None:
            mean = _simulate_free(twin, records, started, seed)[0]
        else:
            made = forecasts(twin, records, [max(1, round(horizon * records.rate))])
            mean = made.mean[0] + made.last[0]
        predictions["twin"] = ScoredPrediction(mean, nothing)
    predictions |= _baselines(records, horizon)
    rows = []
    for who, each in predictions.items():
        for channel, output in enumerate(records.outputs.names):
            own = seen[..., channel] & np.isfinite(each.mean[..., channel])
            error = (measured - each.mean)[..., channel]
            deviation = each.deviation[..., channel]
            banded = own & (deviation > 0)
            counts = banded.sum(axis=1)
            hits = ((np.abs(error) <= USUAL * deviation) & banded).sum(axis=1)
            interval = grouped_share_interval(hits[counts > 0], counts[counts > 0])
            pairs = zip(hits.tolist(), counts.tolist(), strict=True)
            shares = tuple(hit / count if count else None for hit, count in pairs)
            scores = _scores(error[own], deviation[own])
            rows.append(ModelScore(who, output, horizon, *scores, interval, shares))
    return rows


def _scores(error: NDArray, deviation: NDArray) -> tuple[float, float, float, float]:
    """RMSE, CRPS, coverage and width of errors (K,)."""
    if not len(error):
        return (float("nan"),) * 4
    rmse = float(np.sqrt(np.mean(error**2)))
    certain = ~(deviation > 0)
    scale = np.where(certain, 1.0, deviation)
    each = np.where(certain, np.abs(error), crps_normal(error, np.zeros_like(error), scale))
    if certain.all():
        return rmse, float(each.mean()), float("nan"), float("nan")
    inside = (np.abs(error) <= USUAL * deviation)[~certain]
    width = 2 * USUAL * float(deviation[~certain].mean())
    return rmse, float(each.mean()), float(inside.mean()), width


def _baselines(records: Trajectories, horizon: float | None) -> dict[str, ScoredPrediction]:
    """The mean of each record, and its last sample before the horizon, else its first one."""
    measured = np.where(records.mask, records.observed, np.nan).astype(np.float64)
    mean = np.broadcast_to(np.nanmean(measured, axis=1, keepdims=True), measured.shape)
    steps = np.arange(measured.shape[1])[None, :, None]
    place = np.maximum.accumulate(np.where(np.isfinite(measured), steps, 0), axis=1)
    last = np.take_along_axis(measured, place, axis=1)
    held = np.full_like(measured, np.nan)
    if horizon is None:
        first = np.argmax(records.mask, axis=1)[:, None]
        held[:] = np.take_along_axis(measured, first, axis=1)
    else:
        lead = max(1, round(horizon * records.rate))
        held[:, lead:] = last[:, :-lead]
    nothing = np.full(measured.shape, np.nan)
    return {"mean": ScoredPrediction(mean, nothing), "hold": ScoredPrediction(held, nothing)}
