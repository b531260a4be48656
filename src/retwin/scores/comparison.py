"""Whether one source is better than another: Welch's test, Holm's adjustment, intervals.

Welch's test over runs measures the randomness of training only. A statement that one source is
better rests on the paired bootstrap interval over test trajectories (`retwin.scores.bootstrap`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

__all__ = ["compare_runs", "compliance", "holm", "outcome"]


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


def outcome(interval: tuple[float, float] | None, better: int) -> str:
    """What the interval of a difference shows.

    Parameters
    ----------
    interval : (float, float)
        Lower and upper end; None if there is none.
    better : int
        1 if larger values are better, -1 if smaller ones are, 0 for a target to be met.

    Returns
    -------
    str
        "better" or "worse" if the interval excludes 0, "open" if it includes 0, "" if there is no
        interval or no direction.

    """
    if interval is None or better == 0:
        return ""
    if interval[0] <= 0 <= interval[1]:
        return "open"
    return "better" if (interval[0] > 0) == (better > 0) else "worse"


def compliance(
    value: float, interval: tuple[float, float] | None, low: float, high: float = np.inf
) -> str:
    """Whether a value lies in its required range.

    Parameters
    ----------
    value : float
        The value, finite.
    interval : (float, float)
        Its confidence interval; None if there is none.
    low, high : float
        The ends of the required range.

    Returns
    -------
    str
        "holds" if the value lies in the range, "open" if only a part of its interval does, else
        "fails".

    """
    if low <= value <= high:
        return "holds"
    overlaps = interval is not None and interval[0] <= high and interval[1] >= low
    return "open" if overlaps else "fails"
