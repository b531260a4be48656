"""`retwin diagnose`: train a diagnoser or derive one from a corrected twin, and use it."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from retwin import catalog
from retwin.checks import require
from retwin.cli.completion import one_of
from retwin.cli.options import CaseOption, Json, MaxBytes, Measured, Probabilities, Real, Seed
from retwin.cli.reading import case_named, data_case, read, saved
from retwin.cli.terminal import answer, bar, example, note, table
from retwin.data.trajectories import Trajectories
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place

__all__ = ["EMULATED", "app", "diagnoses", "write_probabilities"]

EMULATED = "These trajectories are EMULATED: no real measurements."

app = typer.Typer(
    help="Train a diagnoser, and use it.",
    epilog=example("retwin diagnose predict cnn real.mat --case armpi"),
    no_args_is_help=True,
)

Out = Annotated[Path, typer.Option(metavar="FOLDER", help="Where to save the diagnoser.")]


@app.command(epilog=example("retwin diagnose fit made.npz --classifier cnn --out cnn"))
def fit(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Labelled trajectories.")],
    out: Out,
    classifier: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="cnn, lstm or rocket.", autocompletion=one_of(catalog.CLASSIFIERS)
        ),
    ] = "cnn",
    case: CaseOption = None,
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Sample rate of the features.")
    ] = None,
    seed: Seed = 0,
    max_bytes: MaxBytes = None,
) -> None:
    """Train a diagnoser on labelled trajectories."""
    import retwin as rt

    check_place(out, folder=True, holds=("model.json", "weights.safetensors"))
    system = case_named(case)
    chosen = catalog.make(catalog.CLASSIFIERS, classifier, "classifier")
    training = read(file, system, max_bytes=max_bytes)
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
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="A corrected twin, in command space.")
    ],
    real: Real,
    out: Out,
    random_onset: Annotated[
        bool,
        typer.Option("--random-onset", metavar="", help="Infer the onset of stuck motors."),
    ] = False,
    max_bytes: MaxBytes = None,
) -> None:
    """Derive a diagnoser from a corrected twin; only healthy trajectories are used."""
    import retwin as rt

    parts = ("model.json", "weights.safetensors", "surrogate", "residual")
    check_place(out, folder=True, holds=parts)
    updated = rt.CorrectedTwin.load(saved(model))
    system = rt.cases.get(updated.case)
    if random_onset:
        system = system.with_random_onset()
    calibration = read(real, system, max_bytes=max_bytes)
    diagnoser = rt.fit_inversion(
        updated.surrogate, updated.residual, calibration, system.faults, twin=system.twin
    )
    diagnoser.save(out)
    note(f"Saved {out}")


@app.command(epilog=example("retwin diagnose predict cnn real.mat --case armpi"))
def predict(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Folder of a diagnoser.")],
    file: Measured,
    case: CaseOption = None,
    out: Probabilities = None,
    max_bytes: MaxBytes = None,
    as_json: Json = False,
) -> None:
    """Diagnose trajectories, and score the diagnoses if the labels are known."""
    import retwin as rt
    from retwin.update.training_range import outside_training

    if out is not None:
        check_place(out)
    diagnoser = rt.load_diagnoser(saved(model))
    trajectories = read(file, data_case(case), max_bytes=max_bytes)
    probabilities = diagnoser.predict_proba(trajectories)
    _check_finite(trajectories, probabilities)
    labels = trajectories.labels.tolist()
    labelled = bool(trajectories.known_labels) and "" not in labels
    scores = rt.evaluate(diagnoser, trajectories) if labelled else None
    diagnosed = diagnoses(trajectories, diagnoser.classes, probabilities)
    outside = outside_training(getattr(diagnoser, "surrogate", None), trajectories).tolist()
    for each, label, beyond in zip(diagnosed, labels, outside, strict=True):
        each["label"] = label or None
        each["commands"] = "outside" if beyond else "ok"
    shown = ("trajectory", "diagnosis", "probability", "label", *["commands"] * any(outside))
    rows = [
        (e["id"], e["diagnosis"], f"{e['probability']:.2f}", e["label"] or "", e["commands"])
        for e in diagnosed
    ]
    answer(
        {"emulated": trajectories.emulated, "trajectories": diagnosed, "scores": scores},
        table(shown, [row[: len(shown)] for row in rows], numbers=("probability",)),
        *([EMULATED] if trajectories.emulated else []),
        *([str(scores)] if scores is not None else []),
        as_json=as_json,
    )
    if out is not None:
        write_probabilities(out, diagnoser.classes, diagnosed)


def diagnoses(
    trajectories: Trajectories, classes: Sequence[str], probabilities: NDArray
) -> list[dict[str, Any]]:
    """The most probable class of each trajectory, and the probability of every class.

    A trajectory with a probability that is not finite has no class, and None for each probability.
    """
    made = []
    for name, row in zip(trajectories.ids.tolist(), probabilities, strict=True):
        finite = bool(np.isfinite(row).all())
        values = row.tolist() if finite else [None] * len(classes)
        made.append(
            {
                "id": name,
                "diagnosis": classes[row.argmax()] if finite else "",
                "probability": float(row.max()) if finite else None,
                "probabilities": dict(zip(classes, values, strict=True)),
            }
        )
    return made


def _check_finite(trajectories: Trajectories, probabilities: NDArray) -> None:
    """Raise InputError with the trajectories that have a probability that is not finite."""
    bad = trajectories.ids[~np.isfinite(probabilities).all(axis=1)].tolist()
    more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
    require(
        not bad,
        "probabilities",
        expected="finite probabilities from the diagnoser",
        got=f"NaN for {', '.join(bad[:5])}{more}",
        remedy="replace sentinel values in these trajectories by NaN, or train the diagnoser anew "
        "if it gives NaN for others too",
    )


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
