"""The first screen: four uses, one rule, the same on the page, the terminal and in the file."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from synthetic_study import Study, synthetic

from retwin.report.study import read_study
from retwin.report.uses import use_rows
from retwin.results import Results, read_results
from retwin.scores.uses import Requirement, answer_of, uses_of

Write = Callable[[Study], Path]


def decided(healthy: int, alarms: int, named: float) -> Study:
    """A study whose updated twin calls so many healthy runs faulty and names a share of faults.

    The original twin calls all healthy runs faulty.
    """
    results, arrays = synthetic(runs=5, per_class=healthy)
    truth = np.repeat(np.arange(9), healthy)
    for name in ("dt", "ibg", "ibg_rg"):
        diagnosis = truth.copy()
        bad = int(healthy if name != "ibg_rg" else alarms)
        diagnosis[:bad] = 5
        wrong = np.flatnonzero(truth > 0)[:: max(1, round(1 / (1 - named)))] if named < 1 else []
        diagnosis[wrong] = 1 + truth[wrong] % 8
        sure = np.full((5, len(truth), 9), 0.01)
        sure[:, np.arange(len(truth)), diagnosis] = 0.92
        arrays[f"probabilities/{name}"] = sure
    results["sources"]["ibg_rg"]["macro_f1"] = [0.9] * 5
    return results, arrays


@pytest.mark.parametrize(
    ("study", "answer", "missing"),
    [
        (decided(130, 0, 1.0), "yes", None),
        (decided(130, 60, 1.0), "no", "source"),
        (decided(130, 0, 0.5), "no", "source"),
        (decided(60, 0, 1.0), "cannot say", "healthy"),
        (decided(10, 0, 1.0), "cannot say", "healthy"),
    ],
    ids=["good", "false alarms", "wrong names", "still too few", "undecidable"],
)
def test_what_a_reader_decides_on_diagnosis(
    study: Study, answer: str, missing: str | None, write: Write
) -> None:
    use = read_study(write(study)).results.uses[2]
    assert (use.use, use.answer, use.source) == ("diagnose", answer, "ibg_rg")
    assert (use.missing and use.missing.what) == missing
    assert use.figures["called"].plain == 1.0


def test_few_healthy_runs_are_said_to_be_too_few(study: Study, write: Write) -> None:
    """72 healthy runs without a false alarm are needed, since 0.95^72 is below 2.5 %."""
    rows = {row.title: row for row in use_rows(read_study(write(study)).results)}
    assert rows["Monitor"].answer == "cannot say"
    assert rows["Monitor"].missing == "62 more healthy runs"
    assert "10 healthy runs are too few to show that at most 5 %" in rows["Monitor"].reached
    assert "called faulty: 3 of 10; original twin 8 of 10." in rows["Diagnose"].reached


def test_a_study_without_an_updated_twin_lacks_one(study: Study, write: Write) -> None:
    results, arrays = study
    results["portrait"] = None
    use = read_study(write((results, arrays))).results.uses[0]
    assert (use.answer, use.missing and use.missing.what) == ("cannot say", "updated")


def test_a_study_without_classes_says_nothing_of_faults(write: Write) -> None:
    content = json.loads((Path(__file__).parent / "schema_1" / "plant.json").read_text("utf-8"))
    found = {use.use: use for use in read_study(write((content, {}))).results.uses}
    assert list(found) == ["simulate", "training", "diagnose", "monitor"]
    for name in ("diagnose", "monitor"):
        assert found[name].answer in ("cannot say", "no")
        missing = found[name].missing
        assert missing is not None
        assert missing.what == "faults"


def test_page_terminal_and_file_agree(
    study: Study, write: Write, rendered: Callable[[Path], str]
) -> None:
    """What the file states is what is computed from it, and what the page shows."""
    from retwin.cli.studies import _uses

    folder = write(study)
    whole = read_study(folder)
    again = Results.model_validate_json(whole.results.to_json())
    assert again.uses == whole.results.uses or str(again.uses) == str(whole.results.uses)
    assert str(uses_of(whole.results, whole.arrays)) == str(whole.results.uses)
    assert read_results(folder).uses == [], "a file of a version before opens"
    page, table = rendered(folder), _uses(whole.results)
    text = re.sub("</?code>", "", page.replace("\u00a0", " "))
    for index, row in enumerate(use_rows(whole.results)):
        cells = " ".join(str(list(column.cells)[index]) for column in table.columns)
        for each in (
            row.title,
            row.required,
            row.answer,
            row.scope,
            row.source,
            row.reached,
            row.missing,
        ):
            assert each in cells
        assert f"<b>{row.answer}</b>" in text
        assert row.missing.replace("\u00a0", " ") in text


@pytest.mark.parametrize(
    ("value", "interval", "informative", "answer"),
    [
        (0.02, (0.0, 0.04), True, "yes"),
        (0.02, (0.0, 0.08), True, "likely"),
        (0.0, (0.0, 0.3), False, "cannot say"),
        (0.06, (0.01, 0.2), True, "cannot say"),
        (0.5, (0.3, 0.7), True, "no"),
        (math.nan, None, True, "cannot say"),
    ],
)
def test_one_rule(
    value: float, interval: tuple[float, float] | None, informative: bool, answer: str
) -> None:
    asked = Requirement(value, interval, 0.0, 0.05, informative)
    assert answer_of(asked) == answer
