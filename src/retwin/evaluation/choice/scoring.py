"""`score_model`: an updated twin on records that it was not fitted to, beside plain baselines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite, positive, require
from retwin.data.trajectories import Trajectories
from retwin.scores.distributions import crps_normal
from retwin.twins.twin import Twin, check_channels
from retwin.update.forecast_errors import USUAL, ForecastErrors
from retwin.update.forecasts import forecasts, free_moments


@dataclass(frozen=True)
class ModelScore:
    """The errors of one predictor in one output.

    Attributes
    ----------
    who : str
        "model"; "twin", as it was before; "mean", that of the record itself; or "hold", the last
        measured sample.
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

    """

    who: str
    output: str
    horizon: float | None
    rmse: float
    crps: float
    coverage: float
    width: float


@dataclass(frozen=True, eq=False)
class ScoredPrediction:
    """Predictions of a record by a model, with bands.

    Attributes
    ----------
    mean, deviation : NDArray
        (n, T, d_y); NaN where nothing is predicted.

    """

    mean: NDArray
    deviation: NDArray


def predict_records(
    model: Twin, records: Trajectories, *, horizon: float | None = None, seed: int = 0
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
    seed : int
        Of draws.

    """
    check_channels(model, records, "records")
    if horizon is None:
        return ScoredPrediction(*free_moments(model, records.commands, seed=seed))
    errors: ForecastErrors | None = getattr(model, "forecast", None)
    lead = max(1, round(positive("horizon", horizon) * records.rate))
    require(
        lead < records.steps,
        "horizon",
        expected=f"a time shorter than the records, {records.steps / records.rate:g} s",
        got=f"{horizon:g} s",
        remedy="give a shorter one, or none for free simulation",
    )
    made = forecasts(model, records, [lead])
    share, deviation = (0.0, np.nan) if errors is None else errors.at(lead / records.rate)
    mean = made.mean[0] + share * made.last[0]
    return ScoredPrediction(mean, np.broadcast_to(deviation, mean.shape))


def score_model(
    model: Twin,
    records: Trajectories,
    *,
    horizon: float | None = None,
    warm_up: float = 0.0,
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
    twin : Twin, optional
        The twin before its update, which is scored too.
    seed : int
        Of draws.

    Returns
    -------
    list of ModelScore
        Of the model, the twin, the mean of the record and the last measured sample, per output.

    Raises
    ------
    InputError
        Other channels or another rate than those of the model, a horizon as long as the records,
        or nothing left to score.

    """
    skipped = round(finite("warm_up", warm_up, least=0.0) * records.rate)
    found = predict_records(model, records, horizon=horizon, seed=seed)
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
        predictions["twin"] = ScoredPrediction(free_moments(twin, records.commands)[0], nothing)
    predictions |= _baselines(records, horizon)
    rows = []
    for who, each in predictions.items():
        for channel, output in enumerate(records.outputs.names):
            own = seen[..., channel] & np.isfinite(each.mean[..., channel])
            error = (measured - each.mean)[..., channel][own]
            deviation = each.deviation[..., channel][own]
            rows.append(ModelScore(who, output, horizon, *_scores(error, deviation)))
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
    inside = np.abs(error) <= USUAL * deviation
    return rmse, float(each.mean()), float(inside.mean()), float(2 * USUAL * deviation.mean())


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
