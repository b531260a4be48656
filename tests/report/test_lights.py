"""The section of decisions, the lights, and what the twin is ready for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.report.lights import lights, uses, worst
from retwin.report.page import render
from retwin.report.sections import sections_of
from retwin.report.sections.decisions import decisions
from retwin.report.study import read_study
from retwin.report.summary import learned, summary
from retwin.report.verdict import headline
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
    row = next(row for row in table.rows if row[0].text == "20 %")
    texts = [f"{cell.text} {cell.below}".strip() for cell in row[1:8]]
    assert entry["decisions"][1]["texts"] == texts
    first = whole.probabilities("ibg_rg")[0]
    exact = decide(first, whole.truth, whole.results.classes, 0.2)
    assert entry["decisions"][1]["detected"] == exact.detected


def test_the_section_states_how_many_it_takes(study: Study, write: Write) -> None:
    section = decisions(read_study(write(study)))
    assert section is not None
    rows = section.values["table"].rows
    assert [row[0].text for row in rows] == ["10 %", "20 %", "30 %"], "what ten can promise"
    thresholds = [row[1].text for row in rows]
    assert len(set(thresholds)) == 3, "digits tell thresholds apart"
    assert (section.values["lowest"], section.values["needed"]) == (0.05, 19)
    assert section.scripts["calculator"]["healthy"] == 10
    study[0]["classes"] = study[0]["data"]["test"]["labels"] = []
    for source in study[0]["sources"].values():
        del source["confusion"]
    for name in list(study[1]):
        if name.startswith(("probabilities", "portrait")):
            del study[1][name]
    assert decisions(read_study(write(study))) is None


def with_errors(study: Study, before: float, after: float, spread: float) -> None:
    """Healthy trajectories whose errors are these in mm, with factors around 1 of that spread."""
    _, arrays = study
    rng = np.random.default_rng(1)
    observed = arrays["portrait/nominal"] + before / 1000 * np.exp(
        spread * rng.standard_normal((90, 1, 1))
    )
    arrays["portrait/observed"] = observed.astype(np.float32)
    median = observed - after / 1000 * np.exp(spread * rng.standard_normal((90, 1, 1)))
    offsets = np.array([-2e-4, -1e-4, 0, 1e-4, 2e-4])[:, None, None]
    arrays["portrait/bands"] = (median[:, None] + offsets).astype(np.float32)


@pytest.mark.parametrize(
    ("before", "after", "spread", "state"),
    [(10, 5, 0.1, "met"), (10, 9.5, 0.5, "undecided"), (5, 10, 0.1, "not met")],
)
def test_the_error_before_and_after_in_the_machine_s_unit(
    study: Study, write: Write, before: float, after: float, spread: float, state: str
) -> None:
    with_errors(study, before, after, spread)
    light = lights(read_study(write(study)))[0]
    assert (light.key, light.state) == ("error", state)
    change = light.values["change"]
    assert light.values["unit"] == "mm"
    assert change.trajectories == 10, "the healthy ones"
    if spread < 0.2:
        assert change.before == pytest.approx(before, rel=0.1)
        assert change.after == pytest.approx(after, rel=0.1)


@pytest.mark.parametrize(
    ("covered", "auroc", "state"),
    [
        ((0.9, 0.87, 0.93), (0.6, 0.5, 0.7), "met"),
        ((0.9, 0.84, 0.96), (0.6, 0.5, 0.7), "undecided"),
        ((0.9, 0.87, 0.93), (1.0, 1.0, 1.0), "not met"),
        ((0.5, 0.4, 0.6), (0.6, 0.5, 0.7), "not met"),
    ],
)
def test_realism_is_the_worst_of_its_parts(
    study: Study,
    write: Write,
    covered: tuple[float, float, float],
    auroc: tuple[float, float, float],
    state: str,
) -> None:
    figures = study[0]["fidelity"]["ibg_rg"]["figures"]
    for name, (value, low, high) in (("coverage90", covered), ("auroc", auroc)):
        figures[name] = {"value": value, "interval": [low, high]}
    found = {each.key: each for each in lights(read_study(write(study)))}
    assert found["realism"].state == state


def test_generated_noise_that_is_missing_is_named(
    study: Study, write: Write, rendered: Callable[[Path], str]
) -> None:
    study[1]["z/ibg_rg/predicted"][:, 4] = 0.0
    folder = write(study)
    found = {each.key: each for each in lights(read_study(folder))}
    assert found["realism"].values["noiseless"] == ["x"]
    assert "next to no noise at rest in x" in rendered(folder)


def test_few_healthy_trajectories_promise_no_rate(
    study: Study, write: Write, rendered: Callable[[Path], str]
) -> None:
    """Ten promise 10 % on average only; 36 make it certain, since 0.9^36 is below 2.5 %."""
    folder = write(study)
    found = {each.key: each for each in lights(read_study(folder))}
    chosen = found["false_alarms"].values["alarms"]
    assert (chosen.rate, chosen.healthy, chosen.needed) == (0.1, 10, 36)
    assert found["false_alarms"].state == "undecided"
    page = rendered(folder)
    assert "with 10 healthy runs the rate is not certain" in page
    assert "Record at least 36 healthy runs (10 now)" in page
    assert "5\u00a0% cannot be promised by fewer than 19 healthy runs" in page


def test_a_plain_twin_that_finds_more_makes_detection_fail(study: Study, write: Write) -> None:
    """The same threshold rule for both: what the page states cannot contradict its calculator."""
    _, arrays = study
    truth = np.repeat(np.arange(9), 10)
    for name, right in (("dt", 1.0), ("ibg_rg", 0.3)):
        drawn = np.random.default_rng(0).random((10, 90, 9)) * 1e-3
        drawn[:, :, 0] += 1.0
        drawn[:, truth > 0, 0] -= np.arange(80) % 10 < 10 * right
        arrays[f"probabilities/{name}"] = drawn / drawn.sum(axis=2, keepdims=True)
    whole = read_study(write(study))
    found = lights(whole)
    detection = next(each for each in found if each.key == "detection")
    difference, ends = detection.values["rival"]["difference"]
    assert difference == pytest.approx(0.3 - 1.0, abs=0.15)
    assert ends[1] < 0
    assert detection.state == "not met"
    states = {each.key: each.state for each in uses(whole, found)}
    assert states["training"] == states["alarms"] == "not met"


def test_no_use_is_better_than_its_worst_light(study: Study, write: Write) -> None:
    with_errors(study, 10, 5, 0.1)
    whole = read_study(write(study))
    found = lights(whole)
    for use in uses(whole, found):
        assert use.state == worst(use.conditions.values())
    assert worst(["met", "not met", "undecided"]) == "not met"
    assert worst([]) == "not measured"


def test_few_training_runs_leave_training_data_undecided(single: Study, write: Write) -> None:
    with_errors(single, 10, 5, 0.1)
    whole = read_study(write(single))
    training = next(each for each in uses(whole, lights(whole)) if each.key == "training")
    assert training.conditions["error"] == "met"
    assert training.conditions["gain"] == "undecided"


def test_the_next_steps_follow_from_what_is_missing(single: Study, write: Write) -> None:
    """What is undecided or worse has a step; what is decided has none."""
    with_errors(single, 10, 9.5, 0.5)
    found = summary(read_study(write(single)))
    assert found is not None
    steps = {each.key: each.values for each in found["steps"]}
    assert {"record", "repeat"} <= set(steps)
    assert (steps["record"]["alarms"], steps["record"]["now"]) == (36, 10)
    assert "correction" not in steps
    with_errors(single, 5, 10, 0.1)
    found = summary(read_study(write(single)))
    assert found is not None
    steps = {each.key: each.values for each in found["steps"]}
    assert steps["correction"]["worse"]
    assert steps["record"]["error"] is None, "more trajectories would not change it"


def test_a_test_set_without_healthy_runs_asks_for_some(study: Study, write: Write) -> None:
    test = study[0]["data"]["test"]
    test["labels"] = ["Motor_1_Stuck" if each == "Healthy" else each for each in test["labels"]]
    whole = read_study(write(study))
    assert not whole.healthy.any()
    states = {each.key: each.state for each in lights(whole)}
    assert states["error"] == states["false_alarms"] == "not measured"
    found = summary(whole)
    assert found is not None
    assert {each.key: each.values for each in found["steps"]}["record"]["now"] == 0
    page = render(whole, sections_of(whole), {})
    assert "Test on healthy runs too: there are none now" in page


def test_what_was_not_measured_is_not_met(study: Study, write: Write) -> None:
    study[0]["fidelity"] = {}
    del study[0]["portrait"]
    found = {each.key: each.state for each in lights(read_study(write(study)))}
    assert found["error"] == found["realism"] == "not measured"


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


def test_what_was_learned_is_in_the_machine_s_units(study: Study, write: Write) -> None:
    """Delays in ms, offsets in deg, noise in mm, with intervals over trajectories."""
    _, arrays = study
    rng = np.random.default_rng(0)
    arrays["portrait/z"] = np.stack(
        [rng.normal(46, 2, (90, 2)), rng.normal(5, 0.5, (90, 2))], axis=2
    ).astype(np.float32)
    arrays["z/ibg_rg/trajectory"] = np.repeat(np.arange(10), 24)
    table = learned(read_study(write(study)))
    assert table is not None
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in table.rows}
    assert list(rows)[:2] == ["Delay", "Offset, motor 1"]
    offset = rows["Offset, motor 1"]
    assert offset[0].endswith(" deg")
    assert float(offset[0].split()[0]) == pytest.approx(0.24 * 5, rel=0.1), "10 healthy ones"
    low, high = (float(end) for end in offset[1].removesuffix(" deg").split(" to "))
    assert low < 0.24 * 5 < high
    noise = rows["Noise at rest, x"]
    assert all(text.endswith(" mm") for text in noise[:3])
    assert noise[-1] == "240"


def test_an_index_of_trajectories_that_does_not_fit_is_refused(study: Study, write: Write) -> None:
    study[1]["z/ibg_rg/trajectory"] = np.zeros(3)
    with pytest.raises(InputError, match=r"^z/ibg_rg/trajectory: expected"):
        read_study(write(study))
