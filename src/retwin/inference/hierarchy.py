"""A prior whose mean is a regression, and whose hyperparameters all rows together decide.

The latent variables are x = H β + ε. The errors ε are independent, with one variance for each group
of variables. The coefficients β are common to all rows, and normal with mean 0: those of a kind
share a variance in squares of their owners' units; the effect of a condition, which its replicates
share, has a variance for each group. Replicates show the errors; only other conditions show more of
what a single one leaves open.

The most probable variances are found by expectation-maximisation on the linearised problem, in
which x and β have a closed form (type-II maximum likelihood with weak hyperpriors; automatic
relevance determination: MacKay, Neural Comput. 4, 415, 1992; Tipping, J. Mach. Learn. Res. 1, 211,
2001). What x may be is integrated over all variances that are probable, by Gibbs sampling (Gelman,
Bayesian Anal. 1, 515, 2006): what outputs leave open depends on their ratios.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import gammaln, softmax
from torch import Tensor

from retwin.inference.hyperprior import Hyperprior, Variances
from retwin.inference.problem import ROUNDING, GaussianPrior, inverse
from retwin.inference.solver import Solution

FREEDOM = 2.0
"""Degrees of freedom of the scaled inverse chi-squared hyperpriors: what a variance is expected to
be counts as much as two observations."""
TIED = FREEDOM * 2.0 ** np.arange(6)
"""Degrees of freedom between which the data decide for the variances of tied groups, all of them as
probable beforehand: the more, the more alike these variances are."""
LARGEST = 1e3
"""Largest standard deviation, in units: what outputs hardly show is linear no further."""
WARM_UP, DRAWS = 20, 100
"""Draws of the variances that are left out first, and that are then averaged over."""
FLAT, CONDITION = 0, -1
"""The kinds of coefficients whose prior is given, and that are the effects of conditions."""


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
        (F,) long, the kind of each coefficient, 0 to K - 1, or `CONDITION`. Those of kind 0 have a
        prior of their own.
    single : Tensor
        (R, P), 1 where the error of a variable includes the effect of a condition, because its
        condition has no replicate, else 0.
    tied : tuple of int
        The first of the groups whose variances, in squares of their units, are expected to be
        alike, and the one after the last.
    unit : Tensor
        (G,), the unit of the variables of each group.
    share : Tensor
        (K,), expected variance of the coefficients of each kind, relative to that of the tied
        groups.

    """

    features: Tensor
    group: Tensor
    wider: Tensor
    used: Tensor
    owner: Tensor
    kind: Tensor
    single: Tensor
    tied: tuple[int, int]
    unit: Tensor
    share: Tensor


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The linearised problem: curvature and gradient of the log likelihood at some x.

    Attributes
    ----------
    curvature : Tensor
        (R, P, P), of minus the log likelihood.
    x : Tensor
        (R, P).
    slope : Tensor
        (R, P), gradient of the log likelihood at x.

    """

    curvature: Tensor
    x: Tensor
    slope: Tensor

    @classmethod
    def of(cls, solution: Solution, prior: GaussianPrior) -> Likelihood:
        """That of a solution which was found for a prior."""
        curvature = solution.curvature - prior.precision
        return cls(curvature, solution.x, prior.gradient(solution.x) - solution.gradient)

    def weighted(self, weight: Tensor) -> Likelihood:
        """The same to a power, (R, 1) or by variable (R, P): 0 without what depends on it."""
        root = weight.sqrt()
        curvature = self.curvature * root[:, :, None] * root[:, None, :]
        return Likelihood(curvature, self.x, self.slope * weight)


@dataclass(frozen=True, eq=False)
class _Posterior:
    """x and β for given variances: β is normal, and so is x for a given β.

    Attributes
    ----------
    factor : Tensor
        (R, P, P), lower factor of the precision of x in standard deviations of its errors.
    covariance : Tensor
        (R, P, P), of x for given β.
    origin : Tensor
        (R, P), mean of x for β = 0.
    moved : Tensor
        (R, P, F), derivative of the mean of x by β.
    beta, uncertain : Tensor
        (F,) and (F, F), mean and covariance of β.
    evidence : Tensor
        (), log evidence of the variances, up to a number that depends on the likelihood alone.

    """

    factor: Tensor
    covariance: Tensor
    origin: Tensor
    moved: Tensor
    beta: Tensor
    uncertain: Tensor
    evidence: Tensor

    def draw_coefficients(self, rng: np.random.Generator) -> Tensor:
        """A draw (F,) of β."""
        values, vectors = torch.linalg.eigh(self.uncertain)
        return self.beta + vectors @ (values.clamp_min(0).sqrt() * normal(values, rng))


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """The hyperparameters.

    Attributes
    ----------
    variance : Tensor
        (G,), of the errors of each group.
    common : Tensor
        (G,), of the effects that conditions have on each group; 0 if nothing is replicated.
    relative : Tensor
        (K,), variance of the coefficients of each kind, in squares of their owners' units.
    coefficients : Tensor
        (F,), posterior mean.
    covariance : Tensor
        (F, F), posterior covariance of the coefficients.
    expected : Hyperprior
        What is expected of the coefficients of kind 0 and of the variances.

    """

    variance: Tensor
    common: Tensor
    relative: Tensor
    coefficients: Tensor
    covariance: Tensor
    expected: Hyperprior = Hyperprior()  # noqa: RUF009 - frozen

    @classmethod
    def of(
        cls,
        design: Design,
        variance: Tensor,
        coefficients: Tensor,
        expected: Hyperprior = Hyperprior(),  # noqa: B008 - frozen
    ) -> Hierarchy:
        """The hyperparameters to begin with: variances (G,), certain coefficients (F,)."""
        count = len(coefficients)
        common = variance * float((design.kind == CONDITION).any())
        level, _ = _level(design, variance)
        certain = variance.new_zeros(count, count)
        return cls(variance, common, design.share * level, coefficients, certain, expected)

    def adapted(self, design: Design) -> Hierarchy:
        """The same variances of errors to begin with for another regression."""
        coefficients = self.variance.new_zeros(len(design.owner))
        flat = design.kind == FLAT
        coefficients[flat] = self.coefficients[: int(flat.sum())]
        made = Hierarchy.of(design, self.total(), coefficients, self.expected)
        return replace(made, variance=self.variance, common=self.common)

    def prior(self, design: Design) -> GaussianPrior:
        """The distribution of x at the most probable coefficients.

        Effects of conditions are as uncertain as they are: those that nothing shows are free.
        """
        effect = torch.where(design.kind == CONDITION, self.covariance.diagonal(), 0.0)
        variances = self.scatter(design) + design.features.square() @ effect
        return GaussianPrior.independent(design.features @ self.coefficients, variances)

    def posterior_covariance(self, design: Design, likelihood: Likelihood) -> Tensor:
        """Covariance (R, P, P) of x; that the coefficients are uncertain is accounted for."""
        found = self._posterior(design, likelihood)
        return found.covariance + found.moved @ found.uncertain @ found.moved.mT

    def information(self, design: Design, likelihood: Likelihood) -> Tensor:
        """(R, F, F) the information of each row about the coefficients, with x integrated out."""
        weighted = design.features / self.scatter(design)[..., None]
        return weighted.mT @ (design.features - self._posterior(design, likelihood).moved)

    def total(self) -> Tensor:
        """(G,) variances of x about the regression, under conditions that have no replicate."""
        return self.variance + self.common

    def learned(self, design: Design, likelihood: Likelihood, *, max_steps: int = 200) -> Hierarchy:
        """The most probable hyperparameters for the linearised problem.

        Parameters
        ----------
        max_steps : int, default 200
            Steps of expectation-maximisation at most.

        """
        found = self
        for _ in range(max_steps):
            before, found = found, found._step(design, likelihood)
            # Relative change of all variances below which they have converged.
            if (found.total() / before.total()).log().abs().amax() < 1e-3:
                break
        return found

    def evidence(self, design: Design, likelihood: Likelihood) -> float:
        """Log evidence of the variances, up to a number that depends on the likelihood alone."""
        return float(self._posterior(design, likelihood).evidence)

    def integrated(
        self, design: Design, likelihood: Likelihood, learned_from: Likelihood | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean (R, P) and covariance (R, P, P) of x, over all variances that are probable.

        Variances are those of `learned_from`, if it is another likelihood than that of x (a cut
        posterior: Plummer, Stat. Comput. 25, 37, 2015).
        """
        means, covariances = [], []
        for given, drawn in self._sample(design, learned_from or likelihood):
            found = drawn if learned_from is None else given._posterior(design, likelihood)
            means.append(found.origin + found.moved @ found.beta)
            spread = found.moved @ found.uncertain @ found.moved.mT
            covariances.append(found.covariance + spread)
        mean = torch.stack(means).mean(dim=0)
        away = torch.stack(means, dim=1) - mean[:, None]
        return mean, torch.stack(covariances).mean(dim=0) + away.mT @ away / DRAWS

    def draws(self, design: Design, likelihood: Likelihood) -> list[Hierarchy]:
        """Hyperparameters from their posterior: variances, and coefficients that are certain."""
        rng, made = np.random.default_rng(1), []
        for given, found in self._sample(design, likelihood):
            beta = found.draw_coefficients(rng)
            certain = torch.zeros_like(found.uncertain)
            made.append(replace(given, coefficients=beta, covariance=certain))
        return made

    def _sample(
        self, design: Design, likelihood: Likelihood
    ) -> Iterator[tuple[Hierarchy, _Posterior]]:
        """`DRAWS` draws of the variances, by Gibbs sampling, and the posterior for each."""
        rng, given = np.random.default_rng(0), self
        for count in range(WARM_UP + DRAWS):
            found = given._posterior(design, likelihood)
            if count >= WARM_UP:
                yield given, found
            given = given._draw_variances(design, found, rng)

    def scatter(self, design: Design) -> Tensor:
        """(R, P) variances of x when the coefficients are known."""
        own, effect = self.variance[design.group], self.common[design.group]
        return (own + effect * design.single) * design.wider.square()

    def _posterior(self, design: Design, likelihood: Likelihood) -> _Posterior:
        """The posterior of x and β for these variances."""
        features, variances = design.features, self.scatter(design)
        x, slope = likelihood.x, likelihood.slope
        precision = variances.reciprocal()
        # In prior standard deviations: what exact outputs leave open keeps the prior's precision
        # beside what they determine, which is larger by many orders.
        scale = variances.sqrt()[:, :, None] * variances.sqrt()[:, None, :]
        identity = torch.eye(x.shape[1], dtype=x.dtype)
        curvature = likelihood.curvature * scale
        curvature = (curvature + curvature.mT) / 2 + identity
        factor, failed = torch.linalg.cholesky_ex(curvature)
        if failed.any():
            # Added to the diagonal, relative to its largest element, where rounding makes a
            # curvature indefinite.
            rounding = 1e-13 * curvature.diagonal(dim1=1, dim2=2).amax(dim=1) * (failed > 0)
            factor = torch.linalg.cholesky(curvature + rounding[:, None, None] * identity)
        covariance = torch.cholesky_inverse(factor) * scale
        weighted = features * precision[..., None]
        # With x integrated out, β has this precision, and the errors ε depend on β by -left.
        moved = covariance @ weighted
        own = self.relative[design.kind.clamp_min(0)] * design.unit[design.owner].square()
        own = torch.where(design.kind == CONDITION, self.common[design.owner], own)
        flat, centre = design.kind == FLAT, torch.zeros_like(own)
        centre[flat], own[flat] = (torch.as_tensor(each).to(own) for each in self.expected.flat)
        information = (weighted.mT @ (features - moved)).sum(dim=0) + torch.diag(own.reciprocal())
        # Where nothing is measured, nothing is known of coefficients that are not shrunk.
        known = (weighted * features).sum(dim=(0, 1))  # of each coefficient, were x measured
        information = information + torch.diag(ROUNDING * known)
        # As the product of the covariance and the slope at x = 0, without its large numbers.
        gradient = slope - precision * x
        step = (covariance @ gradient[..., None])[..., 0]
        origin = x + step
        uncertain = inverse(information[None])[0]
        right = (weighted * origin[..., None]).sum(dim=(0, 1)) + centre / own
        beta = uncertain @ right
        evidence = 0.5 * (
            (gradient * step).sum()
            - (precision * x.square()).sum()
            + right @ beta
            - 2 * factor.diagonal(dim1=1, dim2=2).log().sum()
            - torch.linalg.slogdet(information)[1]
            - own[own.isfinite()].log().sum()
        )
        return _Posterior(factor, covariance, origin, moved, beta, uncertain, evidence)

    def _step(self, design: Design, likelihood: Likelihood) -> Hierarchy:
        """One step: the posterior of coefficients and x, then the variances."""
        found = self._posterior(design, likelihood)
        left = design.features - found.moved
        error = found.origin - left @ found.beta
        spread = found.covariance.diagonal(dim1=1, dim2=2)
        spread = spread + ((left @ found.uncertain) * left).sum(dim=-1)
        second = (error.square() + spread) / design.wider.square()
        own, effect = self._parts(design)
        both = own * effect * self.total()[design.group]  # conditional variance of either part
        beta = found.beta.square() + found.uncertain.diagonal()
        sums = own.square() * second + both, effect.square() * second + both
        made = self._update_variances(design, *sums, beta, None)
        return replace(made, coefficients=found.beta, covariance=found.uncertain)

    def _draw_variances(
        self, design: Design, found: _Posterior, rng: np.random.Generator
    ) -> Hierarchy:
        """Variances from their distribution for a β and an x that are drawn."""
        beta = found.draw_coefficients(rng)
        noise = normal(found.origin, rng)[..., None]
        noise = torch.linalg.solve_triangular(found.factor.mT, noise, upper=True)[..., 0]
        x = found.origin + found.moved @ beta + self.scatter(design).sqrt() * noise
        error = (x - design.features @ beta) / design.wider
        own, effect = self._parts(design)
        both = own * effect * self.total()[design.group]
        part = effect * error + both.sqrt() * normal(error, rng)
        sums = (error - part).square(), part.square()
        return self._update_variances(design, *sums, beta.square(), rng)

    def _parts(self, design: Design) -> tuple[Tensor, Tensor]:
        """Shares (R, P) of a variable's variance that are the error's and the condition's."""
        own = self.variance[design.group]
        effect = self.common[design.group] * design.single
        return own / (own + effect), effect / (own + effect)

    def _update_variances(
        self,
        design: Design,
        error: Tensor,
        effect: Tensor,
        beta: Tensor,
        rng: np.random.Generator | None,
    ) -> Hierarchy:
        """The most probable variances, or drawn ones, for squares of errors, effects and β."""
        zero = torch.zeros_like(self.variance)
        used, single = design.used, design.used * design.single

        def sum_by_group(values: Tensor) -> Tensor:
            return zero.index_add(0, design.group, values.sum(dim=0))

        def update(total: Tensor, count: Tensor, usual: Variances) -> Tensor:
            found = _scaled(total + usual.count * usual.expected, count + usual.count, rng)
            return found.minimum((LARGEST * design.unit).square())

        usual = self.expected.error or _usual(design, self.variance, rng)
        variance = update(sum_by_group(error * used), sum_by_group(used), usual)
        total, count = sum_by_group(effect * single), sum_by_group(single)
        shown = ((design.features * used[..., None]).abs().sum(dim=(0, 1)) > 0).to(beta)
        shown = shown * (design.kind == CONDITION)
        total = total.index_add(0, design.owner, beta * shown)
        count = count.index_add(0, design.owner, shown)
        common = self.common
        if (design.kind == CONDITION).any():
            usual = self.expected.effect or _usual(design, self.common, rng)
            common = update(total, count, usual)
        some = design.kind != CONDITION
        kind, owner = design.kind[some], design.owner[some]
        share = beta[some] / design.unit[owner].square()
        nothing = torch.zeros_like(self.relative)
        sums = nothing.index_add(0, kind, share)
        counts = nothing.index_add(0, kind, torch.ones_like(share))
        expected = design.share * _level(design, variance + common)[0]
        relative = _scaled(sums + FREEDOM * expected, counts + FREEDOM, rng).clamp_max(LARGEST**2)
        return replace(self, variance=variance, common=common, relative=relative)


