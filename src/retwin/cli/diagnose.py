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
from retwin.cli.commands import Commands
from retwin.cli.options import (
    CaseOption,
    Json,
    LogMapping,
    MaxBytes,
    Measured,
    Probabilities,
    Seed,
    argument,
    leave_out,
    option,
)
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

TEXTS = ("trajectory", "diagnosis", "label", "commands", "reason", "guard")
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
    case: CaseOption = None,
    rate: Annotated[float | None, option("HZ", "Sample rate of a classifier's features.")] = None,
    random_onset: Annotated[
        bool, option("", "With --from: infer the onset of stuck motors.", "--random-onset")
    ] = False,
    seed: Seed = 0,
    mapping: LogMapping = None,
    max_bytes: MaxBytes = None,
) -> None:
    """Train a diagnoser on labelled trajectories, or derive one from a corrected twin."""
    parts = ("model.json", "weights.safetensors", "surrogate", "residual", "twin")
    check_place(out, folder=True, holds=parts)
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
        diagnoser = rt.fit_diagnoser(
            training,
            classifier,
            seed=seed,
            classes=None if system is None else system.classes,
            rate=rate,
            progress=lambda share: show("classifier", share),
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
    file: Measured,
    case: CaseOption = None,
    out: Probabilities = None,
    max_faults: Annotated[
        int, option("N", "2 also tries pairs of stuck actuators.", "--max-faults")
    ] = 1,
    mapping: LogMapping = None,
    max_bytes: MaxBytes = None,
    as_json: Json = False,
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
            tuple(made.columns),
            [[_shown(each[name]) for name in made.columns.values()] for each in made.rows],
            numbers=[head for head in made.columns if head not in TEXTS],
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
    columns : dict of str to str
        Names of those that the table shows, by their heads.
    written : sequence of str
        Names of those that the CSV file has beside the probabilities.
    scores : Scores or None
        If all labels are known.
    remark : str
        What the answer "unknown" rests on.

    """

    classes: Sequence[str]
    rows: list[dict[str, Any]]
    columns: dict[str, str]
    written: Sequence[str]
    scores: Scores | None = None
    remark: str = ""


def _by_bundle(bundle: Bundle | Portable, trajectories: Trajectories) -> Diagnosed:
    """Diagnoses of a bundle, with the verdicts of its guard."""
    found = bundle.predict(trajectories)
    rows = _diagnoses(trajectories, found.classes, found.probabilities, found.diagnosis)
    verdicts = zip(found.verdicts.verdict.tolist(), found.verdicts.reason.tolist(), strict=True)
    for each, (verdict, reason) in zip(rows, verdicts, strict=True):
        each |= {"guard": verdict, "reason": reason}
    written = ("diagnosis", "guard", "reason")
    columns = {"trajectory": "id", **{n: n for n in ("diagnosis", "probability", *written[1:])}}
    return Diagnosed(found.classes, rows, columns, written)


def _by_diagnoser(diagnoser: Diagnoser, trajectories: Trajectories, max_faults: int) -> Diagnosed:
    """Diagnoses of a diagnoser of any kind."""
    from retwin.diagnosis import conclude
    from retwin.evaluation.diagnosers import check_probabilities, scored

    with bar("diagnose") as show:
        concluded = conclude(
            diagnoser,
            trajectories,
            max_faults=max_faults,
            progress=lambda share: show("faults", share),
        )
    probabilities, severities = concluded.probabilities, _severities(concluded)
    check_probabilities(trajectories, probabilities)
    labels = trajectories.labels.tolist()
    labelled = bool(trajectories.known_labels) and "" not in labels
    classes = diagnoser.classes
    rows = _diagnoses(trajectories, classes, probabilities, concluded.labels)
    outside = _outside(diagnoser, trajectories).tolist()
    rest = zip(labels, outside, severities, concluded.reason.tolist(), strict=True)
    for each, (label, beyond, own, reason) in zip(rows, rest, strict=True):
        each["reason"] = reason
        each["label"] = label or None
        each["commands"] = "outside" if beyond else "ok"
        each |= own
    more = ["commands"] * any(outside) + ["reason"] * any(each["reason"] for each in rows)
    shown = ("diagnosis", "probability", *severities[0], "label", *more)
    return Diagnosed(
        classes,
        rows,
        {"trajectory": "id", **{name: name for name in shown}},
        ["diagnosis", "reason", *["unknown"] * (concluded.found is not None)],
        scored(trajectories, probabilities, classes) if labelled else None,
        concluded.remark,
    )


def _severities(concluded: Conclusion) -> list[dict[str, float | None]]:
    """What an inversion gives besides for the most probable class of each trajectory."""
    from retwin.diagnosis import Diagnosis, StateDiagnosis

    found, count = concluded.found, len(concluded.labels)
    if found is None:
        return [{} for _ in range(count)]
    columns = {"unknown": found.unknown}
    if isinstance(found, Diagnosis) and found.several.any():
        columns["several"] = found.several
    if isinstance(found, StateDiagnosis):
        own = (np.arange(count), found.probabilities.argmax(axis=1))
        columns |= {"size": found.size.value[own], "onset in s": found.onset.value[own]}
    return [
        {name: None if np.isnan(each[i]) else float(each[i]) for name, each in columns.items()}
        for i in range(count)
    ]


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
    trajectories: Trajectories, classes: Sequence[str], probabilities: NDArray, labels: NDArray
) -> list[dict[str, Any]]:
    """The diagnosis of each trajectory, and the probability of every class.

    A trajectory with a probability that is not finite has None for each probability.
    """
    made = []
    rows = zip(trajectories.ids.tolist(), labels.tolist(), probabilities, strict=True)
    for name, label, row in rows:
        finite = bool(np.isfinite(row).all())
        values = row.tolist() if finite else [None] * len(classes)
        made.append(
            {
                "id": name,
                "diagnosis": label,
                "probability": float(row.max()) if finite else None,
                "probabilities": dict(zip(classes, values, strict=True)),
            }
        )
    return made


def _write_probabilities(out: Path, made: Diagnosed) -> None:
    """Write a CSV file: the trajectory, what `made.written` names, and all probabilities."""
    with write_atomically(out) as part, part.open("w", newline="", encoding="utf-8") as sheet:
        writer = csv.writer(sheet)
        writer.writerow(["trajectory", *made.written, *made.classes])
        for each in made.rows:
            values = [each[name] for name in made.written]
            writer.writerow([each["id"], *values, *each["probabilities"].values()])
    note(f"Wrote {out}")
