"""Optimal experiments for unknowns with a Gaussian posterior: information, and what it narrows.

Experiments are compared by their information on predictions, not on the unknowns themselves: the
mean information gain about the predictions of interest, half the logarithm of the ratio of their
variances before and after (Bickford Smith et al., Prediction-oriented Bayesian active learning,
AISTATS 2023). An unknown that moves no prediction earns nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Knowledge:
    """The posterior of F unknowns, and R predictions that are linear in them.

    Attributes
    ----------
    covariance : Tensor
        (F, F), of the unknowns.
    predictions : Tensor
        (R, F), derivatives of the predictions by the unknowns.
    scatter : Tensor
        (R,), variance of each prediction that remains when the unknowns are known.

    """

    covariance: Tensor
    predictions: Tensor
    scatter: Tensor

    @property
    def variance(self) -> Tensor:
        """(R,), variance of each prediction."""
        moved = self.predictions @ self.covariance
        return self.scatter + (moved * self.predictions).sum(dim=1)

    @property
    def excess(self) -> float:
        """Share by which the standard deviations exceed those with known unknowns, on average."""
        return float((self.variance / self.scatter).sqrt().mean() - 1)

    def after(self, root: Tensor) -> Knowledge:
        """The knowledge after an experiment whose information is `root.T @ root`, (r, F)."""
        moved = self.covariance @ root.mT
        inner = torch.eye(len(root), dtype=moved.dtype) + root @ moved
        left = torch.linalg.solve(inner, moved.mT)
        covariance = self.covariance - moved @ left
        return Knowledge((covariance + covariance.mT) / 2, self.predictions, self.scatter)

    def gains(self, roots: Tensor) -> Tensor:
        """(N,) mean information in nats about the predictions of N experiments (N, r, F)."""
        moved = roots @ self.covariance
        inner = torch.eye(roots.shape[1], dtype=roots.dtype) + moved @ roots.mT
        seen = moved @ self.predictions.mT
        lower = torch.linalg.cholesky(inner)
        reduced = torch.linalg.solve_triangular(lower, seen, upper=False).square().sum(dim=1)
        left = (self.variance - reduced).clamp_min(self.scatter)
        return 0.5 * (self.variance / left).log().mean(dim=1)


def chosen(known: Knowledge, roots: Tensor, count: int) -> tuple[list[int], list[Knowledge]]:
    """The most informative experiments, one after the other, each given those before.

    Parameters
    ----------
    known : Knowledge
        Before any of them.
    roots : Tensor
        (N, r, F), roots of the information of the candidates.
    count : int
        How many to choose, at most N.

    Returns
    -------
    list of int, list of Knowledge
        Their indices, and the knowledge after each.

    """
    taken: list[int] = []
    knowledge = []
    for _ in range(count):
        gains = known.gains(roots)
        gains[taken] = -torch.inf
        best = int(gains.argmax())
        known = known.after(roots[best])
        taken.append(best)
        knowledge.append(known)
    return taken, knowledge
