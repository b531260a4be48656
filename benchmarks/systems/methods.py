"""The methods: from a system to models by name, each of which a free simulation scores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import retwin as rt
from retwin.evaluation import record_means, simulate_records
from retwin.twins import StateTwin
from retwin.update import DynamicsTwin, fit_black_box, fit_dynamics, fit_state_surrogate
from systems.system import System

DRAWS = 200
AHEAD = (1, 10, 100)
"""Samples ahead of the last measurement of which predictions are scored."""
Models = Iterator[tuple[str, Any, str]]
"""Names, models, and notes such as what was chosen."""


class Constant:
    """The mean of the calibration outputs, or the last value before the samples that are scored."""

    def __init__(self, system: System, *, hold: bool) -> None:
        seen = np.where(system.calibration.mask, system.calibration.observed, np.nan)
        self.mean, self.hold = np.nanmean(seen, axis=(0, 1)), hold

    def predict(self, record: rt.Trajectories, warm: int) -> NDArray:
        """The same outputs (d_y,) at all samples."""
        return record.observed[0, max(0, warm - 1)] if self.hold else self.mean


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
    twin = identified(system)
    if not isinstance(twin.twin, StateTwin):
        commands = system.calibration.commands
        twin = fit_state_surrogate(twin, commands, system.calibration, seed=0).twin
    fitted = fit_dynamics(twin, system.calibration)
    yield "dynamics", fitted.twin, f"held out {fitted.figures['held_out']:.3g}"
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
    later = {n: ahead(model, tests, n, warm) for n in AHEAD}
    if system.horizon is None:
        scores = free(model, tests, warm)
    else:
        scores = ahead(model, tests, round(system.horizon * tests.rate), warm)
    found = dict(zip(("rmse", "crps", "coverage", "width"), scores, strict=True))
    found |= {f"ahead {n}": each[0] for n, each in later.items()}
    return {name: (1 if name == "coverage" else system.scale) * v for name, v in found.items()}


def free(model: Any, tests: rt.Trajectories, warm: int) -> Sequence[float]:
    """Scores of free simulation after the samples of the warm-up."""
    parts = []
    for index in range(len(tests)):
        record = tests[[index]]
        if isinstance(model, Constant):
            each = plain(
                record, np.broadcast_to(model.predict(record, warm), record.observed.shape)
            )
        else:
            own = started(model, record.between(0, warm / record.rate)) if warm else model
            made = simulate_records(own, record, draws=DRAWS, seed=index)
            width = np.where(record.mask, made.bands[:, -1] - made.bands[:, 0], np.nan)
            square, crps, _, held, _ = np.moveaxis(made.per_sample(), -1, 0)
            each = np.stack([square, crps, held, width if made.random else held], -1)
        parts.append(each[:, warm:])
    square, *others = record_means(np.concatenate(parts)).mean(axis=0).tolist()
    return np.sqrt(square), *others


def plain(record: rt.Trajectories, outputs: NDArray) -> NDArray:
    """Squared and absolute errors (n, T, d_y, 4) of outputs without bands."""
    error = np.where(record.mask, np.abs(record.observed - outputs), np.nan)
    none = np.full(error.shape, np.nan)
    return np.stack([error**2, error, none, none], -1)


def ahead(model: Any, tests: rt.Trajectories, samples: int, warm: int) -> Sequence[float]:
    """Scores so many samples ahead of the last measurement; NaN where there are none."""
    first = max(warm, samples)
    if first >= tests.steps:
        return (np.nan,) * 4
    if isinstance(model, Constant):
        held = np.where(tests.mask, tests.observed, np.nan)[:, first - samples : -samples]
        outputs = held if model.hold else np.broadcast_to(model.mean, held.shape)
        later = tests.between(first / tests.rate, tests.steps / tests.rate)
        square, *others = record_means(plain(later, outputs)).mean(axis=0).tolist()
        return np.sqrt(square), *others
    try:
        model = started(model, tests.between(0, warm / tests.rate)) if warm else model
        options = {"horizon": samples / tests.rate, "warm_up": first / tests.rate}
        rows = [row for row in rt.score_model(model, tests, **options) if row.who == "model"]
    except rt.InputError:  # a model that cannot be started from measurements
        return (np.nan,) * 4
    others = np.mean([[row.crps, row.coverage, row.width] for row in rows], axis=0)
    return float(np.sqrt(np.mean([row.rmse**2 for row in rows]))), *others.tolist()
