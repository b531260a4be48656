"""Thresholds that keep the rate of false alarms, and the lights of what is claimed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from retwin.report.claims import claims
from retwin.report.decisions import decide, decisions
from retwin.report.results import read_results

Study = tuple[dict[str, Any], dict[str, NDArray]]
Write = Callable[[Study], Path]
CLASSES = ["Healthy", "stuck", "bias"]


def test_the_rate_of_false_alarms_is_kept_on_average() -> None:
    rng = np.random.default_rng(0)
    rates = []
    for _ in range(400):
        alarm = rng.beta(1, 4, size=20)
        probabilities = np.stack([1 - alarm, alarm, 0 * alarm], axis=1)
        probabilities = np.concatenate([probabilities, [[0.1, 0.9, 0.0]]])
        truth = np.array([0] * 20 + [1])
        found = decide(probabilities, truth, CLASSES, 0.1)
        rates.append((rng.beta(1, 4, size=1000) > found.threshold).mean())
    assert np.mean(rates) == pytest.approx(0.1, abs=0.01)


def test_what_is_detected_missed_and_confused() -> None:
    healthy = np.tile([0.9, 0.05, 0.05], (9, 1))
    stuck = np.array([[0.1, 0.8, 0.1]] * 3 + [[0.1, 0.2, 0.7]])
    bias = np.array([[0.1, 0.2, 0.7], [0.95, 0.0, 0.05]])
    truth = np.repeat([0, 1, 2], [9, 4, 2])
    found = decide(np.concatenate([healthy, stuck, bias]), truth, CLASSES, 0.1)
    assert found.threshold == pytest.approx(0.1)
    assert found.detected == pytest.approx(5 / 6)
    assert found.interval[0] < 5 / 6 < found.interval[1]
    assert found.named == pytest.approx(4 / 5)
    assert (found.missed, found.confused) == ("bias", ("stuck", "bias"))


def test_few_healthy_trajectories_promise_nothing() -> None:
    probabilities = np.array([[0.9, 0.1, 0.0]] * 8 + [[0.0, 1.0, 0.0]])
    truth = np.array([0] * 8 + [1])
    assert np.isnan(decide(probabilities, truth, CLASSES, 0.1).threshold)
    assert np.isfinite(decide(probabilities, truth, CLASSES, 0.12).threshold)


def test_what_the_calculator_looks_up_is_what_the_table_says(study: Study, write: Write) -> None:
    """Every rate that ten healthy trajectories can tell apart, so 20 % is as two of eleven."""
    results = read_results(write(study))
    section = decisions(results)
    assert section is not None
    table, _, calculator = section.blocks
    told = calculator.content["sources"][calculator.content["first"]]
    assert told["name"] == "IBG + RG"
    assert [round(11 * each["rate"]) for each in told["decisions"]] == list(range(1, 11))
    row = next(row for row in table.rows if row[0].text == "20%")
    words = [f"{cell.text} {cell.below}".strip() for cell in row[1:6]]
    assert told["decisions"][1]["words"] == words
    shares = results.probabilities("ibg_rg").mean(axis=0)
    exact = decide(shares, results.truth, results.classes, 0.2)
    assert told["decisions"][1]["detected"] == exact.detected


def test_the_section_says_how_many_it_takes(study: Study, write: Write) -> None:
    section = decisions(read_results(write(study)))
    assert section is not None
    table, note, calculator = section.blocks
    assert [row[0].text for row in table.rows] == ["1%", "2%", "5%", "10%", "20%", "30%"]
    assert "5% takes 19 of them at least" in note.text
    assert calculator.content["healthy"] == 10
    study[0]["classes"] = study[0]["data"]["test"]["labels"] = []
    for source in study[0]["sources"].values():
        del source["confusion"]
    for name in list(study[1]):
        if name.startswith(("probabilities", "portrait")):
            del study[1][name]
    assert decisions(read_results(write(study))) is None


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
    told = results["fidelity"]["ibg_rg"]["figures"]
    told["coverage90"] = {"value": covered, "interval": [covered - 0.06, covered + 0.06]}
    found = claims(read_results(write(study)))
    assert [each.title for each in found] == ["Accuracy", "Calibration", "False alarms", "Time"]
    assert [each.light for each in found] == lights


def test_what_was_not_measured_is_not_claimed(study: Study, write: Write) -> None:
    study[0]["fidelity"] = {}
    for each in study[0]["comparisons"]:
        each["bootstrap_ci95"] = None
    found = claims(read_results(write(study)))
    assert [each.title for each in found] == ["False alarms", "Time"]
