"""`retwin diagnose`: train a diagnoser or derive one from a corrected twin, and use it."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from retwin import catalog
from retwin.checks import given, one_of
from retwin.cli import options
from retwin.cli.commands import Commands
from retwin.cli.options import argument, leave_out, option
from retwin.cli.reading import (
    case_named,
    is_sealed,
    open_sealed,
    read,
    saved,
    system_of,
    updated_twin,
)
from retwin.cli.terminal import answer, bar, example, note, table
from retwin.data.trajectories import Trajectories
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place

if TYPE_CHECKING:  # printing help needs no torch, which takes seconds to import
    from retwin.cases.case import Case
    from retwin.deploy.bundle.bundle import Bundle
    from retwin.deploy.onnx.portable import Portable
    from retwin.diagnosis import Conclusion, Diagnoser, FittedDiagnoser
    from retwin.scores.classification import Scores

TEXTS = ("diagnosis", "label", "commands", "reason", "guard")
"""Columns of diagnoses that hold no numbers."""
EMULATED = "These trajectories are EMULATED: no real measurements."

app = Commands(
    help="Train a diagnoser, and use it.",
    epilog=example("retwin diagnose predict cnn real.mat --case armpi"),
)


@app.command(epilog=example("retwin diagnose fit real.mat --from model --out physics"))
def fit(
    out: Annotated[Path, option("FOLDER", "Where to save the diagnoser.")],
    file: Annotated[
        Path | None, argument("FILE", "Labelled trajectories; with --from, those of its fit.")
    ] = None,
    model: Annotated[
        Path | None,
        option("MODEL", "Invert this corrected twin: no faulty records needed.", "--from"),
    ] = None,
    classifier: Annotated[
        str | None, option("NAME", "cnn, lstm or rocket; else cnn.", names=catalog.CLASSIFIERS)
    ] = None,
    case: options.CaseOption = None,
    rate: Annotated[float | None, option("HZ", "Sample rate of a classifier's features.")] = None,
    random_onset: Annotated[
        bool, option("", "With --from: infer the onset of stuck motors.", "--random-onset")
    ] = False,
    seed: options.Seed = 0,
    mapping: options.LogMapping = None,
    max_bytes: options.MaxBytes = None,
) -> None:
    """Train a diagnoser on labelled trajectories, or derive one from a corrected twin."""
    parts = ("surrogate", "residual", "twin") if model else ()
    check_place(out, folder=True, holds=("model.json", "weights.safetensors", *parts))
    reading = partial(read, max_bytes=max_bytes, mapping=mapping)
    if model is None:
        leave_out({"--random-onset": random_onset}, "without --from")
        remedy = "name it, or invert a corrected twin: --from MODEL"
        labelled = given("FILE", file, "labelled trajectories", remedy=remedy)
        chosen = catalog.make(catalog.CLASSIFIERS, classifier or "cnn", "classifier")
        system = case_named(case)
        made = _train(reading(labelled, system), chosen, system, rate, seed)
    else:
        leave_out({"--classifier": classifier, "--rate": rate}, "with --from")
        made = _invert(model, file, case, random_onset, reading)
    made.save(out)
    note(f"Saved {out}")


def _train(
    training: Trajectories, classifier: Any, system: Case | None, rate: float | None, seed: int
) -> FittedDiagnoser:
    """A classifier of labelled trajectories."""
    import retwin as rt

    with bar("train") as show:
        classes = None if system is None else system.classes
        report = partial(show, "classifier")
        diagnoser = rt.fit_diagnoser(
            training, classifier, seed=seed, classes=classes, rate=rate, progress=report
        )
    assert diagnoser.fitted is not None
    accuracy = diagnoser.fitted.figures["accuracy"]
    answer(None, f"Accuracy on the held-out fifth of these trajectories: {accuracy:.3f}")
    return diagnoser


def _invert(
    model: Path, real: Path | None, case: str | None, onset: bool, reading: Callable
) -> FittedDiagnoser:
    """The inversion of a corrected twin; only healthy trajectories are used."""
    import retwin as rt
    from retwin.update import DynamicsTwin

    updated = updated_twin(model)
    system = system_of(updated, model, case)
    if onset:
        system = system.with_random_onset()
    if isinstance(updated, DynamicsTwin):
        leave_out({"FILE": real}, "for corrected dynamics, which need none")
        return rt.fit_inversion(updated, None, None, system.faults)
    expected, remedy = "the trajectories on which the twin was calibrated", "name their file"
    calibration = reading(given("FILE", real, expected, remedy=remedy), system, part="calibration")
    return rt.fit_inversion(
        updated.surrogate, updated.residual, calibration, system.faults, twin=system.twin
    )


@app.command(epilog=example("retwin diagnose predict cnn real.mat --case armpi"))
def predict(
    model: Annotated[Path, argument("MODEL", "A diagnoser, a bundle, or its ONNX export.")],
    file: Annotated[Path, argument("FILE", "Trajectories; labels are not needed.")],
    case: options.CaseOption = None,
    out: Annotated[Path | None, option("FILE", "CSV file for all probabilities.", "--out")] = None,
    max_faults: Annotated[
        int, option("N", "2 also tries pairs of stuck actuators.", "--max-faults")
    ] = 1,
    mapping: options.LogMapping = None,
    max_bytes: options.MaxBytes = None,
    as_json: options.Json = False,
) -> None:
    """Diagnose trajectories, and score the diagnoses if the labels are known.

    A bundle also states which trajectories it was not made for: they have no
    diagnosis and no probabilities.
    """
    if out is not None:
        check_place(out)
    reading = partial(read, file, max_bytes=max_bytes, mapping=mapping)
    if is_sealed(saved(model)):
        one_of("--max-faults", max_faults, (1,), remedy="give the folder of an inversion")
        bundle = open_sealed(model)
        trajectories = reading(case)
        made = _by_bundle(bundle, trajectories)
    else:
        from retwin.diagnosis import load_diagnoser

        diagnoser = load_diagnoser(model)
        trajectories = reading(case)
        made = _by_diagnoser(diagnoser, trajectories, max_faults)
    answer(
        {
            "emulated": trajectories.emulated,
            "remark": made.remark,
            "trajectories": made.rows,
            "scores": made.scores,
        },
        table(
            ("trajectory", *made.shown),
            [[each["id"], *(_shown(each[name]) for name in made.shown)] for each in made.rows],
            numbers=[name for name in made.shown if name not in TEXTS],
        ),
        *([EMULATED] if trajectories.emulated else []),
        *([str(made.scores)] if made.scores is not None else []),
        as_json=as_json,
    )
    if made.remark:
        note(made.remark)
    if out is not None:
        _write_probabilities(out, made)


@dataclass(frozen=True)
class Diagnosed:
    """What is shown and written of diagnosed trajectories.

    Attributes
    ----------
    classes : sequence of str
        Of the probabilities.
    rows : list of dict
        The values of each trajectory, also as JSON.
    shown : sequence of str
        Names of those that the table shows beside the trajectory.
    written : sequence of str
        Names of those that the CSV file has beside the probabilities.
    scores : Scores or None
        If all labels are known.
    remark : str
        What the answer "unknown" rests on.

    """

    classes: Sequence[str]
    rows: list[dict[str, Any]]
    shown: Sequence[str]
    written: Sequence[str]
    scores: Scores | None = None
    remark: str = ""


def _by_bundle(bundle: Bundle | Portable, trajectories: Trajectories) -> Diagnosed:
    """Diagnoses of a bundle, with the verdicts of its guard."""
    found = bundle.predict(trajectories)
    verdicts = {"guard": found.verdicts.verdict.tolist(), "reason": found.verdicts.reason.tolist()}
    rows = _diagnoses(trajectories, found.classes, found.probabilities, found.diagnosis, verdicts)
    shown = ("diagnosis", "probability", *verdicts)
    return Diagnosed(found.classes, rows, shown, ("diagnosis", *verdicts))


def _by_diagnoser(diagnoser: Diagnoser, trajectories: Trajectories, max_faults: int) -> Diagnosed:
    """Diagnoses of a diagnoser of any kind."""
    from retwin.diagnosis import conclude
    from retwin.evaluation.diagnosers import check_probabilities, scored

    with bar("diagnose") as show:
        report = partial(show, "faults")
        concluded = conclude(diagnoser, trajectories, max_faults=max_faults, progress=report)
    probabilities, severities = concluded.probabilities, _severities(concluded)
    check_probabilities(trajectories, probabilities)
    labels = trajectories.labels.tolist()
    labelled = bool(trajectories.known_labels) and "" not in labels
    classes, outside = diagnoser.classes, _outside(diagnoser, trajectories).tolist()
    columns: dict[str, list[Any]] = {
        "reason": concluded.reason.tolist(),
        "label": [label or None for label in labels],
        "commands": ["outside" if beyond else "ok" for beyond in outside],
        **severities,
    }
    more = ["commands"] * any(outside) + ["reason"] * any(columns["reason"])
    return Diagnosed(
        classes,
        _diagnoses(trajectories, classes, probabilities, concluded.labels, columns),
        ("diagnosis", "probability", *severities, "label", *more),
        ["diagnosis", "reason", *["unknown"] * (concluded.found is not None)],
        scored(trajectories, probabilities, classes) if labelled else None,
        concluded.remark,
    )


def _severities(concluded: Conclusion) -> dict[str, list[float | None]]:
    """What an inversion gives besides for the most probable class of each trajectory, by name."""
    from retwin.diagnosis import Diagnosis, StateDiagnosis

    found = concluded.found
    if found is None:
        return {}
    columns = {"unknown": found.unknown}
    if isinstance(found, Diagnosis) and found.several.any():
        columns["several"] = found.several
    if isinstance(found, StateDiagnosis):
        own = (np.arange(len(concluded.labels)), found.probabilities.argmax(axis=1))
        columns |= {"size": found.size.value[own], "onset in s": found.onset.value[own]}
    return {
        name: [None if np.isnan(x) else float(x) for x in each] for name, each in columns.items()
    }


def _outside(diagnoser: Diagnoser, trajectories: Trajectories) -> NDArray:
    """Which trajectories (n,) have commands beyond those that the diagnoser's twin has learned."""
    from retwin.diagnosis import StateInversionDiagnoser
    from retwin.update.training_range import outside_training

    if isinstance(diagnoser, StateInversionDiagnoser):
        return diagnoser.twin.outside(trajectories.commands)
    return outside_training(getattr(diagnoser, "surrogate", None), trajectories)


