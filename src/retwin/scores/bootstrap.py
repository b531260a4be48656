"""Bootstrap draws of scores and of their differences, and the intervals that they give.

The unit of resampling is the trajectory: samples within one are correlated, and so are the
diagnoses of one trajectory in several runs. docs/theory.md states the simulations by which the
constants were chosen, and those by which the intervals were checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from retwin.data.trajectories import HEALTHY
from retwin.scores.classification import weighted_score

MIN_RECORDS = 8
"""With this number of records or more, whole records are resampled; with fewer, blocks of them."""
BLOCKS = 16
"""Blocks per record in the block bootstrap, a compromise of block length and number of blocks."""


@dataclass(frozen=True)
class Draws:
    """Bootstrap draws of a score or of a difference.

    Attributes
    ----------
    low, high : array (draws,)
        The draws from which the lower and the upper end of the interval come.

    """

    low: NDArray
    high: NDArray

    def __sub__(self, other: Draws) -> Draws:
        """The draws of a difference; both must come from the same resampling, so are paired."""
        return Draws(self.low - other.high, self.high - other.low)

    def with_runs(self, values: Sequence[float], *, seed: int, largest: float = np.inf) -> Draws:
        """The same with the randomness of training.

        Parameters
        ----------
        values : sequence of float
            The value of each run, two at least: independent of each other.
        seed : int
            Seed of the draws.
        largest : float
            The largest absolute value that is possible: 1 for a difference of shares.

        Notes
        -----
        The error of the mean over R runs is drawn from Student's t with R - 1 degrees of freedom
        times its standard error. That is also contained in part in the draws over trajectories, as
        far as runs err on different ones, so that the sum is slightly too wide.

        """
        runs = np.asarray(values)
        error = runs.std(ddof=1) / np.sqrt(len(runs))
        drawn = error * np.random.default_rng(seed).standard_t(len(runs) - 1, size=len(self.low))
        return Draws(*((each + drawn).clip(-largest, largest) for each in (self.low, self.high)))

    @property
    def interval(self) -> tuple[float, float] | None:
        """The central 95 % of the finite draws; None if there are none."""
        ends = [each[np.isfinite(each)] for each in (self.low, self.high)]
        if not all(map(len, ends)):
            return None
        return float(np.quantile(ends[0], 0.025)), float(np.quantile(ends[1], 0.975))

    @property
    def p(self) -> float | None:
        """The two-sided p-value of the value 0; None without a finite draw.

        It is at most 0.05 where the interval excludes 0, and never below 2 / (draws + 1).
        """
        if self.interval is None:
            return None
        tails = (self.low[np.isfinite(self.low)] <= 0, self.high[np.isfinite(self.high)] >= 0)
        return min(1.0, *(2 * float(each.sum() + 1) / (len(each) + 1) for each in tails))


@dataclass(frozen=True)
class Pseudo:
    """How n trajectories of a class, and pseudo-trajectories, are weighted.

    Attributes
    ----------
    missing : float
        The concentration of the Dirichlet distribution is n / (n + missing) per trajectory, which
        makes up for the variance that n trajectories do not show.
    errors, hits : float
        Total weight, in trajectories, of pseudo-trajectories over all classes: of wrong ones for
        the lower end, and of right ones for the upper end.

    """

    missing: float
    errors: float
    hits: float


CONFUSIONS = Pseudo(2, 0.5, 1)
"""For scores of confusion matrices; docs/theory.md states the simulations that chose it."""
RANKS = Pseudo(2, 0.05, 0.1)
"""For the AUROC, which a wrong diagnosis lowers by about a tenth of what it lowers the recall."""
SHARE = Pseudo(0, 1, 1)
"""For the recall of one class: of one run, the interval by Clopper and Pearson."""
SCHEMES = {"auroc": RANKS, "auroc_micro": RANKS, "healthy_recall": SHARE}
"""By metric, if it is not `CONFUSIONS`."""


@dataclass(frozen=True)
class Resampling:
    """Test trajectories, redrawn within their classes.

    A draw weights the trajectories of a class by a Dirichlet distribution. Among few trajectories
    there may be no error, and then no weights give one; therefore pseudo-trajectories take part.
    Those of the lower end are wrong, each other diagnosis with the same weight, and those of the
    upper end are right.

    Attributes
    ----------
    truth : array (n,)
        True class indices.
    classes : sequence of str
        Their names.
    draws : int
        Bootstrap draws.
    seed : int
        The same seed draws the same weights, so that scores of two sources are paired.

    References
    ----------
    Rubin, The Bayesian bootstrap, Annals of Statistics 1981. Clopper and Pearson, The use of
    confidence or fiducial limits, Biometrika 1934.

    """

    truth: NDArray
    classes: Sequence[str]
    draws: int
    seed: int
    _made: dict[Pseudo, list[tuple[NDArray, NDArray, NDArray]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def of(self, metric: str, probabilities: NDArray) -> Draws:
        """Draws of the metric's mean over runs.

        Parameters
        ----------
        metric : str
            See `retwin.scores.classification.weighted_score`.
        probabilities : array (runs, n, classes)
            Predicted probabilities.

        """
        scheme = SCHEMES.get(metric, CONFUSIONS)
        used = self._used(scheme)
        if not used.any():
            return Draws(*np.full((2, self.draws), np.nan))
        if scheme not in self._made:
            self._made[scheme] = self._weighted(scheme, self.truth[used])
        ends = [
            np.mean(
                [
                    weighted_score(metric, truth, np.vstack([run, certain]), weights, self.classes)
                    for run in probabilities[:, used]
                ],
                axis=0,
            )
            for truth, certain, weights in self._made[scheme]
        ]
        return Draws(*ends)

    def _used(self, scheme: Pseudo) -> NDArray:
        """Whether each trajectory counts (n,); only the healthy ones for the recall of these."""
        if scheme is not SHARE:
            return np.ones(len(self.truth), dtype=bool)
        healthy = self.classes.index(HEALTHY) if HEALTHY in self.classes else -1
        return np.asarray(self.truth == healthy)

    def _weighted(self, scheme: Pseudo, own: NDArray) -> list[tuple[NDArray, NDArray, NDArray]]:
        """For either end: classes with pseudo-trajectories, probabilities of these, and weights.

        Classes (n + pseudo,), probabilities (pseudo, classes) and weights (draws, n + pseudo),
        which sum to each class's number of trajectories.
        """
        rng = np.random.default_rng(self.seed)
        labels, place, counts = np.unique(own, return_inverse=True, return_counts=True)
        shape = (counts / (counts + scheme.missing))[place]
        drawn = rng.standard_gamma(shape, size=(self.draws, len(own)))
        every = range(len(self.classes))
        pairs = [(label, answer) for label in labels for answer in every]
        errors = [pair for pair in pairs if pair[0] != pair[1]]
        hits = [(label, label) for label in labels]
        found = []
        for pseudo, total in ((errors, scheme.errors), (hits, scheme.hits)):
            added = np.array(pseudo, dtype=int).reshape(-1, 2)
            more = rng.standard_gamma(total / len(added), size=(self.draws, len(added)))
            truth = np.concatenate([own, added[:, 0]])
            weights = np.concatenate([drawn, more], axis=1)
            for label, count in zip(labels, counts, strict=True):
                inside = truth == label
                weights[:, inside] *= count / weights[:, inside].sum(axis=1, keepdims=True)
            found.append((truth, np.eye(len(self.classes))[added[:, 1]], weights))
        return found


def bootstrap_means(values: NDArray, *, draws: int, seed: int) -> NDArray:
    """Bootstrap draws (draws, k) of the mean over records of the mean over their samples.

    Parameters
    ----------
    values : array (n, T, k)
        Values of n records; NaN where missing.
    draws : int
        Bootstrap draws.
    seed : int
        The same seed draws the same records or blocks, so that two sources are paired.

    Notes
    -----
    Every record has the same weight. With `MIN_RECORDS` records or more, whole records get weights
    from a Dirichlet distribution; its concentration is such that the normal interval of a mean is
    as wide as Student's. With fewer, each record is composed anew of `BLOCKS` circular blocks of
    its samples, since neighbouring samples are correlated: these draws vary as another stretch of
    the same records would, not as other records.

    References
    ----------
    Rubin, The Bayesian bootstrap, Annals of Statistics 1981. Politis and Romano, A circular
    block-resampling procedure for stationary data, 1992.

    """
    rng = np.random.default_rng(seed)
    n, steps, _ = values.shape
    seen = np.isfinite(values)
    sums = np.where(seen, values, 0.0)
    if n >= MIN_RECORDS:
        with np.errstate(invalid="ignore"):
            each = sums.sum(axis=1) / seen.sum(axis=1)
        ratio = float(ndtri(0.975) / stdtrit(n - 1, 0.975))
        concentration = ((n - 1) * ratio**2 - 1) / n
        return rng.dirichlet(np.full(n, concentration), size=draws) @ each
    length = -(-steps // BLOCKS)
    drawn = np.zeros((draws, values.shape[2]))
    for record in range(n):
        begins = rng.integers(steps, size=(draws, BLOCKS))
        total, count = (
            _moving_sums(each[record], length)[begins].sum(axis=1) for each in (sums, seen)
        )
        with np.errstate(invalid="ignore"):
            drawn += total / count / n
    return drawn


def _moving_sums(values: NDArray, length: int) -> NDArray:
    """Sums (T, k) of the `length` samples from each one on; the end continues with the start."""
    circular = np.concatenate([values, values[:length]]).astype(float)
    total = np.cumsum(np.concatenate([np.zeros_like(circular[:1]), circular]), axis=0)
    return total[length : length + len(values)] - total[: len(values)]
