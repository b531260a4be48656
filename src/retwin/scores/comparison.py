"""Whether one source is better than another: Welch's test, Holm's adjustment, intervals.

Welch's test over runs measures the randomness of training only. A verdict that one source is
better rests on paired bootstrap draws over test trajectories and runs (`retwin.scores.bootstrap`),
adjusted over all pairs, and on the conditions of `no_verdict`.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from retwin.scores.bootstrap import MIN_RECORDS

MIN_RUNS = 5
"""Least number of runs for a verdict: fewer do not show the randomness of training."""
SIGNIFICANCE = 0.05
"""Adjusted p-value up to which a difference is decided."""
LIKE_ONLY = ("transductive", "labelled")
"""Real data whose use makes a source comparable only with sources that use the same."""


def compare_runs(a: Sequence[float], b: Sequence[float]) -> dict[str, float | None]:
    """Welch's t-test of the hypothesis that two sources have the same mean over runs.

    Parameters
    ----------
    a, b : sequence of float
        The values of one metric over runs.

    Returns
    -------
    dict
        `mean_diff`, the mean of `a` minus that of `b`; `t`, `df` and the two-sided `p`, None where
        a source has fewer than two runs or no run differs from another.

    """
    from scipy.stats import ttest_ind

    difference = float(np.mean(a) - np.mean(b))
    spread = np.std(a) + np.std(b)
    if min(len(a), len(b)) < 2 or spread == 0:
        return {"mean_diff": difference, "t": None, "df": None, "p": None}
    with warnings.catch_warnings():
        # With few trajectories a score has few values, so that runs may be equal.
        warnings.filterwarnings("ignore", message="Precision loss occurred")
        test = ttest_ind(a, b, equal_var=False)
    return {
        "mean_diff": difference,
        "t": float(test.statistic),
        "df": float(test.df),
        "p": float(test.pvalue),
    }


def holm(p: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment for several tests.

    Parameters
    ----------
    p : sequence of float
        The p-values of a family of tests, in [0, 1].

    Returns
    -------
    list of float
        Adjusted p-values in the same order.

    References
    ----------
    Holm, A simple sequentially rejective multiple test procedure, 1979.

    """
    values = np.asarray(p, dtype=float)
    order = np.argsort(values)
    factors = len(values) - np.arange(len(values))
    adjusted = np.minimum(1.0, np.maximum.accumulate(factors * values[order]))
    out = np.empty_like(adjusted)
    out[order] = adjusted
    return out.tolist()


def alike(*real_data: str | None) -> bool:
    """Whether sources that see these real data may be compared: like with like only."""
    return len({kind if kind in LIKE_ONLY else "" for kind in real_data}) == 1


def no_verdict(*, runs: int, records: int | None, real_data: Sequence[str]) -> str:
    """Why a pair of sources gets no verdict.

    Parameters
    ----------
    runs : int
        Runs of each source.
    records : int, optional
        Test records of a study without classes; None for a study with classes.
    real_data : sequence of str
        The real data that each of the two sees, see `retwin.catalog.SourceEntry`.

    Returns
    -------
    str
        "different data", "few records", "few runs", or "" for a pair that gets a verdict.

    """
    if not alike(*real_data):
        return "different data"
    if records is not None and records < MIN_RECORDS:
        return "few records"
    return "few runs" if runs < MIN_RUNS else ""


def outcome(interval: tuple[float, float] | None, p: float | None, better: int) -> str:
    """What the draws of a difference show.

    Parameters
    ----------
    interval : (float, float)
        The 95 % interval of the difference; None if there is none.
    p : float
        The p-value of no difference, adjusted over all pairs; None for a pair without a verdict.
    better : int
        1 if larger values are better, -1 if smaller ones are, 0 for a target to be met.

    Returns
    -------
    str
        "better" or "worse" if the interval excludes 0 and `p` is at most 0.05, else "open"; "" if
        there is no interval, no verdict or no direction.

    """
    if interval is None or p is None or better == 0:
        return ""
    if p > SIGNIFICANCE or interval[0] <= 0 <= interval[1]:
        return "open"
    return "better" if (interval[0] > 0) == (better > 0) else "worse"
