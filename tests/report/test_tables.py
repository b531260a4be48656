"""Tables without empty parts, terms with their explanation, and digits that tell values apart."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import retwin as rt
from retwin.data.quality.finding import Finding
from retwin.evaluation.choice.fitted import CandidateScore
from retwin.report.blocks import Cell, Column, Table
from retwin.report.choice import comparison_table
from retwin.report.labels import distinct, learned_name, percent, percents
from retwin.report.page import DOCS, explained
from retwin.report.records import finding_rows


def test_differences_have_the_digits_of_the_score_and_shares_the_order_of_the_outputs() -> None:
    shares = {"speed": 0.9, "bearing": 0.84}
    score = CandidateScore("none", "as is", shares, 1.0, 0.0097, 6e-7, 5e-7, shares, 1.0)
    outputs = rt.Channels(("speed", "bearing"), ("rpm", "degC"))
    records = SimpleNamespace(outputs=outputs)
    found = SimpleNamespace(scores=[score], parts=("a",), chosen="none", records=records)
    ((*_, behind, hold, _),) = comparison_table(found).rows  # type: ignore[arg-type]
    assert (behind.text, behind.below) == ("0.00000", "± 0.00000")
    assert (hold.text, hold.below) == ("87%", "(90%, 84%)")


def test_columns_and_rows_of_dashes_are_not_drawn() -> None:
    columns = [Column("Source"), Column("a"), Column("p"), Column("b")]
    rows = [
        [Cell("head")],
        [Cell("one"), Cell("1"), Cell("–"), Cell("2")],
        [Cell("two"), Cell("–"), Cell("–"), Cell("")],
        [Cell("three"), Cell("–"), Cell(""), Cell("3")],
    ]
    found = Table("A table", columns, rows).without_empty()
    assert [column.text for column in found.columns] == ["Source", "a", "b"]
    assert [row[0].text for row in found.rows] == ["head", "one", "three"]
    assert [cell.text for cell in found.rows[2]] == ["three", "–", "3"]


def test_a_term_is_explained_where_it_first_occurs_and_only_in_text() -> None:
    found = explained('<h3>AUROC</h3><p title="AUROC">AUROC, ROC and AUROC<code>ECE</code></p>')
    assert found.count("<abbr") == 2
    assert found.startswith('<h3>AUROC</h3><p title="AUROC"><abbr title="area under the ROC curve')
    assert found.endswith("and AUROC<code>ECE</code></p>")
    assert explained("<p>Macro-F1</p>").endswith(">Macro-F1</abbr></p>")
    assert explained("<p>heroclike</p>") == "<p>heroclike</p>"


def test_digits_tell_thresholds_apart() -> None:
    assert distinct([0.1, 0.2]) == 3
    assert distinct([0.99991, 0.99992, 0.5]) == 5
    assert distinct([0.5, 0.5]) == 3
    assert distinct([1 - 1e-12, 1 - 2e-12]) == 9


def test_percent_is_100_only_where_it_is() -> None:
    assert (percent(1.0), percent(0.999), percent(0.0004), percent(0.0)) == (
        "100 %",
        "99.9 %",
        "0.04 %",
        "0 %",
    )
    assert percents((0.58, 0.914)) == "58 to 91 %"
    assert percent(float("nan")) == percents(None) == "–"


def test_names_for_people() -> None:
    assert learned_name("offset_motor_1") == "Offset, motor 1"
    assert learned_name("missed_motor_2") == "Missed segments, motor 2"
    assert learned_name("delay") == "Delay"


def test_every_section_links_to_a_heading_of_the_documentation(
    study: Any, write: Callable[[Any], Path], rendered: Callable[[Path], str]
) -> None:
    document = (Path(__file__).parents[2] / "docs" / "report.md").read_text("utf-8")
    headings = re.findall(r"^## (.*)$", document, flags=re.MULTILINE)
    anchors = {heading.lower().replace(" ", "-") for heading in headings}
    linked = re.findall(rf'href="{re.escape(DOCS)}#([^"]*)"', rendered(write(study)))
    assert len(linked) > 10
    assert set(linked) <= anchors


def test_many_findings_of_a_kind_are_a_row() -> None:
    def found(record: int, channel: str) -> Finding:
        return Finding(f"r{record}", channel, "frozen", f"stays at {record}", 1.0, 2.0, "remark")

    many, few = [found(i, "x") for i in range(5)], [found(i, "y") for i in range(2)]
    rows = finding_rows([*many, *few])
    assert rows[0] == ("r0, r1, r2, r3, r4", "x", "", "frozen: for instance stays at 0")
    assert rows[1:] == [each.row for each in few]
    every = [found(i, f"c{i}") for i in range(43)]
    assert finding_rows(every)[40:] == [("and 3 more", "", "", "")]
