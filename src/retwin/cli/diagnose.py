"""`retwin diagnose`: train a diagnoser or derive one from a corrected twin, and use it."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from retwin import catalog
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
    option,
)
from retwin.cli.reading import case_named, data_case, read, saved, updated_twin
from retwin.cli.terminal import answer, bar, example, note, table
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place

if TYPE_CHECKING:  # printing help needs no torch, which takes seconds to import
    from retwin.diagnosis import Conclusion, Diagnoser

EMULATED = "These trajectories are EMULATED: no real measurements."

app = Commands(
    help="Train a diagnoser, and use it.",
    epilog=example("retwin diagnose predict cnn real.mat --case armpi"),
)

Out = Annotated[Path, option("FOLDER", "Where to save the diagnoser.")]


@app.command(epilog=example("retwin diagnose fit made.npz --classifier cnn --out cnn"))
def fit(
    file: Annotated[Path, argument("FILE", "Labelled trajectories.")],
    out: Out,
    classifier: Annotated[
        str, option("NAME", "cnn, lstm or rocket.", names=catalog.CLASSIFIERS)
    ] = "cnn",
    case: CaseOption = None,
    rate: Annotated[float | None, option("HZ", "Sample rate of the features.")] = None,
    seed: Seed = 0,
    mapping: LogMapping = None,
    max_bytes: MaxBytes = None,
) -> None:
    """Train a diagnoser on labelled trajectories."""
    import retwin as rt

    check_place(out, folder=True, holds=("model.json", "weights.safetensors"))
    system = case_named(case)
    chosen = catalog.make(catalog.CLASSIFIERS, classifier, "classifier")
    training = read(file, system, max_bytes=max_bytes, mapping=mapping)
    with bar("train") as show:
        diagnoser = rt.fit_diagnoser(
            training,
            chosen,
            seed=seed,
            classes=None if system is None else system.classes,
            rate=rate,
            progress=lambda share: show(classifier, share),
        )
    diagnoser.save(out)
    assert diagnoser.fitted is not None
    accuracy = diagnoser.fitted.figures["accuracy"]
    answer(None, f"Accuracy on the held-out fifth of {file.name}: {accuracy:.3f}")
    note(f"Saved {out}")


@app.command(epilog=example("retwin diagnose invert model real.mat --out physics"))
def invert(
    model: Annotated[Path, argument("MODEL", "A corrected twin, in command space or of dynamics.")],
    out: Out,
    real: Annotated[
        Path | None, argument("[REAL]", "What it was calibrated on; corrected dynamics need none.")
    ] = None,
    random_onset: Annotated[
        bool, option("", "Infer the onset of stuck motors.", "--random-onset")
    ] = False,
    mapping: LogMapping = None,
    max_bytes: MaxBytes = None,
) -> None:
    """Derive a diagnoser from a corrected twin; only healthy trajectories are used."""
    import retwin as rt
    from retwin.update import DynamicsTwin

    parts = ("model.json", "weights.safetensors", "surrogate", "residual", "twin")
    check_place(out, folder=True, holds=parts)
    updated = updated_twin(model)
    system = rt.cases.get(updated.case)
    if random_onset:
        system = system.with_random_onset()
    if isinstance(updated, DynamicsTwin):
        rt.fit_inversion(updated, None, None, system.faults).save(out)
    elif real is None:
        raise InputError(
            "real",
            expected="the trajectories on which the twin was calibrated",
            got="nothing",
            remedy="give their file after the model",
        )
    else:
        calibration = read(real, system, max_bytes=max_bytes, mapping=mapping)
        rt.fit_inversion(
            updated.surrogate, updated.residual, calibration, system.faults, twin=system.twin
        ).save(out)
    note(f"Saved {out}")


@app.command(epilog=example("retwin diagnose predict cnn real.mat --case armpi"))
def predict(
    model: Annotated[Path, argument("MODEL", "Folder of a diagnoser.")],
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
    """Diagnose trajectories, and score the diagnoses if the labels are known."""
    import retwin as rt
    from retwin.diagnosis import conclude
    from retwin.evaluation.diagnosers import check_probabilities, scored

    if out is not None:
        check_place(out)
    diagnoser = rt.load_diagnoser(saved(model))
    trajectories = read(file, data_case(case), max_bytes=max_bytes, mapping=mapping)
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
    scores = scored(trajectories, probabilities, classes) if labelled else None
    diagnosed = diagnoses(trajectories, classes, probabilities, concluded.labels)
    outside = _outside(diagnoser, trajectories).tolist()
    rest = zip(labels, outside, severities, concluded.reason.tolist(), strict=True)
    for each, (label, beyond, own, reason) in zip(diagnosed, rest, strict=True):
        each["reason"] = reason
        each["label"] = label or None
        each["commands"] = "outside" if beyond else "ok"
        each |= own
    columns = {"trajectory": "id", "diagnosis": "diagnosis", "probability": "probability"}
    more = ["commands"] * any(outside) + ["reason"] * any(each["reason"] for each in diagnosed)
    columns |= {name: name for name in (*severities[0], "label", *more)}
    rows = [[_shown(each[name]) for name in columns.values()] for each in diagnosed]
    numbers = ("probability", *severities[0])
    answer(
        {
            "emulated": trajectories.emulated,
            "remark": concluded.remark,
            "trajectories": diagnosed,
            "scores": scores,
        },
        table(tuple(columns), rows, numbers=numbers),
        *([EMULATED] if trajectories.emulated else []),
        *([str(scores)] if scores is not None else []),
        as_json=as_json,
    )
    note(concluded.remark)
    if out is not None:
        more = ["diagnosis", "reason", *["unknown"] * (concluded.found is not None)]
        write_probabilities(out, classes, diagnosed, more)


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


def diagnoses(
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


def write_probabilities(
    out: Path,
    classes: Sequence[str],
    diagnosed: Iterable[Mapping[str, Any]],
    columns: Sequence[str] = (),
) -> None:
    """Write a CSV file: the trajectory, more `columns`, and the probability of every class."""
    with write_atomically(out) as part, part.open("w", newline="", encoding="utf-8") as sheet:
        writer = csv.writer(sheet)
        writer.writerow(["trajectory", *columns, *classes])
        for each in diagnosed:
            values = [each[name] for name in columns]
            writer.writerow([each["id"], *values, *each["probabilities"].values()])
    note(f"Wrote {out}")
