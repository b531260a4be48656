"""Whether a new version of a twin is better than the active one, and keeps the promise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import require
from retwin.monitor.detect.promise import SIGNIFICANCE, FalseAlarmTest
from retwin.scores.bootstrap import BLOCKS, MIN_RECORDS, bootstrap_means

MIN_SAMPLES = 10 * BLOCKS
"""Samples of a record at least, so that a block of the bootstrap has ten."""


@dataclass(frozen=True)
class Decision:
    """A comparison of a new version with the active one.

    Attributes
    ----------
    old_crps, new_crps : float
        Mean CRPS on the same samples.
    difference : float
        Old minus new: positive where the new one is better.
    low, high : float
        The 95 % interval of the difference.
    false_alarms : FalseAlarmTest
        The test of the new version.
    reference : FalseAlarmTest or None
        That of the first active version, which is never changed, on the same samples: alarms of it
        show a slow change of the machine that the versions since have learned. None where it was
        not tested, or is itself one of the two.

    """

    old_crps: float
    new_crps: float
    difference: float
    low: float
    high: float
    false_alarms: FalseAlarmTest
    reference: FalseAlarmTest | None = None

    @property
    def better(self) -> bool:
        """Whether the interval is above 0 and the new version's alarms are as promised."""
        return self.low > 0 and self.false_alarms.passed

    @property
    def summary(self) -> str:
        """Both numbers, the difference with its interval and the false alarms; and the reference's
        alarms, if it raised any.
        """
        test, first = self.false_alarms, self.reference
        slow = ""
        if first is not None and first.alarms:
            slow = (
                f"; {first.alarms} alarms of the first active version in the same {first.unit}: "
                "the machine differs from the one that it was calibrated on, check whether that is "
                "a fault that grows slowly"
            )
        return (
            f"CRPS {self.old_crps:.4g} - {self.new_crps:.4g} = {self.difference:.3g} "
            f"(95 % interval {self.low:.3g} to {self.high:.3g}), and {test.alarms} alarms in "
            f"{test.samples} {test.unit} where {test.samples / test.run_length:.3g} are promised "
            f"(p = {test.p:.2g}, at least {SIGNIFICANCE} needed){slow}"
        )


def padded(records: Sequence[NDArray]) -> NDArray:
    """Scores of records of any lengths as an array (records, T), NaN after the end of each."""
    made = np.full((len(records), max(map(len, records))), np.nan)
    for row, each in zip(made, records, strict=True):
        row[: len(each)] = each
    return made


def decide(
    old_crps: ArrayLike,
    new_crps: ArrayLike,
    false_alarm_test: FalseAlarmTest,
    *,
    reference: FalseAlarmTest | None = None,
    seed: int = 0,
    resamplings: int = 4000,
) -> Decision:
    """Compare two versions on the same samples.

    Parameters
    ----------
    old_crps, new_crps : array (T,) or (n, T)
        CRPS of each sample of a record, or of n records, in the order of time; NaN where a sample
        is missing.
    false_alarm_test : FalseAlarmTest
        The alarms of the new version on healthy samples.
    reference : FalseAlarmTest, optional
        Those of the first active version, see `Decision`.
    seed : int
        Seed of the bootstrap.
    resamplings : int, default 4000
        Bootstrap draws of the mean difference, whose standard deviation they give to about 1 %.

    Raises
    ------
    InputError
        The shapes differ, the versions were not compared on the same samples, a value is infinite,
        or there are fewer than 8 records and one of them has fewer than 160 samples.

    Notes
    -----
    The standard deviation of the mean difference is that of block bootstrap draws
    (`retwin.scores.bootstrap.bootstrap_means`), and the interval is that of Student's t with as
    many degrees of freedom as independent blocks or records allow.

    """
    from scipy.special import stdtrit

    old, new = (np.atleast_2d(np.asarray(each, dtype=float)) for each in (old_crps, new_crps))
    same = old.shape == new.shape and old.ndim == 2 and np.array_equal(np.isnan(old), np.isnan(new))
    expected = f"CRPS of the same samples as old_crps, {old.shape}"
    got = f"{new.shape}, or other samples"
    remedy = "score both versions on the same samples"
    require(same, "new_crps", expected=expected, got=got, remedy=remedy)
    present = np.isfinite(old) & np.isfinite(new)
    expected = "finite scores, NaN where a sample is missing"
    got = "infinite ones"
    remedy = "find out which samples have such predictions"
    require((present | np.isnan(old)).all(), "crps", expected=expected, got=got, remedy=remedy)
    fewest = int(present.sum(axis=1).min(initial=old.shape[1])) if len(old) else 0
    least = MIN_SAMPLES if len(old) < MIN_RECORDS else 1
    expected = f"at least {least} samples of each record"
    require(fewest >= least, "crps", expected=expected, got=fewest, remedy="collect more samples")
    difference = (old - new)[:, :, None]
    draws = bootstrap_means(difference, draws=resamplings, seed=seed)
    mean = float(np.nanmean(difference, axis=1).mean())
    scale = 1.96  # of many records: the draws are already as wide as Student's interval
    if len(old) < MIN_RECORDS:
        scale = np.sqrt(BLOCKS / (BLOCKS - 1)) * stdtrit((BLOCKS - 1) * len(old), 0.975)
    width = float(scale * np.nanstd(draws))
    return Decision(
        float(np.nanmean(old, axis=1).mean()),
        float(np.nanmean(new, axis=1).mean()),
        mean,
        mean - width,
        mean + width,
        false_alarm_test,
        reference,
    )
