"""Bets against the class of healthy distributions: factors whose expectation is at most 1.

A bet is any positive function g of a score. Divided by its largest expectation over the class of
`Slack` it is an e-value for each sample given the past. The class is a band of quantile functions,
so that the expectation of the largest value of g inside the band is an upper bound of it for any g,
and equal to it for the bets on shifts and scales. It is summed over the grid on which the bets are
used: the widest member of the class is used for bets on a larger scale, the narrowest for bets on
a smaller one, and the shifted one for bets on a shift.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from retwin.monitor.detect.slack import CENTRE, Slack

CLIP = 4.0
"""Scores beyond this count as this: evidence of one sample is bounded, and of heavy tails only the
probability beyond the clip matters, which may be 6e-5 at κ = 1 and 0.0014 at κ = 1.25."""
PER_UNIT = 64
"""Cells of the grid of scores per standard deviation."""
LEVELS = np.linspace(-3.0, 3.0, 13)
"""Values to which the score before is rounded, on which bets on dependence and repetition depend:
halves, which are as narrow as a repetition. Beyond them, dependence would be as good as a shift."""
EDGES = np.concatenate(
    [[-np.inf], np.arange(-CLIP * PER_UNIT, CLIP * PER_UNIT + 1) / PER_UNIT, [np.inf]]
)
"""Edges of the cells of the grid of scores, of which the outermost two are unbounded."""
CENTRES = np.clip((EDGES[1:] + EDGES[:-1]) / 2, -CLIP, CLIP)
"""The score of each cell at which bets are evaluated."""
MASS = np.diff(ndtr(EDGES))
"""Standard Gaussian probability of each cell."""


class Alternative(Protocol):
    """What a bet is on. Scores come divided or multiplied by the slack of the scale."""

    @property
    def change(self) -> str:
        """What it is a change of, for people."""

    def log_bet(self, score: NDArray, previous: float, kappa: float) -> NDArray:
        """The logarithm of g, given the score before and the slack of the scale."""


@dataclass(frozen=True)
class Location:
    """A shift of the mean by `size` standard deviations, up or down by its sign."""

    size: float

    @property
    def change(self) -> str:
        """See `Alternative.change`."""
        return "higher than predicted" if self.size > 0 else "lower than predicted"

    def log_bet(self, score: NDArray, previous: float, kappa: float) -> NDArray:
        """Likelihood ratio of Gaussian distributions, but for a constant."""
        return self.size * score / kappa


@dataclass(frozen=True)
class Scale:
    """A standard deviation `ratio` times as large; a sensor that is stuck is a small ratio."""

    ratio: float

    @property
    def change(self) -> str:
        """See `Alternative.change`."""
        return "larger errors" if self.ratio > 1 else "smaller errors"

    def log_bet(self, score: NDArray, previous: float, kappa: float) -> NDArray:
        """Likelihood ratio of Gaussian distributions, but for a constant."""
        scaled = score / kappa if self.ratio > 1 else score * kappa
        return (1 - self.ratio**-2) / 2 * scaled**2


@dataclass(frozen=True)
class Tails:
    """A `share` of the samples with a standard deviation `ratio` times as large."""

    share: float
    ratio: float
    change: ClassVar[str] = "single large errors"

    def log_bet(self, score: NDArray, previous: float, kappa: float) -> NDArray:
        """Likelihood ratio of the contaminated Gaussian distribution."""
        wide = np.exp((1 - self.ratio**-2) / 2 * (score / kappa) ** 2) / self.ratio
        return np.log1p(self.share * (wide - 1))


@dataclass(frozen=True)
class Dependence:
    """A `correlation` of each score with the one before."""

    correlation: float
    change: ClassVar[str] = "errors that depend on each other"

    def log_bet(self, score: NDArray, previous: float, kappa: float) -> NDArray:
        """A shift of the mean in proportion to the score before."""
        return self.correlation * previous * score / kappa


@dataclass(frozen=True)
class Repetition:
    """A `share` of the scores within about `width` of the one before, as of a frozen sensor.

    Scores of a frozen sensor that are not near 0 are no smaller than others. After a score beyond
    `CENTRE` nothing is bet: that such scores go on is a shift.
    """

    share: float
    width: float
    change: ClassVar[str] = "errors that repeat"

    def log_bet(self, score: NDArray, previous: float, kappa: float) -> NDArray:
        """Likelihood ratio of a mixture of a Gaussian distribution around the score before."""
        if abs(previous) > CENTRE:
            return np.zeros_like(score)
        near = score**2 / 2 - ((score - previous) / self.width) ** 2 / 2
        return np.log1p(self.share * (np.exp(near) / self.width - 1))


ALTERNATIVES: tuple[tuple[Alternative, ...], ...] = (
    tuple(Location(sign * size) for size in (0.25, 0.5, 1.0, 2.0) for sign in (-1, 1)),
    (Scale(1.5), Scale(2.5), Scale(5.0)),
    (Scale(0.7), Scale(0.4), Scale(0.1)),
    (Tails(0.1, 4.0),),
    (Dependence(0.3), Dependence(0.6), Dependence(-0.3), Dependence(-0.6)),
    (Repetition(0.9, 0.5),),
)
"""Families of alternatives. Families have equal weights, and so have the members of a family: a
larger number of sizes costs a delay of its logarithm."""


@dataclass(frozen=True)
class Bets:
    """The bets of several classes, integrated over the grid of scores.

    Attributes
    ----------
    integrals : array (J, classes * levels * edges)
        The integral of each bet from minus infinity to each edge, by the standard Gaussian
        measure. The mean of a bet between two edges is a difference of these over that of `mass`.
    mass : array (classes * levels * edges,)
        The same integral of 1.
    weights : array (J,)
        They sum to 1.

    """

    integrals: NDArray
    mass: NDArray
    weights: NDArray

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, slacks: tuple[Slack, ...], families: tuple[tuple[Alternative, ...], ...]) -> Bets:
        """Bets on each alternative against each class; the newest ones are kept."""
        alternatives = [each for family in families for each in family]
        weights = [1 / len(families) / len(family) for family in families for _ in family]
        values = np.array([[_bets(each, slack) for slack in slacks] for each in alternatives])
        sums = np.zeros((*values.shape[:-1], len(EDGES)))
        np.cumsum(values * MASS, axis=-1, out=sums[..., 1:])
        mass = np.broadcast_to(ndtr(EDGES), sums.shape[1:])
        made = sums.reshape(len(alternatives), -1), mass.reshape(-1).copy(), np.array(weights)
        for each in made:
            each.setflags(write=False)
        return cls(*made)

    def position(self, low: NDArray, high: NDArray) -> tuple[NDArray, NDArray]:
        """The indices of the edges that enclose scores; NaN encloses no matter what."""
        first = np.floor(np.clip(low, -CLIP - 1, CLIP + 1) * PER_UNIT) + CLIP * PER_UNIT + 1
        last = np.ceil(np.clip(high, -CLIP - 1, CLIP + 1) * PER_UNIT) + CLIP * PER_UNIT + 1
        largest = len(EDGES) - 2
        first = np.clip(np.where(np.isfinite(first), first, 0), 0, largest).astype(np.intp)
        last = np.where(np.isfinite(last), np.minimum(last, largest + 1), 0).astype(np.intp)
        return first, np.maximum(last, first + 1)

    def offset(self, which: NDArray, previous: NDArray) -> NDArray:
        """Where the edges of a class and of a score before begin."""
        steps = (np.clip(previous, LEVELS[0], LEVELS[-1]) - LEVELS[0]) / (LEVELS[1] - LEVELS[0])
        return (which * len(LEVELS) + np.rint(steps).astype(np.intp)) * len(EDGES)


def _bets(alternative: Alternative, slack: Slack, *, floor: float = 1e-6) -> NDArray:
    """An alternative's bet (levels, cells), divided by its largest expectation over the class.

    Parameters
    ----------
    floor : float, default 1e-6
        Least value of a bet before its division: a product never becomes 0.

    """
    logs = [alternative.log_bet(CENTRES, level, slack.kappa) for level in LEVELS]
    values = np.maximum(np.exp(np.minimum(logs, 40.0)), floor)
    # Scores that a member of the class may have at the Gaussian quantiles of each cell.
    first = np.searchsorted(EDGES, slack.lower(EDGES[:-1]), side="right") - 1
    last = np.searchsorted(EDGES, slack.upper(EDGES[1:]), side="left")
    pairs = zip(first, last, strict=True)
    largest = [values[:, max(a, 0) : max(b, a + 1)].max(axis=1) for a, b in pairs]
    expectation = np.sum(np.array(largest).T * MASS, axis=1)  # each level in the same order
    return values / expectation[:, None]
