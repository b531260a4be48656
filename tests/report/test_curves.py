"""ROC, reliability, movements and bins against slow or known answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from numpy.typing import NDArray
from scipy.stats import binom
from sklearn.metrics import roc_auc_score, roc_curve

from retwin.report.blocks import Plot
from retwin.report.curves import bands, latents
from retwin.report.movement import movement
from retwin.report.reliability import ece_floor, reliabilities
from retwin.report.results import Results
from retwin.report.roc import micro_roc
from retwin.report.sections import SECTIONS

Study = tuple[dict[str, Any], dict[str, NDArray]]


def results_of(study: Study) -> Results:
    return Results.model_validate({**study[0], "arrays": study[1]})


def test_micro_roc_is_scikit_learns(study: Study) -> None:
    results = results_of(study)
    probabilities = results.probabilities("dt")
    positive = np.eye(9)[results.truth].ravel()
    found = micro_roc(probabilities, results.truth)
    wanted = [roc_auc_score(positive, run.ravel()) for run in probabilities]
    np.testing.assert_allclose(found.areas, wanted, atol=1e-9)
    false, true, _ = roc_curve(positive, probabilities[0].ravel(), drop_intermediate=False)
    one = micro_roc(probabilities[:1], results.truth)
    middle = one.rate[1:-1]
    upper = np.array([true[false == each].max() for each in np.unique(false)])
    wanted = np.interp(middle, np.unique(false), upper)
    np.testing.assert_allclose(one.mean[1:-1], wanted, atol=1e-9)


def test_micro_roc_of_perfect_and_constant_answers() -> None:
    truth = np.array([0, 1, 2, 0, 1, 2])
    perfect = micro_roc(np.eye(3)[truth][None], truth)
    assert perfect.areas == pytest.approx([1.0])
    assert np.all(perfect.mean == 1)
    constant = micro_roc(np.full((2, 6, 3), 1 / 3), truth)
    assert constant.areas == pytest.approx([0.5, 0.5])
    np.testing.assert_allclose(constant.mean, constant.rate)


def test_ece_floor_falls_with_the_root_of_the_count() -> None:
    few, many = (np.full((1, count, 2), [0.8, 0.2]) for count in (100, 10_000))
    # Ten bins of n / 10 answers, each right with chance 0.8: E|mean - 0.8|.
    wanted = np.sqrt(2 / np.pi * 0.8 * 0.2 / 1000)
    assert ece_floor(many) == pytest.approx(wanted, rel=0.1)
    assert ece_floor(few) / ece_floor(many) == pytest.approx(10, rel=0.15)
    assert ece_floor(np.eye(2)[None]) == 0


def test_reliability_of_a_calibrated_classifier_lies_within_its_bars(study: Study) -> None:
    """Sure by 0.9 and right in nine of ten; then with half of the right answers made wrong."""
    truth = results_of(study).truth
    place = np.arange(90)
    for wrong, calibrated in ((place % 10 == 0, True), (place % 10 % 2 == 0, False)):
        answers = np.full((2, 90, 9), 0.1 / 8)
        answers[:, place, np.where(wrong, (truth + 1) % 9, truth)] = 0.9
        study[1]["probabilities/dt"] = answers
        found = reliabilities(results_of(study))["dt"]
        assert len(found.confidence) == 10
        np.testing.assert_allclose(found.confidence, 0.9)
        assert found.right.mean() == pytest.approx(1 - wrong.mean())
        kept = (found.low <= found.right) & (found.right <= found.high)
        assert kept.all() == calibrated


def test_bars_are_the_binomial_law_however_many_runs(study: Study) -> None:
    """Nine answers to a bin, each right with chance 0.8, and the same nine in every run."""
    answers = np.full((3, 90, 9), 0.2 / 8)
    answers[..., 0] = 0.8
    study[1]["probabilities/dt"] = answers
    found = reliabilities(results_of(study))["dt"]
    wanted = binom.ppf([0.05, 0.95], 9, 0.8) / 9
    np.testing.assert_allclose(np.median([found.low, found.high], axis=1), wanted)


def test_a_movement_is_late_and_off_by_what_was_put_in(study: Study) -> None:
    """Two ramps of 100 mm in 0.6 s, of which the measured second one is 80 ms late and 5 mm off."""
    time = np.arange(21) / 10
    arrays = study[1]
    nominal, observed = (np.zeros((90, 21, 3)) for _ in range(2))
    nominal[..., 1] = np.interp(time, [0.1, 0.7, 1.0, 1.6], [0, 0.1, 0.1, 0.2])
    observed[..., 1] = np.interp(time, [0.1, 0.7, 1.08, 1.68], [0, 0.1, 0.1, 0.205])
    arrays |= {"portrait/nominal": nominal, "portrait/observed": observed}
    arrays["portrait/times"] = np.tile([[0.1, 0.7, 1.0], [1.0, 1.7, 2.0]], (90, 1, 1))
    found = movement(results_of(study))
    assert found is not None
    assert (found.output, found.unit, found.window) == ("y", "mm", (1.0, 2.0))
    assert found.delay == pytest.approx(0.08, abs=0.01)
    assert found.offset == pytest.approx(5)
    assert found.half[0][1] == pytest.approx(150)
    assert found.words == ("TDe 80 ms", "TPE 5.0 mm")


def test_no_movement_without_one_that_was_measured(study: Study) -> None:
    study[1]["portrait/observed"][:, 3] = np.nan
    assert movement(results_of(study)) is None


def test_latents_count_what_lies_outside(study: Study) -> None:
    delay, x, *_ = latents(results_of(study), "ibg_rg")
    assert (delay.counts, delay.outside) == ((200, 4000), (9, 0))
    assert delay.observed.sum() == pytest.approx(191 / 200)
    assert x.unit == "mm"
    assert x.edges[-1] < 50  # the outliers at 200 mm do not stretch it
    assert x.edges[-1] > 8


@pytest.mark.parametrize("values", [[1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0, 5.0]])
def test_latents_of_few_or_equal_values(study: Study, values: list[float]) -> None:
    study[1]["z/ibg_rg/observed"] = np.repeat(np.array(values)[:, None], 7, axis=1)
    for latent in latents(results_of(study), "ibg_rg"):
        assert np.all(np.diff(latent.edges) > 0)
        assert latent.outside[0] < latent.counts[0]


def test_bands_are_what_was_measured_minus_the_nominal_output(study: Study) -> None:
    found = bands(results_of(study), "ibg_rg")
    assert [(each.trajectory, each.output) for each in found] == [
        (trajectory, output) for trajectory in ("real_a/000", "real_a/001") for output in "xyz"
    ]
    last = found[-1]
    assert (last.unit, last.time[-1]) == ("mm", pytest.approx(1.9))
    assert np.isfinite(last.observed).sum() == 15
    np.testing.assert_allclose(last.quantiles[:, 0], 4 * np.array([-1.64, -0.67, 0, 0.67, 1.64]))
    del study[1]["bands/ibg_rg/seen"]
    assert bands(results_of(study), "ibg_rg") == []


def test_plots_are_valid_for_plotly(study: Study) -> None:
    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {key: plain(each) for key, each in value.items()}
        if isinstance(value, list):
            return [plain(each) for each in value]
        return "#123456" if isinstance(value, str) and value.startswith("@") else value

    results = results_of(study)
    sections = [section for make in SECTIONS if (section := make(results)) is not None]
    assert len(sections) == len(SECTIONS) - 1, "all but that of a case without classes"
    plots = [b for section in sections for b in section.blocks if isinstance(b, Plot)]
    assert [plot.name for plot in plots] == [
        "scores",
        "roc",
        "reliability",
        "movement",
        "tde",
        "tpe",
        "noise",
        "pit",
        "bands",
        "learning",
    ]
    for plot in plots:
        for panel in plot.panels:
            assert go.Figure(plain(panel.spec)).data
