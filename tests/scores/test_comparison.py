"""Welch's test, Holm's adjustment, and what intervals show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retwin.scores.comparison import compare_runs, holm, no_verdict, outcome

pytestmark = pytest.mark.numerical


def test_welch_reproduces_the_paper_s_table() -> None:
    """Table 1, macro-F1: 0.753 ± 0.026 against 0.644 ± 0.036 over 10 runs."""
    rng = np.random.default_rng(0)

    def runs(mean: float, deviation: float) -> list[float]:
        x = rng.normal(size=10)
        return (mean + deviation * (x - x.mean()) / x.std(ddof=1)).tolist()

    got = compare_runs(runs(0.753, 0.026), runs(0.644, 0.036))
    assert got["mean_diff"] == pytest.approx(0.109)
    # The table's means and deviations are rounded, its t and df are not.
    assert got["t"] == pytest.approx(7.860, abs=0.15)
    assert got["df"] == pytest.approx(16.55, abs=0.4)


def test_one_run_has_no_welch() -> None:
    assert compare_runs([0.5], [0.4]) == {
        "mean_diff": pytest.approx(0.1),
        "t": None,
        "df": None,
        "p": None,
    }


@pytest.mark.slow
@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
@settings(max_examples=25, deadline=None)
def test_holm_is_statsmodels_s(p: list[float]) -> None:
    from statsmodels.stats.multitest import multipletests  # here, since it takes seconds

    np.testing.assert_allclose(holm(p), multipletests(p, method="holm")[1], atol=1e-12)


def test_better_needs_an_interval_without_zero_and_a_small_p_over_all_pairs() -> None:
    intervals = ((0.1, 0.2), (-0.1, 0.2), (-0.2, -0.1), None)
    assert [outcome(each, 0.01, 1) for each in intervals] == ["better", "open", "worse", ""]
    assert outcome((0.1, 0.2), 0.06, 1) == "open"
    assert outcome((0.1, 0.2), None, 1) == "", "a pair without a verdict"
    assert outcome((0.1, 0.2), 0.01, -1) == "worse"
    assert outcome((0.1, 0.2), 0.01, 0) == ""


@pytest.mark.parametrize(
    ("runs", "records", "kinds", "reason"),
    [
        (5, None, ("healthy", "none"), ""),
        (4, None, ("healthy", "none"), "few runs"),
        (5, 8, ("healthy", "timing"), ""),
        (5, 7, ("healthy", "timing"), "few records"),
        (5, None, ("transductive", "unlabelled"), "different data"),
        (5, None, ("labelled", "transductive"), "different data"),
        (5, None, ("labelled", "labelled"), ""),
    ],
)
def test_which_pairs_get_a_verdict(
    runs: int, records: int | None, kinds: tuple[str, str], reason: str
) -> None:
    assert no_verdict(runs=runs, records=records, real_data=kinds) == reason
