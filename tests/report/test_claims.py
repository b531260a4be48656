"""The section of decisions, and the lights of what is claimed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from numpy.typing import NDArray

from retwin.report.sections.decisions import decisions
from retwin.report.study import read_study
from retwin.report.verdict import claims, headline
from retwin.results import Results
from retwin.scores.decisions import decide

Study = tuple[dict[str, Any], dict[str, NDArray]]
Write = Callable[[Study], Path]


def test_what_the_calculator_looks_up_equals_the_table(study: Study, write: Write) -> None:
    """Every rate that ten healthy trajectories can tell apart, so 20 % is as two of eleven."""
    whole = read_study(write(study))
    section = decisions(whole)
    assert section is not None
    table, calculator = section.values["table"], section.scripts["calculator"]
    entry = calculator["sources"][calculator["first"]]
    assert entry["name"] == "Updated twin (outputs)"
    assert [round(11 * each["rate"]) for each in entry["decisions"]] == list(range(1, 11))
    row = next(row for row in table.rows if row[0].text == "20%")
    texts = [f"{cell.text} {cell.below}".strip() for cell in row[1:8]]
    assert entry["decisions"][1]["texts"] == texts
    first = whole.probabilities("ibg_rg")[0]
    exact = decide(first, whole.truth, whole.results.classes, 0.2)
    assert entry["decisions"][1]["detected"] == exact.detected


def test_the_section_states_how_many_it_takes(study: Study, write: Write) -> None:
    section = decisions(read_study(write(study)))
    assert section is not None
    assert [row[0].text for row in section.values["table"].rows] == [
        "1%",
        "2%",
        "5%",
        "10%",
        "20%",
        "30%",
    ]
    assert (section.values["lowest"], section.values["needed"]) == (0.05, 19)
    assert section.scripts["calculator"]["healthy"] == 10
    study[0]["classes"] = study[0]["data"]["test"]["labels"] = []
    for source in study[0]["sources"].values():
        del source["confusion"]
    for name in list(study[1]):
        if name.startswith(("probabilities", "portrait")):
            del study[1][name]
    assert decisions(read_study(write(study))) is None


@pytest.mark.parametrize(
    ("interval", "covered", "recall", "seconds", "lights"),
    [
        ([0.01, 0.2], 0.9, 0.95, 60.0, ["holds", "holds", "holds", "holds"]),
        ([-0.01, 0.2], 0.80, 0.80, 1200.0, ["open", "open", "open", "open"]),
        ([-0.2, -0.1], 0.5, 0.5, 7200.0, ["fails", "fails", "fails", "fails"]),
    ],
)
def test_lights_follow_their_rules(
    study: Study,
    write: Write,
    interval: list[float],
    covered: float,
    recall: float,
    seconds: float,
    lights: list[str],
) -> None:
    results = study[0]
    for each in results["comparisons"]:
        each["bootstrap_ci95"] = interval
    source = results["sources"]["ibg_rg"]
    source["healthy_recall"] = [recall] * 10
    source["intervals"]["healthy_recall"] = [recall - 0.11, recall + 0.11]
    source["update_s"] = seconds
    figures = results["fidelity"]["ibg_rg"]["figures"]
    figures["coverage90"] = {"value": covered, "interval": [covered - 0.06, covered + 0.06]}
    found = claims(read_study(write(study)))
    assert [each.title for each in found] == ["Accuracy", "Calibration", "False alarms", "Time"]
    assert [each.light for each in found] == lights


def test_what_was_not_measured_is_not_claimed(study: Study, write: Write) -> None:
    study[0]["fidelity"] = {}
    for each in study[0]["comparisons"]:
        each["bootstrap_ci95"] = None
    found = claims(read_study(write(study)))
    assert [each.title for each in found] == ["False alarms", "Time"]


def test_the_headline_is_the_last_updated_source_and_the_plain_one() -> None:
    def of(*pairs: tuple[str, str]) -> tuple[str, str] | None:
        rows = [{"a": a, "b": b, "metric": "macro_f1", "mean_diff": 0.1} for a, b in pairs]
        sources = {name: {} for name in ("dt", *(each for pair in pairs for each in pair))}
        content = {"schema": 1, "case": "a", "runs": 1, "sources": sources, "comparisons": rows}
        return headline(Results.model_validate(content))

    updated = ("dt", "ibg_rg_command")
    assert of(("ibg", "dt"), ("ibg_rg", "dt"), updated) == ("ibg_rg_command", "dt")
    assert of(("ibg_rg", "twin"), ("ibg_rg_command", "ibg")) == ("ibg_rg", "twin")
    assert of(("mine", "yours"), ("mine", "theirs")) == ("mine", "yours")
    assert of() is None
