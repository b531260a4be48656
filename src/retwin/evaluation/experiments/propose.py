"""`next_experiments`: commands with the most informative outputs, and what they would narrow."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import norm

from retwin.checks import agree, at_least, finite, instance, require, whole
from retwin.data.trajectories import Trajectories
from retwin.evaluation.experiments.actuators import ActuatorKnowledge
from retwin.evaluation.experiments.dynamics import DynamicsKnowledge
from retwin.evaluation.experiments.segments import SegmentKnowledge
from retwin.inference.design import Knowledge, chosen
from retwin.nets.student import widening
from retwin.progress import Progress
from retwin.twins.commands.samplers import CommandSampler
from retwin.twins.twin import checked_seed
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import CommandSpace, before_sensor
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.residual import ResidualModel, infer_discrepancy

FURTHER = 60
"""Largest number of further trajectories that is reported as needed."""
BAND = float(norm.ppf(0.975))
"""Half the width of the band outside of which a segment is faulty, in standard deviations: one
healthy segment in twenty is outside."""


@dataclass(frozen=True)
class Expected:
    """What so many healthy trajectories are expected to give; intervals are those of 90 %.

    Attributes
    ----------
    trajectories : int
        Their number.
    excess : tuple of float
        Share by which bands are wider than with any number of trajectories: mean, low, high.

    """

    trajectories: int
    excess: tuple[float, float, float]

    @property
    def recall(self) -> tuple[float, float, float]:
        """Probability that a fault of three standard deviations of the scatter leaves the band."""
        mean, low, high = map(_recall, self.excess)
        return mean, high, low


@dataclass(frozen=True)
class Measured:
    """What so many of the calibration trajectories gave, over random choices of them.

    Attributes
    ----------
    trajectories : int
        Their number.
    error : tuple of float
        Root mean square error of the predicted mean of z of the other trajectories, relative to the
        standard deviation of z: mean, and the ends of the 90 % interval.

    """

    trajectories: int
    error: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Proposal:
    """What to record next.

    Attributes
    ----------
    commands : (k, T, d_u) array
        The proposed commands, the most informative first.
    gains : tuple of float
        Information about the predictions in nats that each gives, those before it given.
    random_gain : float
        The same of the first of random commands of the sampler, on average.
    ahead : tuple of Expected
        After each proposed trajectory; the first is now.
    ahead_random : tuple of Expected
        The same for random commands, with the interval over their draws.
    curve : tuple of Measured
        Learning curve on subsets of the calibration trajectories; none for corrected dynamics.
    needed, needed_random : int or None
        How many chosen or random trajectories are expected to be enough; None if more than 60.
    tolerance : float
        The excess that is small enough.

    """

    commands: NDArray
    gains: tuple[float, ...]
    random_gain: float
    ahead: tuple[Expected, ...]
    ahead_random: tuple[Expected, ...]
    curve: tuple[Measured, ...]
    needed: int | None
    needed_random: int | None
    tolerance: float

    @property
    def enough(self) -> bool:
        """Whether bands are within the tolerance already."""
        return self.ahead[0].excess[0] <= self.tolerance


def next_experiments(
    twin: CorrectedTwin | DynamicsTwin,
    calibration: Trajectories,
    sampler: CommandSampler,
    *,
    seed: int,
    count: int = 3,
    candidates: int = 200,
    tolerance: float = 0.05,
    progress: Progress | None = None,
) -> Proposal:
    """Propose commands whose outputs are most informative about what is uncertain now.

    Candidates are commands of the sampler, within its limits. They are chosen one after the other
    by how much their outputs, given those before, would inform on the discrepancy at other
    commands of the sampler: with `CommandSpace` by the posterior of its inference, with corrected
    dynamics by that of their parameters, otherwise by that of a linear regression of z on features
    of the commands.

    Parameters
    ----------
    twin : CorrectedTwin or DynamicsTwin
        With one z per segment, or with corrected dynamics.
    calibration : Trajectories
        The healthy trajectories that it was calibrated on; others are left out. At least three, of
        corrected dynamics one.
    sampler : CommandSampler
        The distribution of the commands for which the twin is to predict.
    seed : int
        The same seed gives the same proposal on the same machine.
    count : int
        Trajectories to propose.
    candidates : int
        Draws of the sampler from which these are chosen, at least `count`.
    tolerance : float
        Share by which bands may be wider than with any number of trajectories, above 0.
    progress : callable, optional
        Called with the share that is done.

    Returns
    -------
    Proposal
        The commands, what they are expected to narrow, and what was measured so far.

    Raises
    ------
    InputError
        A twin without one z per segment, fewer than three healthy trajectories, or a number that is
        out of range.

    """
    show = progress or (lambda _: None)
    _check(twin, sampler, count, candidates)
    finite("tolerance", tolerance, at_least=1e-6, at_most=10)
    rng = np.random.default_rng(checked_seed(seed))
    healthy = calibration[calibration.maybe_healthy]
    remedy = "record any healthy ones first"
    # Healthy trajectories at least: fewer do not show how much segments scatter.
    least = 1 if isinstance(twin, DynamicsTwin) else 3
    at_least("calibration", healthy, least, "healthy trajectories", remedy=remedy)
    # Trajectories of the sampler at whose segments the twin is to predict.
    references = sampler.sample(64, rng=rng)
    known, curve = _learn(twin, healthy, references, rng)
    show(0.6)
    now = known.knowledge(references)
    drawn = sampler.sample(candidates, rng=rng)
    # Parts of the candidates, one after the other: memory.
    roots = _joined([known.roots(part) for part in np.array_split(drawn, 4) if len(part)])
    show(0.9)
    picked, after = chosen(now, roots, max(count, min(FURTHER, candidates)))
    every = [now, *after]
    # Random continuations with which the chosen one is compared.
    walks = [_walk(now, roots, rng, len(every) - 1) for _ in range(32)]
    # The scatter too is estimated from few trajectories.
    unsure = _widenings(twin, len(healthy), len(every))
    random = np.array([[each.excess for each in walk] for walk in walks])
    random = (1 + random) * unsure - 1
    gains = [_gain(*pair) for pair in pairwise(every)]
    excess = (1 + np.array([each.excess for each in every])) * unsure - 1
    counts = range(count + 1)
    return Proposal(
        commands=drawn[picked[:count]],
        gains=tuple(gains[:count]),
        random_gain=float(now.gains(roots).mean()),
        ahead=tuple(Expected(len(healthy) + k, _spread(excess[[k]])) for k in counts),
        ahead_random=tuple(Expected(len(healthy) + k, _spread(random[:, k])) for k in counts),
        curve=curve,
        needed=_first(excess, tolerance),
        needed_random=_first(random.mean(axis=0), tolerance),
        tolerance=tolerance,
    )


def _check(twin: object, sampler: CommandSampler, count: int, candidates: int) -> None:
    whole("count", count, at_least=1, at_most=FURTHER)
    whole("candidates", candidates, at_least=count, at_most=100_000)
    if not isinstance(twin, DynamicsTwin):
        instance("twin", twin, CorrectedTwin, remedy="give a corrected twin with one z per segment")
        assert isinstance(twin, CorrectedTwin)
        require(
            isinstance(twin.residual, ResidualModel) and not bool(twin.residual.events.all()),
            "twin",
            expected="a corrected twin with one z per segment, or corrected dynamics",
            got=f"{type(twin.residual.correction).__name__}, with one per sample",
            remedy="fit it with CommandSpace or DelayOffset",
        )
    remedy = "give the sampler of the case that the twin was fitted for"
    agree("sampler", sampler, twin, "that of the twin", names=("rate",), remedy=remedy)


def _joined(parts: list[torch.Tensor]) -> torch.Tensor:
    """Roots (n, r, F) of all parts, whose r differs with the segments of their commands.

    Rows of zeros, which hold no information, fill up the shorter ones.
    """
    longest = max(each.shape[1] for each in parts)
    return torch.cat(
        [torch.nn.functional.pad(each, (0, 0, 0, longest - each.shape[1])) for each in parts]
    )


def _widenings(twin: CorrectedTwin | DynamicsTwin, trajectories: int, count: int) -> NDArray:
    """(count,) factors of bands since the scatter is estimated, from so many trajectories on."""
    if isinstance(twin, DynamicsTwin):
        return np.ones(count)  # noise is estimated from every sample
    degrees = min(twin.residual.degrees)
    total = trajectories + np.arange(count)
    return np.array([widening(degrees * each / trajectories) for each in total])


def _walk(
    known: Knowledge, roots: torch.Tensor, rng: np.random.Generator, count: int
) -> list[Knowledge]:
    """The knowledge before and after each of some random experiments."""
    found = [known]
    for index in rng.permutation(len(roots))[:count]:
        found.append(found[-1].after(roots[index]))
    return found


def _gain(before: Knowledge, after: Knowledge) -> float:
    return float(0.5 * (before.variance / after.variance).log().mean())


def _first(excess: NDArray, tolerance: float) -> int | None:
    """The first number of trajectories with which the excess is small enough."""
    small = np.flatnonzero(excess <= tolerance)
    return int(small[0]) if len(small) else None


def _spread(values: NDArray, *, level: float = 0.9) -> tuple[float, float, float]:
    """Mean and ends of the interval.

    Parameters
    ----------
    level : float, default 0.9
        Probability of the intervals.

    """
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2])
    return float(values.mean()), float(low), float(high)


def _recall(excess: float, *, fault: float = 3.0) -> float:
    """Probability that a fault leaves the band, which contains 95 % of healthy segments.

    Parameters
    ----------
    fault : float, default 3.0
        Size of the fault whose recall is given, in standard deviations of the scatter.

    """
    size = fault / (1 + excess)
    return float(norm.cdf(size - BAND) + norm.cdf(-size - BAND))


def _learn(
    twin: CorrectedTwin | DynamicsTwin,
    healthy: Trajectories,
    references: NDArray,
    rng: np.random.Generator,
) -> tuple[ActuatorKnowledge | DynamicsKnowledge | SegmentKnowledge, tuple[Measured, ...]]:
    """What is known, and the learning curve so far."""
    if isinstance(twin, DynamicsTwin):
        return DynamicsKnowledge.of(twin), ()
    correction = twin.residual.correction
    if isinstance(before_sensor(correction), CommandSpace):
        actuators = ActuatorKnowledge.of(twin, healthy)
        own = SegmentKnowledge.of(twin, actuators.context, actuators.found, references)
        return actuators, _measured_curve(own, rng)
    context, found = infer_discrepancy(twin.surrogate, healthy, correction)
    segments = SegmentKnowledge.of(twin, context, found, references)
    return segments, _measured_curve(segments, rng)


def _measured_curve(
    known: SegmentKnowledge, rng: np.random.Generator, *, orders: int = 10
) -> tuple[Measured, ...]:
    """How well subsets of the calibration trajectories predict the others.

    Parameters
    ----------
    orders : int, default 10
        Random orders of the calibration trajectories, for the learning curve.

    """
    total = known.trajectories
    sizes = sorted(set(np.geomspace(2, total - 1, 5).round().astype(int).tolist()))
    found: dict[int, list[float]] = {size: [] for size in sizes}
    for _ in range(orders):
        order = rng.permutation(total)
        for size in sizes:
            found[size].append(known.subset(order[:size]).error(order[size:]))
    return tuple(Measured(size, _spread(np.array(rows))) for size, rows in found.items())
