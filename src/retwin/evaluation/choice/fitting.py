"""`fit`: an updated twin, its correction chosen by parts of the records that are left out."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.catalog import CANDIDATES
from retwin.checks import require
from retwin.data.measured import check_magnitude
from retwin.data.quality.check import Checked
from retwin.data.quality.copies import distinct_records
from retwin.data.quality.sensors import limits_of
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.evaluation.choice.candidates import Candidates, Model
from retwin.evaluation.choice.comparison import Comparison
from retwin.evaluation.choice.fitted import CandidateScore, Fitted
from retwin.evaluation.choice.folds import Fold, block_length, folds_of, independent_means
from retwin.evaluation.choice.remarks import (
    STARTED,
    correction_remarks,
    remarks_of,
    start_remarks,
    without_twin,
)
from retwin.evaluation.choice.settings import MEMBERS, Choice
from retwin.evaluation.choice.trials import Trials, shorter, unstable
from retwin.progress import Progress
from retwin.scores.distributions import crps_normal
from retwin.twins.twin import Twin, check_channels
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.sensor_limits import describe_limits, limit_equations
from retwin.update.agreement import check_with_twin
from retwin.update.blackbox import BLACK_BOXES, fit_black_box
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Additive, DelayOffset
from retwin.update.corrections.commands.machines import OtherMachines
from retwin.update.dynamics import DynamicsTwin
from retwin.update.dynamics.unknowns import state_names, state_twin_of
from retwin.update.forecast_errors import ForecastErrors, predictive_deviation
from retwin.update.forecasts import (
    LEADS,
    LeftOut,
    calibrate_forecasts,
    forecasts,
    free_moments,
    started_mean,
)
from retwin.update.residual.fitting import calibrating
from retwin.update.residual.priors import other_machines
from retwin.workers.threads import one_thread

UNSTABLE = (
    "Free simulation from the commands alone diverges, or is no better than the mean of the "
    "outputs: the twin integrates, or is unstable."
)
"""What is said where candidates were judged over a shorter time than was asked for."""

JUDGED = (
    "Candidates were judged {0:g} s after the last measurement instead. Use the model so, with "
    "evaluate --horizon {0:g}s, and for no free simulation: neither generate, nor evaluate without "
    "--horizon."
)
"""How the model is used then."""

NOT_TAKEN = (
    "The method that was asked for ({}) does not predict left-out parts of the records clearly "
    "better than: {}, which was taken. --no-compare takes it all the same, and judges nothing."
)
"""What is said where the method that was asked for is not the one that is taken."""

IDENTIFIED = (
    "These records have identified the parameters of the twin, so that none of them is new to it. "
    "In its place a twin is scored whose parameters are identified without the part left out."
)
"""Why the twin as it is has no row in the comparison."""


@one_thread()  # fits are small, and threads that wait for each other take longer
def fit(
    twin: Twin,
    records: Trajectories,
    settings: Choice = Choice(),  # noqa: B008 - frozen
    *,
    seed: int = 0,
    case: str = "",
    original: Twin | None = None,
    progress: Progress | None = None,
) -> Fitted:
    """Update a twin by the correction that predicts left-out parts of its records best.

    Candidates are the twin as it is, with identified parameters, with corrected state equations,
    with a delay and an offset per segment, with a residual of each output sample, and the last two
    in series, as far as the twin and the records allow. Each is fitted without each part of the
    records in turn, and predicts it. One takes the place of a simpler one where its score
    (CRPS) is lower by more than a standard error, and 2 %. The last one is fitted to all records;
    its bands are calibrated by its errors on the parts that were left out.

    Parameters
    ----------
    twin : Twin
        Any twin; a `StateTwin`, or a `ParametricTwin` of one, also has corrected state equations.
    records : Trajectories
        Measured outputs with commands. Of labelled records the healthy ones are used by default.
    settings : Choice
        The candidates, and the horizon at which they are judged; or the method that is taken.
    seed : int
        Of networks and searches; the same seed gives the same bytes on the same machine.
    case : str
        Name of the case of the twin, which the saved model names.
    original : Twin, optional
        The twin that a surrogate `twin` was trained on, by which its error is measured.
    progress : callable, optional
        Called with the share of the work that is done.

    Returns
    -------
    Fitted
        Its `twin` is the updated twin.

    Raises
    ------
    InputError
        Other channels or another rate than those of the twin, no healthy record, too few samples,
        or no candidate that can be fitted.

    """
    began, given_records = time.perf_counter(), records
    records = _select_records(records, settings)
    check_channels(twin, records, "records")
    others = other_machines(settings.prior, settings.correction or DelayOffset(), twin)
    checked = check_with_twin(original or twin, given_records)
    limits = limits_of(records)
    twin = limit_equations(twin, limits)
    told = describe_limits(twin.outputs.names, limits) if state_names(twin) else ""
    limit_remarks = [f"{told}."] if told else []
    shown = None if settings.compared else progress
    whole = Candidates(twin, records, settings, seed, case, original, shown)
    names = _names(whole, settings)
    since = time.process_time()
    # First, so that settings of a given method that are wrong are so before the comparison.
    given = whole.fits[settings.method]() if settings.method else None
    if given is not None and not settings.compared:
        alone = _fit_alone(whole, given, time.process_time() - since, began, checked)
        return replace(alone, remarks=(*alone.remarks, *limit_remarks, *_of_prior(given, others)))
    folds = folds_of(records)
    trials = _run_trials(whole, folds, names, progress)
    free, reasons, horizon = _compare(trials, whole)
    comparison, begin = free, 0.0
    if horizon is None and trials.begin:
        started, failed = trials.compare(None, trials.begin)
        if started.predicted and started.best < STARTED * free.best:
            comparison, reasons, begin = started, failed, trials.begin
    preferred, differences = comparison.simplest()
    wanted = settings.method
    chosen = wanted if wanted and settings.forced else preferred
    model = _calibrate(_fit_chosen(whole, chosen, given), trials, chosen, free)
    scores = tuple(
        _row(name, comparison, differences, trials.seconds[name], reasons.get(name, ""))
        for name in trials.names
    )
    said = remarks_of(records, comparison, scores, chosen, preferred, horizon, wanted)
    remarks = (*said, *limit_remarks)
    if settings.identified and "none" not in names and "parameters" in names:
        remarks = (*remarks, IDENTIFIED)
    if wanted and chosen != wanted:
        titles = (CANDIDATES[each] for each in (wanted, chosen))
        remarks = (NOT_TAKEN.format(*titles), *remarks)
    if horizon != settings.horizon:
        remarks = (f"{UNSTABLE} {JUDGED.format(horizon)}", *remarks)
    begins = start_remarks(records, model.forecast, begin) if horizon is None else []
    predicted, deviation = _predictions_of(comparison, chosen)
    parameters = _parameters(whole, model)
    found = Fitted(
        twin=model,
        chosen=chosen,
        preferred=preferred,
        scores=scores,
        remarks=(
            *remarks,
            *(begins or (correction_remarks(scores, chosen) if chosen == preferred else ())),
            *_at_bounds(whole, parameters),
            *_of_prior(model, others),
        ),
        parameters=parameters,
        horizon=horizon,
        begin=begin,
        parts=tuple(each.name for each in folds),
        records=records,
        predicted=predicted,
        deviation=deviation,
        learned=whole.learned if chosen.startswith("dynamics") else None,
        seconds=time.perf_counter() - began,
        checked=checked,
    )
    return with_yardstick(found, seed=seed) if settings.yardstick else found


def _fit_chosen(whole: Candidates, chosen: str, given: Model | None) -> Model:
    """The chosen candidate, fitted to all records; `given` is that of `settings.method`."""
    wanted = whole.settings.method
    if given is not None and chosen == wanted:
        return given
    if wanted == "dynamics" and chosen in ("none", "parameters"):
        return whole.keep_equations(chosen)  # what is done with state equations works with it too
    return whole.fits[chosen]()


def _run_trials(
    whole: Candidates, folds: list[Fold], names: list[str], progress: Progress | None
) -> Trials:
    """The fits of candidates without each fold, of which one at least succeeds."""
    part = len(folds) / (len(folds) + 1)  # the rest is the fit to all records
    trials = Trials(
        whole.records,
        folds,
        names,
        lambda own: replace(whole, records=own, settings=whole.settings.lighter).fits,
        progress and (lambda share: progress(part * share)),
    )
    trials.run()
    require(
        len(trials.reasons) < len(names),
        "records",
        expected="records to which a candidate can be fitted without a part of them",
        got="; ".join(f"{name}: {reason}" for name, reason in trials.reasons.items()),
        remedy="give longer or more records",
    )
    return trials


def _compare(trials: Trials, whole: Candidates) -> tuple[Comparison, dict[str, str], float | None]:
    """The comparison, why some have no score, and the horizon at which candidates are judged."""
    horizon = whole.settings.horizon
    comparison, reasons = trials.compare(horizon)
    if horizon is None and unstable(comparison, whole):
        horizon = shorter(whole)
        comparison, reasons = trials.compare(horizon)
    require(
        comparison.predicted,
        "twin",
        expected="simulations that stay finite",
        got="; ".join(reasons.values()),
        remedy="identify the twin first, or judge it over a shorter horizon",
    )
    return comparison, reasons, horizon


def _fit_alone(
    whole: Candidates, model: Model, taken: float, began: float, checked: Checked
) -> Fitted:
    """The given method, of which nothing but its own fit is known."""
    name, nothing = whole.settings.method, np.full(whole.records.observed.shape, np.nan)
    row = _row(name, None, {}, taken, "not compared")
    text = (
        f"No comparison was made: {row.title}, fitted to all records; none of them was left out to "
        "judge it, and its bands are those of its own fit."
    )
    return Fitted(
        twin=model,
        chosen=name,
        preferred=name,
        scores=(row,),
        remarks=(text,),
        parameters=_parameters(whole, model),
        horizon=whole.settings.horizon,
        begin=0.0,
        parts=(),
        records=whole.records,
        predicted=nothing,
        deviation=nothing,
        learned=whole.learned if "learned" in vars(whole) else None,
        seconds=time.perf_counter() - began,
        checked=checked,
    )


def _of_prior(model: Model, others: OtherMachines | None) -> tuple[str, ...]:
    """Where the prior of the model came from, if it has one."""
    learned = model.residual.learned if isinstance(model, CorrectedTwin) else None
    return () if others is None or learned is None else (f"{others.text.capitalize()}.",)


def _select_records(records: Trajectories, settings: Choice) -> Trajectories:
    """The records to calibrate on, copies once; unlabelled ones are healthy where all are."""
    check_magnitude("calibration", records, ideal=True)
    if not records.known_labels and settings.calibrate_on == "healthy":
        own = records.replace(labels=[HEALTHY] * len(records))
    else:
        own = records[calibrating(records, settings.calibrate_on)]
    # A part that is left out must not be seen in a copy of it.
    return own[distinct_records(np.where(own.mask, own.observed, np.nan))]


def _names(candidates: Candidates, settings: Choice) -> list[str]:
    """The candidates that are compared."""
    names = list(candidates.fits)
    require(
        names and (not settings.method or settings.method in names),
        "method",
        expected=f"a candidate that this twin and these records allow: {', '.join(names)}",
        got=settings.method or "none",
        remedy="dynamics need a StateTwin, or a state surrogate of the twin; a delay and an offset "
        "commands that move and rest",
    )
    if not settings.method or settings.candidates:
        return names
    simpler = names[: names.index(settings.method)]
    per_segment = {"delay_offset", "segments"} - {settings.method}  # costly, and no part of others
    return [*(each for each in simpler if each not in per_segment), settings.method]


def _calibrate(model: Model, trials: Trials, name: str, comparison: Comparison) -> Model:
    """The model with bands that hold what the parts in time show."""
    records, found = trials.records, []
    if name not in comparison.predicted:
        return model
    leads = [each for each in LEADS if 4 * each <= records.steps]
    for one, fold in zip(trials.models[name], trials.folds, strict=True):
        own = records[fold.rows]
        free = free_moments(one, own.commands)[0]
        part = (forecasts(one, own, leads), free, own, fold.held[fold.rows])
        excess, started = fold.excess(records), started_mean(one, own)
        found.append(LeftOut(*part, excess, fold.edge, started))
    forecast = calibrate_forecasts(records, found, leads)
    constant = comparison.constant[name]
    if constant.any():
        assert isinstance(model, DynamicsTwin)
        model = replace(model, constant=np.where(constant, forecast.deviation[-1], 0.0))
    # Deviations change with time, as from an unknown start on: errors are compared with each.
    deviation, ratios = free_moments(model, records.commands)[1], []
    for each, fold in zip(found, trials.folds, strict=True):
        seen = each.record.mask & each.held[..., None] & (not each.edge)
        known = seen & (deviation[fold.rows] > 0)
        error = np.where(known, np.abs(each.record.observed - each.free), np.nan)
        ratios.append(
            (error / np.where(known, deviation[fold.rows], 1.0)).reshape(-1, len(constant))
        )
    every, factors = np.concatenate(ratios), np.ones(len(constant))
    for i in np.flatnonzero(~constant & np.isfinite(every).any(axis=0)):
        own_ratios = every[np.isfinite(every[:, i]), i]
        factors[i] = predictive_deviation(own_ratios, float(forecast.independent[-1, i]))
    return widened(model, factors, forecast)


def widened(model: Model, factors: NDArray, forecast: ForecastErrors) -> Model:
    """The model with deviations of each output multiplied by a factor (d_y,)."""
    if isinstance(model, DynamicsTwin):
        return replace(model, widening=model.widening * factors, forecast=forecast)
    if isinstance(model.residual.correction, Additive):
        residual = copy.deepcopy(model.residual)
        with torch.no_grad():
            residual.spread = residual.spread * torch.as_tensor(factors).to(residual.spread)
        return replace(model, residual=residual, forecast=forecast)
    return replace(model, forecast=forecast)


def with_yardstick(
    found: Fitted, *, seed: int = 0, workers: int = 1, progress: Progress | None = None
) -> Fitted:
    """The same, compared with models without the twin on the same parts.

    Parameters
    ----------
    found : Fitted
        What `fit` returned.
    seed : int
        Of networks.
    workers : int
        The number of processes. A script that wants more than one is guarded by
        `if __name__ == "__main__"`, since each of them imports it.
    progress : callable, optional
        Called with the share of the work that is done.

    """
    began, records = time.perf_counter(), found.records
    fits = partial(_black_boxes, seed)
    trials = Trials(records, folds_of(records), list(BLACK_BOXES), fits, progress)
    trials.run(workers)
    comparison, reasons = trials.compare(found.horizon, found.begin)
    behind = {kind: _behind(found, comparison, kind) for kind in comparison.predicted}
    rows = [
        replace(
            _row(kind, comparison, behind, trials.seconds[kind], reasons.get(kind, "")),
            uses_twin=False,
        )
        for kind in BLACK_BOXES
    ]
    own = [each for each in found.scores if each.uses_twin]
    return replace(
        found,
        scores=(*own, *rows),
        remarks=(*found.remarks, *without_twin(rows, found.score(found.chosen))),
        seconds=found.seconds + time.perf_counter() - began,
    )


def _black_boxes(seed: int, training: Trajectories) -> dict[str, Callable[[], Model]]:
    """What fits each model without the twin to some records."""
    return {kind: partial(_fit_black_box, training, kind, seed) for kind in BLACK_BOXES}


def _fit_black_box(training: Trajectories, kind: str, seed: int) -> Model:
    return fit_black_box(training, kind, members=MEMBERS, seed=seed).twin


def _behind(found: Fitted, comparison: Comparison, kind: str) -> tuple[float, float]:
    """Mean difference of a model's scores from those of what was chosen, and its standard error.

    They are those of the parts in time, in standard deviations of the outputs.
    """
    scores = []
    for mean, deviation in (_predictions_of(comparison, kind), (found.predicted, found.deviation)):
        error = np.where(found.records.mask, found.records.observed - mean, np.nan)
        each = crps_normal(error, np.zeros_like(error), deviation) / comparison.spread
        scores.append(np.mean(each, axis=2))
    change = scores[0] - scores[1]
    seen = np.isfinite(change)
    if not seen.any():
        return float("nan"), float("nan")
    lengths = [block_length(np.nan_to_num(change), seen)]
    own = independent_means(change[:, None], lengths)
    chance = own.std(ddof=1) / np.sqrt(len(own)) if len(own) > 1 else float("inf")
    return float(own.mean()), float(chance)


def _row(
    name: str,
    comparison: Comparison | None,
    differences: dict[str, tuple[float, float]],
    seconds: float,
    reason: str,
) -> CandidateScore:
    title = CANDIDATES.get(name, name)
    if reason or comparison is None or name not in comparison.predicted:
        n = float("nan")
        return CandidateScore(name, title, {}, n, n, n, n, {}, seconds, reason)
    rmse = comparison.rmse(name)
    names = comparison.records.outputs.names
    return CandidateScore(
        name,
        title,
        dict(zip(names, rmse.tolist(), strict=True)),
        float(np.mean(rmse / comparison.spread)),
        float(comparison.independent_scores(name).mean()),
        *differences[name],
        dict(zip(names, comparison.coverage(name).tolist(), strict=True)),
        seconds,
    )


def _predictions_of(comparison: Comparison, name: str) -> tuple[NDArray, NDArray]:
    """Predictions (n, T, d_y) of the parts in time that were left out, and their deviations."""
    if name not in comparison.predicted:
        nothing = np.full(comparison.records.observed.shape, np.nan)
        return nothing, nothing
    observed, folds = comparison.records.observed, comparison.folds
    mean = comparison.joined(lambda i: observed[folds[i].rows] - comparison.errors(name, i))
    return mean, comparison.joined(lambda i: comparison.deviation(name, i))


def _parameters(whole: Candidates, model: Model) -> dict[str, tuple[float, float, float]]:
    """By parameter: before, identified alone, and in the model."""
    free = whole.free
    if free is None:
        return {}
    before = dict(zip(free.names, free.values, strict=True))
    alone = dict(whole.updated.values) if "updated" in vars(whole) and whole.updated else before
    inside: object = model
    if isinstance(model, CorrectedTwin):
        inside = getattr(model.surrogate, "twin", model.surrogate)
    now = before
    if isinstance(inside, DynamicsTwin):
        now = dict(zip(inside.equations.names, inside.values.tolist(), strict=True))
    elif state_names(inside):
        now = state_twin_of(inside)[2]  # type: ignore[arg-type]
    elif isinstance(inside, ParametricTwin):
        now = dict(zip(inside.names, inside.values, strict=True))
    return {name: (before[name], alone[name], now.get(name, alone[name])) for name in before}


def _at_bounds(
    whole: Candidates, parameters: dict[str, tuple[float, float, float]], *, near: float = 1e-3
) -> list[str]:
    """Which parameters of the model are at an end of their range, up to a share `near` of it."""
    made = []
    for each in whole.free.parameters if whole.free else ():
        value, margin = parameters[each.name][2], near * (each.high - each.low)
        if not each.low + margin < value < each.high - margin:
            made.append(
                f"{each.name} is at an end of its range, {value:.4g} {each.unit}: its value may "
                "lie beyond, or stand for something else that the twin lacks."
            )
    return made
