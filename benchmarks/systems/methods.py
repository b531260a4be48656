"""The methods: from a system to models by name, each of which a free simulation scores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import retwin as rt
from retwin.evaluation import predict_records
from retwin.scores.bootstrap import bootstrap_means
from retwin.twins import StateTwin
from retwin.update import DynamicsTwin, fit_black_box, fit_state_surrogate
from retwin.update.forecast_errors import USUAL
from systems.system import System

SCORES = ("rmse", "crps", "coverage", "width")
AHEAD = (1, 10, 100)
"""Samples ahead of the last measurement of which predictions are scored."""
Models = Iterator[tuple[str, Any, str]]
"""Names, models, and notes such as what was chosen."""


class Constant:
    """The mean of the calibration outputs, or the last value before the samples that are scored."""

    def __init__(self, system: System, *, hold: bool) -> None:
        seen = np.where(system.calibration.mask, system.calibration.observed, np.nan)
        self.mean, self.hold = np.nanmean(seen, axis=(0, 1)), hold


def without_model(system: System) -> Models:
    yield "constant", Constant(system, hold=False), ""
    yield "hold", Constant(system, hold=True), ""
    yield "twin", system.twin, ""


def identified(system: System) -> rt.ParametricTwin:
    return rt.identify(system.twin, system.calibration, seed=0).twin


def output_correction(twin: rt.Twin, system: System) -> rt.CorrectedTwin:
    density = rt.SequenceMixture()
    residual = rt.fit_residual(twin, system.calibration, rt.Additive(), density, seed=0)
    return rt.CorrectedTwin(twin, residual)


def parameters(system: System) -> Models:
    twin = identified(system)
    yield (
        "identified",
        twin,
        ", ".join(f"{k} {v:.3g}" for k, v in zip(twin.names, twin.values, strict=True)),
    )
    yield "output", output_correction(twin, system), ""


def segments(system: System) -> Models:
    for name, operator in system.corrections.items():
        residual = rt.fit_residual(system.surrogate, system.calibration, operator, seed=0)
        model, note = rt.CorrectedTwin(system.surrogate, residual), ""
        if system.hidden_truth and name == "command space":
            (records,) = system.tests.values()
            note = system.hidden_truth(model, records)
        yield name, model, note


def dynamics(system: System) -> Models:
    twin = system.twin
    if not isinstance(twin.twin, StateTwin):
        commands = system.calibration.commands
        twin = fit_state_surrogate(identified(system), commands, system.calibration, seed=0).twin
    fitted = rt.fit(twin, system.calibration, rt.Choice(method="dynamics", compare=False), seed=0)
    assert fitted.learned is not None
    yield "dynamics", fitted.twin, f"held out {fitted.learned.figures['held_out']:.3g}"
    yield "dynamics, output", output_correction(fitted.twin, system), ""


def choice(system: System) -> Models:
    fitted = rt.fit(system.twin, system.calibration, rt.Choice(horizon=system.horizon), seed=0)
    yield "fit", fitted.twin, fitted.chosen


def black_box(kind: str) -> Any:
    def fit(system: System) -> Models:
        fitted = fit_black_box(system.calibration, kind, seed=0)
        yield kind, fitted.twin, ", ".join(f"{k} {v:.3g}" for k, v in fitted.figures.items())

    return fit


JOBS = {
    "without model": without_model,
    "parameters": parameters,
    "segments": segments,
    "dynamics": dynamics,
    "choice": choice,
    **{kind: black_box(kind) for kind in ("arx", "narx", "neural_ss", "lstm")},
}
"""What is fitted together, in one process."""
METHODS = {
    "constant": "constant",
    "hold": "hold last",
    "twin": "twin",
    "identified": "identified",
    "delay/offset": "delay, offset",
    "command space": "command space",
    "output": "output",
    "dynamics": "dynamics",
    "dynamics, output": "dynamics, output",
    "fit": "fit",
    "arx": "linear OE",
    "narx": "NARX",
    "neural_ss": "neural SS",
    "lstm": "LSTM",
}
"""The columns of the table, by name of the model."""


def started(model: Any, warm: rt.Trajectories) -> Any:
    """A model that begins as a record does, where its states have unknown starts."""
    if isinstance(model, rt.CorrectedTwin):
        inner = getattr(model.surrogate, "twin", None)
        return model if inner is None else replace(model, surrogate=started(inner, warm))
    if isinstance(model, DynamicsTwin):
        return model.started(warm)
    free = [name for name in getattr(model, "names", ()) if name.startswith("start_")]
    if not free:
        return model
    held = model.holding(*(name for name in model.names if name not in free))
    return rt.identify(held, warm, seed=0).twin


def score(model: Any, system: System, tests: rt.Trajectories) -> Mapping[str, float]:
    """RMSE, CRPS, what 90 % bands hold, and their width; RMSE some samples ahead."""
    warm = round(system.warm_up * tests.rate)
    judged = None if system.horizon is None else round(system.horizon * tests.rate)
    found = dict(zip(SCORES, averaged(model, tests, judged, warm), strict=True))
    found |= {f"ahead {n}": averaged(model, tests, n, warm)[0] for n in AHEAD}
    found = {name: (1 if name == "coverage" else system.scale) * v for name, v in found.items()}
    if getattr(model, "forecast", None) is not None:
        for n in (*AHEAD, None):
            found |= bands(model, tests, n, warm)
    return found


def averaged(model: Any, tests: rt.Trajectories, samples: int | None, warm: int) -> Sequence[float]:
    """Scores of free simulation, or so many samples ahead of the last measurement, of all records.

    They are NaN where a model cannot be started from measurements.
    """
    first = max(warm, samples or 0)
    if first >= tests.steps:
        return (np.nan,) * len(SCORES)
    try:
        parts = [scores(model, tests[[i]], samples, warm, first) for i in range(len(tests))]
    except rt.InputError:
        return (np.nan,) * len(SCORES)
    square, *others = np.mean(np.concatenate(parts), axis=0).tolist()
    return np.sqrt(square), *others


def bands(
    model: Any, tests: rt.Trajectories, samples: int | None, warm: int
) -> Mapping[str, float]:
    """What 90 % bands hold so many samples ahead, or in free simulation, by the calibration of it.

    With the ends of its 95 % interval by a block bootstrap, the width over that of Gaussian bands
    with this RMSE, the share of samples that have a band, and how many independent samples
    calibrated it.
    """
    errors = model.forecast
    name, horizon = (str(samples), samples / tests.rate) if samples else ("free", None)
    keys = ("held", "low", "high", "relative", "given", "independent")
    found, first = [np.nan] * len(keys), max(warm, samples or 0)
    if first < tests.steps and (samples is None or horizon <= errors.leads[:-1].max(initial=0.0)):
        hits, deviations = (np.full(tests.observed.shape, np.nan) for _ in range(2))
        square = np.full(tests.observed.shape, np.nan)
        for i in range(len(tests)):
            record = tests[[i]]
            own = started(model, record.between(0, warm / tests.rate)) if warm else model
            made = predict_records(own, record, horizon=horizon)
            error = np.where(record.mask, record.observed - made.mean, np.nan)[0, first:]
            deviations[i, first:] = deviation = made.deviation[0, first:]
            square[i, first:] = np.where(np.isfinite(deviation), error**2, np.nan)
            inside = np.where(
                np.isfinite(error * deviation), abs(error) <= USUAL * deviation, np.nan
            )
            hits[i, first:] = inside
        share = np.nanmean(hits)
        draws = bootstrap_means(hits, draws=2000, seed=0).mean(axis=1)
        low, high = np.nanquantile(draws, [0.025, 0.975]) if np.isfinite(share) else (np.nan,) * 2
        relative = np.nanmean(np.nanmean(deviations, (0, 1)) / np.sqrt(np.nanmean(square, (0, 1))))
        given = np.isfinite(hits).sum() / tests.mask[:, first:].sum()
        row = np.searchsorted(errors.leads, horizon or np.inf)
        found = [share, low, high, relative, given, errors.independent[row].min()]
    return {f"{key} {name}": float(value) for key, value in zip(keys, found, strict=True)}


def scores(
    model: Any, record: rt.Trajectories, samples: int | None, warm: int, first: int
) -> NDArray:
    """Mean square of the error, CRPS, coverage and width of each output of a record."""
    if isinstance(model, Constant):
        measured = np.where(record.mask, record.observed, np.nan)[0]
        outputs = np.broadcast_to(model.mean, measured.shape)[first:]
        if model.hold:
            seen = np.flatnonzero(np.isfinite(measured).all(axis=1))
            last = measured[seen[seen < max(warm, seen[0] + 1)][-1]]
            outputs = measured[first - samples : -samples] if samples else last
        error = np.abs(measured[first:] - outputs)
        none = np.full(error.shape[1], np.nan)
        return np.stack([np.nanmean(error**2, 0), np.nanmean(error, 0), none, none], 1)
    rate = record.rate
    own = started(model, record.between(0, warm / rate)) if warm else model
    horizon = samples / rate if samples else None
    rows = rt.score_model(own, record, horizon=horizon, warm_up=first / rate)
    found = [[row.rmse**2, row.crps, row.coverage, row.width] for row in rows if row.who == "model"]
    return np.array(found)
