"""The most probable x of `CommandProblem`, and which segments its actuators missed.

Rows are trajectories, or hypotheses about them, all solved together. Which segments were missed is
decided by comparing Laplace's evidence; the search is greedy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.inference.noise import Noise
from retwin.inference.problem import GaussianPrior, Rows
from retwin.inference.solver import Solution, added_evidence, best_per_row, solve
from retwin.update.corrections.commands.problem import CommandProblem

SEARCHES = 3
"""Segments of a row at most of which one search may change whether they were missed."""
MARGIN = 20.0
"""Log evidence behind a row's best at which a trial is given up."""

Suspects = Callable[["CommandFit", Tensor], tuple[Tensor, Tensor, Tensor]]
"""From a fit and some rows (k,) to row, segment and actuator (m,) of every flip worth a trial."""


@dataclass(frozen=True, eq=False)
class LatentPrior(Rows):
    """The distribution of (x, missed) before any output is measured.

    Attributes
    ----------
    gaussian : GaussianPrior
        Of x (R, P), see `CommandProblem`.
    odds : Tensor
        (R, M, d_u), log odds that an actuator misses a segment.

    """

    gaussian: GaussianPrior
    odds: Tensor

    @property
    def deviation(self) -> Tensor:
        """Standard deviations (R, P) of x without a fault."""
        return self.gaussian.deviation

    def excess(self, x: Tensor) -> Tensor:
        """What every x (R, P) costs, in nats, beyond the Gaussian: nothing here."""
        return torch.zeros_like(x)

    def log_probability(self, problem: CommandProblem) -> Tensor:
        """Log probability (R,) of the segments that are missed.

        An actuator that a fault holds can miss nothing.
        """
        risk = torch.nn.functional.softplus(self.odds) * problem.healthy
        return (problem.missed * self.odds - risk).sum(dim=(1, 2))


@dataclass(frozen=True, eq=False)
class CommandFit(Rows):
    """The most probable x of every row.

    Attributes
    ----------
    solution : Solution
        For `missed`.
    missed : Tensor
        (R, M, d_u), 1 for a segment that an actuator missed.
    evidence : Tensor
        (R,), log evidence of these missed segments, their probability included.

    """

    solution: Solution
    missed: Tensor
    evidence: Tensor

    @classmethod
    def of_prior(cls, problem: CommandProblem, prior: LatentPrior, x: Tensor) -> CommandFit:
        """At x (R, P), without any measured output."""
        solution = Solution.of_prior(prior.gaussian, x)
        return cls(solution, problem.missed, solution.evidence)

    @property
    def x(self) -> Tensor:
        """(R, P)."""
        return self.solution.x


@dataclass(frozen=True, eq=False)
class MissedSearch:
    """What a search for missed segments found.

    Attributes
    ----------
    fit : CommandFit
        The best one of every row.
    probability : Tensor
        (R, M, d_u), that an actuator missed a segment, as far as that was tried; else 0 or 1.
    evidence : Tensor
        (R,), log evidence of all that was tried.

    """

    fit: CommandFit
    probability: Tensor
    evidence: Tensor


def fitted(
    problem: CommandProblem,
    prior: LatentPrior,
    noise: Noise,
    start: Tensor,
    minimum_evidence: Tensor | None = None,
) -> CommandFit:
    """The most probable x (R, P) if the problem's segments were missed, and no others.

    Rows that are not predicted to reach the log evidence `minimum_evidence` (R,) are given up.
    """
    log_probability = prior.log_probability(problem)
    solution = solve(
        problem,
        prior.gaussian,
        noise,
        start,
        bounds=problem.bounds,
        minimum_evidence=None if minimum_evidence is None else minimum_evidence - log_probability,
    )
    evidence = solution.evidence + log_probability - prior.excess(solution.x).sum(dim=1)
    return CommandFit(solution, problem.missed, evidence)


def searched(
    problem: CommandProblem, prior: LatentPrior, noise: Noise, start: CommandFit, suspects: Suspects
) -> MissedSearch:
    """The most probable missed segments, from those of `start` on.

    Of each row the flip that gains most is kept, and rows in which one gained are searched again.
    """
    fit = fitted(problem.with_missed(start.missed), prior, noise, start.x)
    probability, total = fit.missed, fit.evidence
    rows = torch.arange(len(fit.x))
    for _ in range(SEARCHES):
        flips = suspects(fit, rows)
        tries, segment, actuator = flips
        if not len(tries):
            break
        each = torch.arange(len(tries))
        missed, x = fit.missed[tries].clone(), fit.x[tries].clone()
        now = 1 - missed[each, segment, actuator]
        missed[each, segment, actuator] = now
        problem.per_segment(x)[each, segment, 1:] = 0.0
        part = problem[tries].with_missed(missed)
        tried = fitted(part, prior[tries], noise, x, fit.evidence[tries] - MARGIN)
        gain = tried.evidence - fit.evidence[tries]
        probability = probability.index_put(flips, torch.sigmoid(gain * (2 * now - 1)))
        total = added_evidence(total, tried.evidence, tries)
        rows, best = best_per_row(tried.evidence, tries)
        gains = gain[best] > 0
        rows, best = rows[gains], best[gains]
        fit = fit.put(rows, tried[best])
        if not len(rows):
            break
    return MissedSearch(fit, probability, total)
