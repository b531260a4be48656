"""The model card: scope, known failures, data, versions, and the command that repeats the study."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any
from urllib.parse import quote

from retwin.report.blocks import Cell, Link, Section, Table, tabulate, text_column
from retwin.report.labels import class_name, counted, latent_names, quantity, real_data, source_name
from retwin.report.study import Study
from retwin.report.verdict import headline
from retwin.results import ChannelNames, Dataset, FidelityFigure, Results
from retwin.scores.classification import row_shares


def card(study: Study) -> Section:
    """Of the headline's updated twin, else of the first source."""
    results = study.results
    pair = headline(results)
    source = pair[0] if pair else next(iter(results.sources))
    each = results.sources[source]
    values: dict[str, Any] = {
        "source": source,
        "scope": _scope(study, source),
        "protocol_known": each.fault_protocol_known,
        "confused": _confused(study, source),
        "missed": _missed(study, source),
        "unlike": unlike(study, source),
        "compared": bool(results.classes) or source in results.fidelity,
        "notes": _notes(results),
        "data": _data(study),
        "protocol": results.data.protocol.rstrip("."),
        "setup": _setup(study),
        "command": results.provenance.get("command"),
    }
    return Section("card", "Model card", values)


def unlike(study: Study, source: str) -> list[tuple[str, FidelityFigure]]:
    """The components of z whose generated and observed values differ, with their KS distance."""
    fidelity = study.results.fidelity.get(source)
    # The p-value at or below which generated and observed values count as different.
    return [
        (latent_names(name)[0], figure)
        for name, figure in (fidelity.agreement if fidelity else {}).items()
        if figure.p is not None and figure.p <= 0.05
    ]


def _notes(results: Results) -> dict[str, str]:
    """What was reported while sources were computed, and the names of these sources."""
    notes: dict[str, list[str]] = {}
    for source, each in results.sources.items():
        for note in each.notes:
            notes.setdefault(note, []).append(source_name(source))
    return {note: "; ".join(names) for note, names in notes.items()}


def _scope(study: Study, source: str) -> dict[str, str]:
    results, word = study.results, study.word
    calibration, test = results.data.calibration, results.data.test
    used = calibration.n if calibration.used is None else len(calibration.used)
    counts = Counter(class_name(label) for label in test.labels if results.classes)
    tested = ", ".join(f"{count} {label}" for label, count in counts.items())
    untested = results.classes if set(results.classes) - set(test.labels) else ()
    facts = {
        "system": results.title or results.case,
        "updated twin": source_name(source),
        f"{word} data used": real_data(
            results.sources[source].real_data, classes=bool(results.classes)
        ),
        "commands": _channels(results.inputs),
        "outputs": _channels(results.outputs),
        "classes": ", ".join(map(class_name, untested)),
        "calibrated on": counted(used, f"{word} trajectory") if used else "",
        "tested on": tested or (counted(test.n, "trajectory") if test.n else ""),
        "trajectory length": _length(study),
    }
    return {term: text for term, text in facts.items() if text}


def _channels(channels: ChannelNames) -> str:
    units = [*channels.units, *[""] * len(channels.names)]
    return ", ".join(
        f"{name} ({quantity(unit)[1]})" if unit not in ("", "1") else name
        for name, unit in zip(channels.names, units, strict=False)
    )


def _length(study: Study) -> str:
    """The duration of a trajectory, and the sample rate of its measurement."""
    bands, rate = (study.arrays.get(f"portrait/{name}") for name in ("bands", "rate"))
    if bands is None or rate is None:
        return ""
    seconds, measured = bands.shape[2] / float(rate), study.results.data.test.rate
    if measured is None or measured == float(rate):
        return f"{seconds:.0f} s" + (f" at {measured:g} Hz" if measured else "")
    return f"{seconds:.0f} s at {measured:g} Hz; bands and plots at {float(rate):g} Hz"


def _confused(study: Study, source: str) -> list[tuple[str, str, Cell]]:
    """True class, diagnosis, and the trajectories that the mean over runs diagnoses so.

    False alarms stand first, then faults that are missed or confused.
    """
    if source not in study.diagnosing:
        return []
    diagnoses = study.probabilities(source).mean(axis=0).argmax(axis=1).tolist()
    wrong: dict[tuple[int, int], list[str]] = {}
    ids = study.results.data.test.ids
    for name, true, diagnosis in zip(ids, study.truth.tolist(), diagnoses, strict=False):
        if true != diagnosis:
            wrong.setdefault((true, diagnosis), []).append(name)
    names = [class_name(name) for name in study.results.classes]
    return [
        (names[true], names[diagnosis], _trajectories(study, found))
        for (true, diagnosis), found in sorted(wrong.items())
    ]


def _missed(study: Study, source: str, *, poor: float = 0.5) -> list[tuple[str, float]]:
    """The classes with a poor recall over all runs.

    Parameters
    ----------
    poor : float, default 0.5
        The recall below which a class counts as not recognised.

    """
    counts = study.results.sources[source].confusion
    if counts is None or source not in study.diagnosing:
        return []
    recalls = row_shares(counts).diagonal().tolist()
    return [
        (class_name(name), recall)
        for name, row, recall in zip(study.results.classes, counts, recalls, strict=True)
        if sum(row) and recall < poor
    ]


def _trajectories(study: Study, names: Sequence[str], *, named: int = 5) -> Cell:
    """Their ids, as links to the explorer where it shows them; of many the number of the rest.

    Parameters
    ----------
    named : int, default 5
        Trajectories of one kind of wrong diagnosis that are named, at most.

    """
    ids = study.results.data.test.ids
    shown = {ids[place] for place in study.results.overlaid} if study.explorable else set()
    links = [
        Link(n, f"trajectory={quote(n, safe='')}" if n in shown else "") for n in names[:named]
    ]
    more = len(names) - named
    return Cell("", links=[*links, *([Link(f"and {more} more", "")] if more > 0 else [])])


def _setup(study: Study) -> dict[str, str]:
    results = study.results
    setup = {"preset": results.preset, "classifier": results.classifier, "runs": results.runs}
    facts = {**setup, **results.provenance}
    return {
        key.replace("_", " "): _readable(key, str(value))
        for key, value in facts.items()
        if key != "command" and value not in (None, "")
    }


def _readable(key: str, text: str) -> str:
    """A time stamp to the minute, the name of a classifier in capitals, and others as they are."""
    if key == "classifier":
        return text.upper()
    stamp = re.fullmatch(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d):[\d.]+\+00:00", text)
    return f"{stamp[1]} {stamp[2]} UTC" if stamp else text


def _data(study: Study) -> Table | None:
    data = study.results.data
    roles = {"Twin": data.twin, "Calibration": data.calibration, "Test": data.test}
    rows = [
        _data_row(role, each) for role, each in roles.items() if each.n is not None or each.sha256
    ]
    heads = ["Role", text_column("File"), "Trajectories", "used", text_column("SHA-256")]
    return tabulate("Data", heads, rows) if rows else None


def _data_row(role: str, each: Dataset) -> list[object]:
    count = "–" if each.n is None else str(each.n)
    used = "all" if each.used is None else str(len(each.used))
    return [role, each.name or "–", count, used, Cell(each.sha256 or "–", tone="code")]
