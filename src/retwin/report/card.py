"""The model card: scope, known failures, data, versions, and the command that makes it again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from urllib.parse import quote

from retwin.report.blocks import (
    Block,
    Cell,
    Column,
    Command,
    Facts,
    Fold,
    Link,
    Prose,
    Section,
    Table,
)
from retwin.report.confusion import recalls
from retwin.report.explorer import explorable
from retwin.report.parts import Channels, Dataset
from retwin.report.plots import caption, latent_names
from retwin.report.results import Results
from retwin.report.verdict import headline
from retwin.report.words import (
    class_name,
    counted,
    in_sentence,
    number,
    quantity,
    real_data,
    source_name,
)

__all__ = ["card"]

SEEN_ALIKE = 0.05
"""p below or at which what was generated differs from what was observed."""
POOR = 0.5
"""Recall below which a class counts as not recognised."""


def card(results: Results) -> Section:
    """Of the updated twin where there is one, else of the source that scores first."""
    source = _subject(results)
    blocks: list[Block] = [
        Facts("Scope", _scope(results, source)),
        Prose(_limits(results, source)),
        _failures(results, source),
    ]
    data = _data_table(results)
    if data is not None:
        blocks.append(data)
    used, tested = results.data.calibration.used, results.data.test.ids
    if used:
        blocks.append(Fold(f"{counted(len(used), 'calibration trajectory')} used", used))
    if tested:
        blocks.append(Fold(counted(len(tested), "test trajectory"), tested))
    blocks.append(Facts("Versions and seeds", _setup(results)))
    if command := results.provenance.get("command"):
        blocks.append(Command("This command makes the same study again", str(command)))
    return Section("card", "Model card", blocks)


def _subject(results: Results) -> str:
    pair = headline(results.comparisons)
    return pair[0] if pair else next(iter(results.sources))


def _scope(results: Results, source: str) -> list[tuple[str, str]]:
    word = "emulated" if results.emulated else "real"
    calibration = results.data.calibration
    used = calibration.n if calibration.used is None else len(calibration.used)
    told = [
        ("system", results.title or results.case),
        ("updated twin", source_name(source)),
        (f"{word} data it saw", real_data(results.sources[source].real_data)),
        ("commands", _channels(results.inputs)),
        ("outputs", _channels(results.outputs)),
        ("classes", ", ".join(map(class_name, results.classes))),
        ("calibrated on", counted(used, f"{word} trajectory") if used else ""),
        ("tested on", _tested(results)),
        ("a trajectory", _moments(results)),
    ]
    return [(term, text) for term, text in told if text]


def _tested(results: Results) -> str:
    test = results.data.test
    labels = Counter(class_name(label) for label in test.labels if results.classes)
    whole = counted(test.n, "trajectory") if test.n else ""
    return ", ".join(f"{count} {label}" for label, count in labels.items()) or whole


def _channels(channels: Channels) -> str:
    units = [*channels.units, *[""] * len(channels.names)]
    told = (
        f"{name} ({quantity(unit)[1]})" if unit not in ("", "1") else name
        for name, unit in zip(channels.names, units, strict=False)
    )
    return ", ".join(told)


def _moments(results: Results) -> str:
    """How long a trajectory is, and how often it was measured."""
    bands, rate = (results.arrays.get(f"portrait/{name}") for name in ("bands", "rate"))
    if bands is None or rate is None:
        return ""
    return f"{bands.shape[2] / float(rate):.0f} s at {float(rate):g} Hz"


def _limits(results: Results, source: str) -> str:
    """What the page does not speak for."""
    text = (
        "It speaks for the machine, the days and the loads of these measurements and for commands "
        "like theirs. Wear, other loads and temperatures are in it only if they are in the data."
    )
    if results.classes:
        text += " A fault that is none of the classes is given the name of one of them."
    if results.sources[source].fault_protocol_known:
        text += (
            " The training faults follow the published onset and sizes, which would not be known "
            "in the field."
        )
    if results.emulated:
        text += " All measurements are emulated: it says nothing about a real machine."
    return text


def _failures(results: Results, source: str) -> Block:
    """What went wrong on this very test set, so that nobody has to find it out again."""
    rows = [*_wrong(results, source), *_unlike(results, source), *_notes(results, source)]
    name = source_name(source)
    if not rows:
        return Prose(f"No failure of {in_sentence(name)} is known from this test set.")
    columns = [Column("Failure", numeric=False), Column("Where", numeric=False)]
    text = (
        f"What is known to go wrong with {in_sentence(name)}, on the test set above"
        + (
            ": wrong answers of the mean over runs, by what was and what was answered."
            if results.classes
            else "."
        )
        + " What this test set does not hold may go wrong as well."
    )
    return Table("Known failures", caption(results, text), columns, rows)


def _wrong(results: Results, source: str) -> list[list[Cell]]:
    """False alarms first, then faults that are missed or taken for others; then poor classes."""
    if source not in results.answered:
        return []
    truth = results.truth.tolist()
    answers = results.probabilities(source).mean(axis=0).argmax(axis=1).tolist()
    wrong: dict[tuple[int, int], list[str]] = {}
    for name, true, said in zip(results.data.test.ids, truth, answers, strict=False):
        if true != said:
            wrong.setdefault((true, said), []).append(name)
    short = [class_name(name) for name in results.classes]
    rows = [
        [Cell(f"{short[true]} taken for {short[said]}"), _trajectories(results, names)]
        for (true, said), names in sorted(wrong.items())
    ]
    counts = results.sources[source].confusion or []
    return rows + [
        [Cell(f"{short[k]} recognised in {shares[k]:.0%} of answers"), Cell("over all runs")]
        for k, shares in enumerate(recalls(counts) if counts else [])
        if sum(counts[k]) and shares[k] < POOR
    ]


def _trajectories(results: Results, names: Sequence[str]) -> Cell:
    """By name; each leads to itself in the explorer, where there is one."""
    if not explorable(results):
        return Cell(", ".join(names))
    return Cell("", links=[Link(name, f"trajectory={quote(name, safe='')}") for name in names])


def _unlike(results: Results, source: str) -> list[list[Cell]]:
    """What is generated unlike what was observed, as far as tests can tell."""
    told = results.fidelity.get(source)
    return [
        [
            Cell(f"{latent_names(name)[0]} is not generated as it was observed"),
            Cell(f"KS distance {number(each.value, 2)}, p {number(each.p, 2)}"),
        ]
        for name, each in (told.agreement if told else {}).items()
        if each.p is not None and each.p <= SEEN_ALIKE
    ]


def _notes(results: Results, source: str) -> list[list[Cell]]:
    return [[Cell(note), Cell("while it was made")] for note in results.sources[source].notes]


def _setup(results: Results) -> list[tuple[str, str]]:
    told = {key: value for key, value in results.provenance.items() if key != "command"}
    setup = {"preset": results.preset, "classifier": results.classifier, "runs": results.runs}
    return [
        (key.replace("_", " "), str(value))
        for key, value in {**setup, **told}.items()
        if value not in (None, "")
    ]


def _data_table(results: Results) -> Table | None:
    told = results.data
    roles = (
        ("Twin", told.twin),
        ("Calibration", told.calibration),
        ("Test", told.test),
    )
    rows = [_data_row(role, each) for role, each in roles if each.n is not None or each.sha256]
    if not rows:
        return None
    columns = [
        Column("Role", numeric=False),
        Column("File", numeric=False),
        Column("Trajectories"),
        Column("used"),
        Column("SHA-256", numeric=False),
    ]
    text = "The data, known by their SHA-256."
    if told.protocol:
        text += f" Protocol: {told.protocol.rstrip('.')}."
    return Table("Data", caption(results, text), columns, rows)


def _data_row(role: str, each: Dataset) -> list[Cell]:
    return [
        Cell(role),
        Cell(each.name or "–"),
        Cell("–" if each.n is None else str(each.n)),
        Cell("all" if each.used is None else str(len(each.used))),
        Cell(each.sha256 or "–", tone="code"),
    ]
