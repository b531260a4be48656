"""A prior whose mean is a regression, and whose hyperparameters all rows together decide.

The latent variables are x = H β + ε. The errors ε are independent, with one variance for each group
of variables; the coefficients β are common to all rows and shrunk to 0, with a variance for each
kind of coefficient, relative to that of the group they belong to. Variances are learned by
expectation-maximisation on the linearised problem, in which x and β have a closed form (type-II
maximum likelihood with weak, fixed hyperpriors; automatic relevance determination: MacKay, Neural
Comput. 4, 415, 1992; Tipping, J. Mach. Learn. Res. 1, 211, 2001).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from retwin.inference.priors import ROUNDING, GaussianPrior, inverse
from retwin.inference.solver import Solution

FREEDOM = 2.0
"""Degrees of freedom of the scaled inverse chi-squared hyperpriors: what a variance is expected to
be counts as much as two observations."""
RELATIVE = 0.01
"""Expected variance of a coefficient relative to that of its group: small unless data say more."""
TOLERANCE = 1e-3
"""Relative change of all variances below which they have converged."""
MAX_STEPS = 200
"""Steps of expectation-maximisation at most."""
FLAT = 0
"""The kind of coefficients that are not shrunk to 0."""


@dataclass(frozen=True, eq=False)
class Design:
    """The regression of R rows of P latent variables on F features.

    Attributes
    ----------
    features : Tensor
        (R, P, F), the matrices H.
    group : Tensor
        (P,) long, the group of each variable; G in all.
    wider : Tensor
        (R, P), the factor by which a variable's standard deviation exceeds that of its group.
    used : Tensor
        (R, P), 1 where variances are learned from the variable, else 0.
    owner : Tensor
        (F,) long, the group that each coefficient belongs to.
    kind : Tensor
        (F,) long, the kind of each coefficient; K in all. Those of kind 0 are not shrunk.

    """

    features: Tensor
    group: Tensor
    wider: Tensor
    used: Tensor
    owner: Tensor
    kind: Tensor


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """The hyperparameters.

    Attributes
    ----------
    variance : Tensor
        (G,), of the errors of each group.
    relative : Tensor
        (K,), variance of the coefficients of each kind, relative to that of their group.
    coefficients : Tensor
        (F,), posterior mean.
    covariance : Tensor
        (F, F), posterior covariance of the coefficients.
    flat : tuple of float
        Mean and variance of the prior of coefficients of kind 0, infinite if nothing is known.

    """

    variance: Tensor
    relative: Tensor
    coefficients: Tensor
    covariance: Tensor
    flat: tuple[float, float] = (0.0, torch.inf)

    @classmethod
    def of(
        cls,
        design: Design,
        variance: Tensor,
        coefficients: Tensor,
        flat: tuple[float, float] = (0.0, torch.inf),
    ) -> Hierarchy:
        """The hyperparameters to begin with: variances (G,), certain coefficients (F,)."""
        kinds = int(design.kind.amax()) + 1
        count = len(coefficients)
        return cls(
            variance,
            variance.new_full((kinds,), RELATIVE),
            coefficients,
            variance.new_zeros(count, count),
            flat,
        )

    def prior(self, design: Design) -> GaussianPrior:
        """The distribution of x at the most probable coefficients."""
        return GaussianPrior.independent(
            design.features @ self.coefficients, self._variances(design)
        )

    def posterior_covariance(self, design: Design, solution: Solution) -> Tensor:
        """Covariance (R, P, P) of x; that the coefficients are uncertain is accounted for."""
        covariance = solution.covariance
        weighted = design.features / self._variances(design)[..., None]
        shift = covariance @ weighted
        return covariance + shift @ self.covariance @ shift.mT

    def information(self, design: Design, solution: Solution) -> Tensor:
        """(R, F, F) the information of each row about the coefficients, with x integrated out."""
        weighted = design.features / self._variances(design)[..., None]
        left = design.features - solution.covariance @ weighted
        return weighted.mT @ left

    def scatter(self, design: Design) -> Tensor:
        """(R, P) variances of x when the coefficients are known."""
        return self._variances(design)

    def learned(self, design: Design, solution: Solution, expected: Tensor) -> Hierarchy:
        """The most probable hyperparameters for the problem linearised at its solution.

        Parameters
        ----------
        design : Design
            Of all rows.
        solution : Solution
            For the prior that these hyperparameters give.
        expected : Tensor
            (G,), the variance of each group that the hyperprior expects.

        """
        prior = self.prior(design)
        # The likelihood of the linearised problem: its curvature, and its slope at the solution.
        curvature = solution.curvature - prior.precision
        slope = prior.gradient(solution.x) - solution.gradient
        found = self
        for _ in range(MAX_STEPS):
            before, found = found, found._step(design, curvature, solution.x, slope, expected)
            if (found.variance / before.variance).log().abs().amax() < TOLERANCE:
                break
        return found

    def _variances(self, design: Design) -> Tensor:
        return self.variance[design.group] * design.wider.square()

    def _step(
        self, design: Design, curvature: Tensor, x: Tensor, slope: Tensor, expected: Tensor
    ) -> Hierarchy:
        """One step: the posterior of coefficients and x, then the variances."""
        features, variances = design.features, self._variances(design)
        precision = variances.reciprocal()
        # In prior standard deviations: what exact outputs leave open keeps the prior's precision
        # beside what they determine, which is larger by many orders.
        scale = variances.sqrt()[:, :, None] * variances.sqrt()[:, None, :]
        identity = torch.eye(curvature.shape[1], dtype=curvature.dtype)
        covariance = torch.linalg.inv(curvature * scale + identity) * scale
        covariance = (covariance + covariance.mT) / 2
        weighted = features * precision[..., None]
        # With x integrated out, β has this precision, and the errors ε depend on β by -left.
        left = features - covariance @ weighted
        own = self.relative[design.kind] * self.variance[design.owner]
        own = torch.where(design.kind == FLAT, self.flat[1], own)
        centre = torch.where(design.kind == FLAT, self.flat[0], torch.zeros_like(own))
        information = (weighted.mT @ left).sum(dim=0) + torch.diag(own.reciprocal())
        # Where nothing is measured, nothing is known of coefficients that are not shrunk.
        known = (weighted * features).sum(dim=(0, 1))  # of each coefficient, were x measured
        information = information + torch.diag(ROUNDING * known)
        # As the product of the covariance and the slope at x = 0, without its large numbers.
        mean = x + (covariance @ (slope - precision * x)[..., None])[..., 0]
        uncertain = inverse(information[None])[0]
        beta = uncertain @ ((weighted * mean[..., None]).sum(dim=(0, 1)) + centre / own)
        error = mean - left @ beta
        spread = covariance.diagonal(dim1=1, dim2=2) + ((left @ uncertain) * left).sum(dim=-1)
        second = (error.square() + spread) / design.wider.square() * design.used
        total, count = (
            torch.zeros_like(self.variance).index_add(0, design.group, each.sum(dim=0))
            for each in (second, design.used)
        )
        variance = (total + FREEDOM * expected) / (count + FREEDOM)
        share = (beta.square() + uncertain.diagonal()) / variance[design.owner]
        sums, counts = (
            torch.zeros_like(self.relative).index_add(0, design.kind, each)
            for each in (share, torch.ones_like(share))
        )
        relative = (sums + FREEDOM * RELATIVE) / (counts + FREEDOM)
        return replace(
            self, variance=variance, relative=relative, coefficients=beta, covariance=uncertain
        )
