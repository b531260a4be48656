"""What a comparison of candidates shows of a twin and its records, in sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from retwin.data.trajectories import Trajectories
from retwin.evaluation.choice.comparison import HARDLY, Comparison, is_behind
from retwin.evaluation.choice.fitted import CandidateScore
from retwin.evaluation.choice.folds import RECORDS
from retwin.scores.residuals import autocorrelation, ljung_box
from retwin.update.forecast_errors import USUAL, ForecastErrors
from retwin.update.forecasts import begin_of, errors_drift

LONGEST = 0.1
"""Longest dead time that is tried, over the length of a record."""
STARTED = 0.8
"""Ratio of errors from which starts of records are named."""
UNCORRECTED = ("none", "parameters")
"""The candidates that correct nothing."""
AHEAD = 20
"""Samples ahead that are proposed where free simulation is worse than the mean."""
WHITE, COLOURED = 0.01, 0.5
"""p-value below which errors are no white noise, and autocorrelation from which most of their mean
square is none."""


def remarks_of(
    records: Trajectories,
    comparison: Comparison,
    scores: Sequence[CandidateScore],
    chosen: str,
    preferred: str,
    horizon: float | None,
    wanted: str = "",
) -> tuple[str, ...]:
    """The sentences, the most important one first; `wanted` is the method that was asked for."""
    by_name = {each.name: each for each in scores}
    made = []
    if chosen != preferred:
        own, other = by_name[chosen], by_name[preferred]
        behind = is_behind(own.difference, own.standard_error, other.crps)
        how = "clearly better" if behind else "as well, more simply,"
        made.append(
            f"Taken, as asked for: {own.title}. Parts of the records that were left out are "
            f"predicted {how} by {other.title} (CRPS {other.crps:.3g} in place of {own.crps:.3g}), "
            "taken where no method is asked for."
        )
    made += _worse_than_mean(records, by_name[chosen], free=horizon is None)
    if len(records) < RECORDS:
        made.append(
            f"Only parts of {len(records)} record{'s' * (len(records) > 1)} were left out: the "
            "bands hold for further parts of the same. How much another day differs cannot be seen "
            f"from fewer than {RECORDS} records, of which whole ones are left out."
        )
    if preferred in UNCORRECTED:
        made += _describe_uncorrected(comparison, by_name, preferred, wanted, free=horizon is None)
    baseline = "parameters" if "parameters" in comparison.predicted else "none"
    if baseline in comparison.predicted and horizon is None:
        made += _of_twin(records, comparison, baseline)
    return tuple(made)


def _describe_uncorrected(
    comparison: Comparison,
    scores: Mapping[str, CandidateScore],
    name: str,
    wanted: str,
    *,
    free: bool,
) -> list[str]:
    """How much better corrections are than the twin, and whether its errors are no noise.

    That of a `wanted` one alone is said with the decision. Errors of free simulation are tested
    (`free`): others are correlated up to the time ahead.
    """
    who = "the twin with its identified parameters" if name == "parameters" else "the twin"
    tried, made = [each for each in comparison.predicted if each not in UNCORRECTED], []
    if not (tried or wanted):
        made = ["No correction was tried."]
    elif tried and tried != [wanted]:
        titles = " and ".join(scores[each].title for each in tried)
        text = f"No correction helps: {titles} did not predict parts of the records that were left "
        text += f"out better than {who}."
        if scores[name].difference > 0:
            best = min((scores[each] for each in comparison.predicted), key=lambda each: each.crps)
            share = scores[name].difference / scores[name].crps
            text = f"No correction is clearly better than {who}: on parts of the records that were "
            text += f"left out, the best one ({best.title}) is better by {share:.1%} (CRPS), which "
            text += f"is within one standard error, or below {HARDLY:.0%}."
        made = [text]
    if "dynamics" in scores and "output" not in scores:
        made.append(
            "Corrections of outputs were not tried: without --dynamics, fit tries them too, and "
            "takes several times as long."
        )
    errors = comparison.joined(lambda i: comparison.errors(name, i))
    reasons = ["depend on the time in the record"] * errors_drift(errors)
    found = [autocorrelation(own) for own in np.moveaxis(errors, 2, 0)]
    if any(
        np.nan_to_num(each.values).max(initial=0.0) > COLOURED and ljung_box(each)[1] < WHITE
        for each in found
    ):
        reasons.append("are correlated in time")
    if free and reasons:
        made.append(
            f"On parts that were left out, errors of {who} {' and '.join(reasons)}: unless that is "
            "a disturbance from outside or sensor noise, the twin lacks something that no "
            "correction which was tried expresses. Write it into the twin."
        )
    return made


def start_remarks(records: Trajectories, errors: ForecastErrors | None, begin: float) -> list[str]:
    """That errors are mostly those of starts that differ between records.

    Candidates were compared from starts that the first `begin` s give, or from the mean start (0).
    """
    if errors is None or errors.started is None:
        return []
    pairs = zip(records.outputs.names, errors.started, errors.deviation[-1], strict=True)
    found = [
        f"{name} ± {USUAL * own:.3g} in place of {USUAL * usual:.3g}"
        for name, own, usual in pairs
        if own < STARTED * usual
    ]
    if not found:
        return []
    compared = " Candidates were compared so, too." if begin else ""
    return [
        "Records begin in different states, and the model at the mean of them. With starts that "
        f"the first tenth of a record gives, 90 % bands are: {', '.join(found)} (evaluate, "
        f"generate --bands: --warm-up {begin_of(records):g}s).{compared}"
    ]


def correction_remarks(scores: Sequence[CandidateScore], chosen: str) -> list[str]:
    """That a correction changes the distribution of errors, and hardly their size."""
    rmse = {each.name: each.rmse for each in scores if each.rmse}
    before = rmse.get("parameters", rmse.get("none"))
    if before is None or chosen not in rmse or chosen in UNCORRECTED:
        return []
    if any(rmse[chosen][name] < (1 - HARDLY) * error for name, error in before.items()):
        return []
    return [
        f"The correction lowers the RMS error of no output by more than {HARDLY:.0%}: it "
        "changes the bands alone. If the twin lacks more than a disturbance from outside, write "
        "that into the twin."
    ]


def _worse_than_mean(records: Trajectories, score: CandidateScore, *, free: bool) -> list[str]:
    values = np.where(records.mask, records.observed, np.nan).astype(np.float64)
    spread = dict(zip(records.outputs.names, np.nanstd(values, axis=(0, 1)), strict=True))
    text = "; if the machine integrates, as a position does, judge predictions some time ahead: "
    text = f"{text}--horizon {AHEAD / records.rate:g}s" if free else ""
    return [
        f"{name} is predicted worse than by its mean over the records: the error is {error:.3g}, "
        f"the standard deviation {spread[name]:.3g}. Do not use this model for {name}{text}."
        for name, error in score.rmse.items()
        if error >= spread[name]
    ]


def _of_twin(
    records: Trajectories, comparison: Comparison, name: str, *, explained: float = 0.2
) -> list[str]:
    """A missing dead time or lag of the twin, by its own simulations.

    Parameters
    ----------
    explained : float, default 0.2
        Share of the mean square error of the twin from which on either is mentioned.

    """
    made = []
    predicted = comparison.predicted[name]
    nominal = comparison.joined(lambda i: predicted[i].mean)

    def join(parts: Sequence[NDArray]) -> NDArray:
        return comparison.joined(lambda i: parts[i][..., None])[..., 0]

    for channel, output in enumerate(records.outputs.names):
        y = np.where(records.mask[..., channel], records.observed[..., channel], np.nan)
        y, x = y.astype(np.float64), nominal[..., channel]
        both = np.isfinite(y) & np.isfinite(x)
        if both.sum() < 2 or not (np.ptp(x[both]) and np.ptp(y[both])):  # one that never changes
            continue
        if np.corrcoef(x[both], y[both])[0, 1] < 0:
            continue
        delay, share = _dead_time(y, x)
        lag, lagging = _lag(y, [_fill_begin(e.mean[..., channel]) for e in predicted], join)
        # A lag that is missing leaves errors that are correlated; white ones it only smooths.
        coloured = np.nan_to_num(autocorrelation(y - x).values).max(initial=0.0) > COLOURED
        if coloured and lagging >= explained and lagging > share:
            made.append(
                f"A first-order lag of {lag / records.rate:.3g} s, as of a sensor or an actuator, "
                f"explains {lagging:.0%} of the mean square error of the twin in {output}: give "
                "the twin a further state that follows with it."
            )
        elif share >= explained and abs(delay) >= 0.5:
            seconds = delay / records.rate
            what, remedy = (
                f"A dead time of {seconds:.3g} s",
                ", which a StateTwin states as delays={command: parameter}",
            )
            if delay < 0:
                what = f"The twin responds too late: an output that comes {-seconds:.3g} s earlier"
                remedy = ""
            made.append(
                f"{what} explains {share:.0%} of the mean square error of the twin in {output}"
                f"{remedy}."
            )
    return made


def _dead_time(y: NDArray, x: NDArray) -> tuple[float, float]:
    """The shift of a simulation x (n, T) in samples that explains most of y, and what share."""
    longest = max(1, int(LONGEST * y.shape[1]))
    shifts = np.arange(-longest, longest + 1)
    errors = []
    for shift in shifts:
        moved = np.full_like(x, np.nan)
        if shift > 0:
            moved[:, shift:] = x[:, :-shift]
        else:
            moved[:, : x.shape[1] + shift] = x[:, -shift:]
        errors.append(np.nanmean((y - moved) ** 2))
    best = int(np.argmin(errors))
    delay = float(shifts[best])
    if 0 < best < len(shifts) - 1:
        before, here, after = errors[best - 1 : best + 2]
        curvature = before - 2 * here + after
        delay += 0.5 * (before - after) / curvature if curvature > 0 else 0.0
    present = errors[longest]
    return delay, float(1 - errors[best] / present) if present > 0 else 0.0


def _lag(
    y: NDArray, parts: Sequence[NDArray], join: Callable[[Sequence[NDArray]], NDArray]
) -> tuple[float, float]:
    """The time constant in samples of a lag of simulations (r, T) that explains most of y (n, T).

    The second number is the share of the mean square error that it explains. `join` gives (n, T) of
    the parts.
    """
    best, present = (0.0, 0.0), float(np.nanmean((y - join(parts)) ** 2))
    lags = np.geomspace(0.5, max(1.0, LONGEST * y.shape[1]), 30).tolist()
    for lag in lags:
        kept = np.exp(-1 / lag)
        moved = [
            lfilter([1 - kept], [1, -kept], each, axis=1, zi=kept * each[:, :1])[0]
            for each in parts
        ]
        share = 1 - float(np.nanmean((y - join(moved)) ** 2)) / present if present else 0.0
        best = max(best, (lag, share), key=lambda pair: pair[1])
    return best if best[0] < lags[-1] else (0.0, 0.0)  # smoothing, of a twin that is wrong


def _fill_begin(x: NDArray) -> NDArray:
    """Simulations (r, T), which before their first value stay at that."""
    first = np.take_along_axis(x, np.isfinite(x).argmax(axis=1)[:, None], axis=1)
    return np.where(np.isfinite(x), x, first)


def without_twin(
    scores: Sequence[CandidateScore],
    chosen: CandidateScore,
    *,
    clear: float = 2.0,
    better: float = 0.1,
) -> list[str]:
    """A model without the twin that is better than the chosen candidate, in a sentence.

    Parameters
    ----------
    clear : float, default 2.0
        Standard errors of the difference of scores that are no chance.
    better : float, default 0.1
        Share by which a model without the twin must be better to be mentioned.

    """
    rivals = [
        each for each in scores if each.rmse and -each.difference > clear * each.standard_error
    ]
    if not rivals:
        return []
    best = min(rivals, key=lambda each: each.nrmse)
    gain = 1 - best.nrmse / chosen.nrmse
    if gain < better:
        return []
    return [
        f"The {best.title} predicts the same parts better by {gain:.0%}: the twin lacks something "
        "that the commands determine. Add that to the twin; where its parameters need no meaning, "
        f"take the other model, in Python: `retwin.update.fit_black_box(records, {best.name!r})`."
    ]