def _shown(value: object) -> str:
    """A value of a table: numbers with three digits, nothing for None."""
    if isinstance(value, float):
        return f"{value:.3g}"
    return "" if value is None else str(value)


def _diagnoses(
    trajectories: Trajectories,
    classes: Sequence[str],
    probabilities: NDArray,
    labels: NDArray,
    others: dict[str, list[Any]],
) -> list[dict[str, Any]]:
    """The diagnosis of each trajectory, the probability of every class, and other columns.

    A trajectory with a probability that is not finite has None for each probability.
    """
    unknown = [None] * len(classes)
    known = [row.tolist() if np.isfinite(row).all() else unknown for row in probabilities]
    columns = {
        "id": trajectories.ids.tolist(),
        "diagnosis": labels.tolist(),
        "probability": [None if row is unknown else max(row) for row in known],
        "probabilities": [dict(zip(classes, row, strict=True)) for row in known],
        **others,
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _write_probabilities(out: Path, made: Diagnosed) -> None:
    """Write a CSV file: the trajectory, what `made.written` names, and all probabilities."""
    with write_atomically(out) as part, part.open("w", newline="", encoding="utf-8") as sheet:
        writer = csv.writer(sheet)
        writer.writerow(["trajectory", *made.written, *made.classes])
        for each in made.rows:
            values = [each[name] for name in made.written]
            writer.writerow([each["id"], *values, *each["probabilities"].values()])
    note(f"Wrote {out}")