def normal(like: Tensor, rng: np.random.Generator) -> Tensor:
    """Draws from the standard normal distribution, as many as `like` has values."""
    return torch.from_numpy(rng.standard_normal(tuple(like.shape)))


def _scaled(total: Tensor, count: Tensor, rng: np.random.Generator | None) -> Tensor:
    """The mode of scaled inverse chi-squared distributions, or draws from them."""
    return total / (count if rng is None else torch.from_numpy(rng.chisquare(count.numpy())))


def _usual(design: Design, before: Tensor, rng: np.random.Generator | None) -> Variances:
    """What variances (G,) are expected to be if nothing but their units is known."""
    first, last = design.tied
    level, freedom = _level(design, before, rng)
    expected, count = design.unit.square().clone(), torch.full_like(before, FREEDOM)
    expected[first:last] *= level
    count[first:last] = freedom
    return Variances(expected, count)


def _level(
    design: Design, variance: Tensor, rng: np.random.Generator | None = None
) -> tuple[float, float]:
    """What variances (G,) of tied groups are expected to be, in squares of their units.

    It is the most probable value for the geometric mean of the degrees of freedom, or a draw of
    both, and comes with these degrees. Beforehand its root, a standard deviation, is half-normal
    with a scale of one unit: any smaller one is as probable.
    """
    first, last = design.tied
    if first == last:
        return 1.0, FREEDOM
    relative = (variance / design.unit.square())[first:last].numpy()
    # The density of the variances for every number of degrees of freedom, over all levels.
    half, size = TIED / 2, last - first
    count, precision = size * TIED + 1, TIED * (1 / relative).sum() + 1
    density = size * (half * np.log(half) - gammaln(half)) - (half + 1) * np.log(relative).sum()
    density += gammaln(count / 2) - count / 2 * np.log(precision / 2)
    weight = softmax(density)
    if rng is None:
        freedom = float(np.exp(weight @ np.log(TIED)))
        return (size * freedom + 1) / (freedom * (1 / relative).sum() + 1), freedom
    drawn = rng.choice(len(TIED), p=weight)
    return float(rng.chisquare(count[drawn]) / precision[drawn]), float(TIED[drawn])
