"""A prior whose mean is a regression: closed forms, recovery, and honest intervals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import halfnorm, invgamma
from torch import Tensor

from retwin.inference.hierarchy import CONDITION, TIED, Design, Hierarchy, Likelihood, _level
from retwin.inference.hyperprior import Hyperprior
from retwin.inference.solver import Solution

pytestmark = pytest.mark.numerical

VARIANCE = torch.tensor([0.25, 4.0], dtype=torch.float64)
COEFFICIENTS = torch.tensor([3.0, 1.5, -2.0, 0.0], dtype=torch.float64)
"""A mean of the first group, which is not shrunk; a constant, a slope and nothing of the second."""


@dataclass
class Drawn:
    """Rows whose every variable is measured with an error of known variance."""

    design: Design
    x: Tensor
    measured: Tensor
    precision: Tensor

    def solution(self, hierarchy: Hierarchy) -> Solution:
        prior = hierarchy.prior(self.design)
        curvature = prior.precision + torch.diag_embed(self.precision)
        right = self.precision * self.measured + (prior.precision @ prior.mean[..., None])[..., 0]
        x = torch.linalg.solve(curvature, right)
        return Solution(x, x[:, 0], curvature, x[:, 0], torch.zeros_like(x))


def drawn(rows: int, seed: int) -> Drawn:
    rng = np.random.default_rng(seed)
    features = torch.zeros(rows, 4, 4, dtype=torch.float64)
    features[:, :2, 0] = 1.0
    features[:, 2:, 1] = 1.0
    features[:, 2:, 2:] = torch.tensor(rng.normal(size=(rows, 2, 2)))
    group = torch.tensor([0, 0, 1, 1])
    design = Design(
        features,
        group,
        wider=torch.ones(rows, 4, dtype=torch.float64),
        used=torch.ones(rows, 4, dtype=torch.float64),
        owner=torch.tensor([0, 1, 1, 1]),
        kind=torch.tensor([0, 1, 2, 3]),
        single=torch.zeros(rows, 4, dtype=torch.float64),
        tied=(1, 2),
        unit=torch.ones(2, dtype=torch.float64),
        share=torch.tensor([1.0, 1.0, 0.01, 0.01], dtype=torch.float64),
    )
    error = torch.tensor(rng.normal(size=(rows, 4))) * VARIANCE[group].sqrt()
    x = features @ COEFFICIENTS + error
    noise = torch.tensor(rng.uniform(0.2, 2.0, size=(rows, 4)))
    return Drawn(design, x, x + noise * torch.tensor(rng.normal(size=(rows, 4))), noise**-2)


def likelihood(data: Drawn, hierarchy: Hierarchy) -> Likelihood:
    return Likelihood.of(data.solution(hierarchy), hierarchy.prior(data.design))


def learned(data: Drawn) -> Hierarchy:
    first = Hierarchy.of(data.design, torch.ones(2).double(), torch.zeros(4).double())
    return first.learned(data.design, likelihood(data, first))


def test_hyperparameters_are_recovered() -> None:
    found = learned(drawn(4000, seed=0))
    torch.testing.assert_close(found.variance, VARIANCE, rtol=0.1, atol=0)
    deviation = found.covariance.diagonal().sqrt()
    assert ((found.coefficients - COEFFICIENTS).abs() < 5 * deviation).all()
    assert (deviation < 0.05).all()


def test_coefficients_have_their_closed_form() -> None:
    """Generalised least squares, with the learned variances and the shrinkage of each kind."""
    data = drawn(30, seed=1)
    found = learned(data)
    variance = found.variance[data.design.group] + 1 / data.precision
    features = data.design.features.flatten(0, 1)
    weighted = features / variance.flatten()[:, None]
    shrinkage = found.relative[data.design.kind].reciprocal()
    shrinkage[0] = 0.0
    information = features.T @ weighted + torch.diag(shrinkage)
    wanted = torch.linalg.solve(information, weighted.T @ data.measured.flatten())
    torch.testing.assert_close(found.coefficients, wanted, rtol=0.02, atol=0.02)
    torch.testing.assert_close(found.covariance, torch.linalg.inv(information), rtol=0.1, atol=2e-3)


def test_what_exact_measurements_leave_open_is_that_of_nearly_exact_ones() -> None:
    """Measured are the sum of the first two variables, and the others: curvatures of 1e6, 1e14."""
    data = drawn(30, seed=3)
    sums = torch.tensor([[1.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).double()
    first = Hierarchy.of(data.design, torch.ones(2).double(), torch.zeros(4).double())
    prior = first.prior(data.design)
    found = []
    for noise in (1e-3, 1e-7):
        # In closed form from the distribution of the sums, which has no large numbers.
        gain = sums.T @ torch.linalg.inv(sums @ sums.T + noise**2 * torch.eye(3).double())
        x = prior.mean + (data.x - prior.mean) @ sums.T @ gain.T
        curvature = (prior.precision + sums.T @ sums / noise**2).expand(30, 4, 4)
        solution = Solution(x, x[:, 0], curvature, x[:, 0], torch.zeros_like(x))
        found.append(first.learned(data.design, Likelihood.of(solution, prior)))
    torch.testing.assert_close(found[1].variance, found[0].variance, rtol=0.02, atol=0)
    torch.testing.assert_close(found[1].coefficients, found[0].coefficients, rtol=0.02, atol=0.01)


@pytest.mark.slow
def test_intervals_from_few_rows_cover() -> None:
    """Nominal 90 %: 8 rows, 200 sets. A binomial share of 6400 has a deviation of 0.004; variables
    of a set are correlated, so its 200 means are what counts, with a deviation of about 0.01."""
    covered = []
    for seed in range(200):
        data = drawn(8, seed=100 + seed)
        found = learned(data)
        mean, covariance = found.integrated(data.design, likelihood(data, found))
        deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
        covered.append(((mean - data.x).abs() < 1.645 * deviation).double().mean())
    assert 0.85 < float(torch.stack(covered).mean()) < 0.95


def test_without_features_that_count_nothing_is_lost() -> None:
    """The posterior error with three useless features is that without them, within 3 %."""
    rng = np.random.default_rng(5)
    errors = []
    for useless in (False, True):
        data = drawn(60, seed=2)
        features = data.design.features.clone()
        data.x -= features[:, :, 1:] @ COEFFICIENTS[1:]
        data.measured -= features[:, :, 1:] @ COEFFICIENTS[1:]
        features[:, :, 1:] = 0.0
        if useless:
            features[:, 2:, 1:] = torch.tensor(rng.normal(size=(60, 2, 3)))
        data.design = replace(data.design, features=features)
        found = learned(data)
        errors.append(float((data.solution(found).x - data.x).square().mean().sqrt()))
    assert errors[1] < 1.03 * errors[0]


def test_unused_variables_do_not_count() -> None:
    data = drawn(50, seed=3)
    data.measured[:, 3] += 100.0
    used, wider = data.design.used.clone(), data.design.wider.clone()
    used[:, 3], wider[:, 3] = 0.0, 1e4
    data.design = replace(data.design, wider=wider, used=used)
    found = learned(data)
    assert found.variance[1] < 3 * VARIANCE[1]


def test_variances_that_nothing_shows_stay_within_their_prior() -> None:
    """Standard deviations are half-normal beforehand, about one unit: they cannot drift away."""
    data = drawn(10, seed=6)
    first = Hierarchy.of(
        data.design, torch.ones(2).double(), torch.zeros(4).double(), Hyperprior((1.0, 4.0))
    )
    nothing = Likelihood(
        torch.zeros(10, 4, 4).double(), torch.zeros_like(data.x), torch.zeros_like(data.x)
    )
    found = first.learned(data.design, nothing)
    assert (found.variance < 1.5).all()
    assert torch.isfinite(found.integrated(data.design, nothing)[1]).all()


CONDITIONS = 6
EFFECT, ERROR, SENSOR = 1.0, 0.3, 0.05
"""Standard deviations of effects of conditions, of errors, and of the measurement."""


def replicated(runs: int, seed: int) -> Drawn:
    """Runs of six conditions of two variables each, of which a combination is measured.

    The other direction is open, and different in every condition.
    """
    rng = np.random.default_rng(seed)
    effects = EFFECT * rng.normal(size=(CONDITIONS, 2))
    x = EFFECT * rng.normal(size=2) + effects + ERROR * rng.normal(size=(runs, CONDITIONS, 2))
    features = torch.zeros(runs, CONDITIONS, 2, 2 + 2 * CONDITIONS, dtype=torch.float64)
    for u in range(2):
        features[:, :, u, u] = 1.0
        for c in range(CONDITIONS):
            features[:, c, u, 2 + 2 * c + u] = 1.0
    group = torch.arange(2).repeat(CONDITIONS)
    ones = torch.ones(runs, 2 * CONDITIONS, dtype=torch.float64)
    design = Design(
        features.flatten(1, 2),
        group,
        wider=ones,
        used=ones,
        owner=torch.cat([torch.arange(2), group]),
        kind=torch.cat([torch.ones(2), torch.full((2 * CONDITIONS,), CONDITION)]).long(),
        single=torch.zeros_like(ones),
        tied=(0, 2),
        unit=torch.ones(2, dtype=torch.float64),
        share=torch.ones(2, dtype=torch.float64),
    )
    x = torch.tensor(x).flatten(1)
    return Drawn(design, x, x + SENSOR * torch.tensor(rng.normal(size=x.shape)), ones / SENSOR**2)


def seen_directions() -> Tensor:
    """(6, 12), what is measured of the variables: one direction of each condition."""
    angle = torch.arange(CONDITIONS).double() * 0.4
    seen = torch.zeros(CONDITIONS, 2 * CONDITIONS, dtype=torch.float64)
    for c in range(CONDITIONS):
        seen[c, 2 * c], seen[c, 2 * c + 1] = angle[c].cos(), angle[c].sin()
    return seen


def of_one_direction(data: Drawn) -> Likelihood:
    seen = seen_directions()
    curvature = (seen.T @ seen / SENSOR**2).expand(len(data.x), -1, -1)
    away = (curvature @ (data.measured - data.x)[..., None])[..., 0]
    return Likelihood(curvature, data.x, away)


@pytest.mark.slow
def test_replicates_tell_nothing_of_what_none_of_them_shows() -> None:
    """Of twelve runs of the same conditions as much stays open as of two, and intervals cover.

    Nominal 90 %: 40 sets of 12 open or measured directions; 40 means have a deviation of 0.02.
    """
    width = {}
    for runs in (2, 12):
        covered, open_ = [], []
        for seed in range(40):
            data = replicated(runs, seed)
            given = of_one_direction(data)
            first = Hierarchy.of(data.design, torch.ones(2).double(), torch.zeros(14).double())
            found = first.learned(data.design, given)
            mean, covariance = found.integrated(data.design, given)
            deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
            covered.append(((mean - data.x).abs() < 1.645 * deviation).double().mean())
            away = torch.linalg.svd(seen_directions())[2][CONDITIONS:]
            open_.append((away @ covariance @ away.T).diagonal(dim1=1, dim2=2).mean().sqrt())
        width[runs] = float(torch.stack(open_).mean())
        assert 0.85 < float(torch.stack(covered).mean()) < 0.95
    # The effect alone, which errors from run to run cannot show, has a deviation of one.
    assert width[12] > 0.9 * width[2]
    assert width[12] > 0.8 * EFFECT


def test_evidence_is_that_of_the_outputs() -> None:
    """The difference of two log evidences is that of the densities of what is measured."""
    data = drawn(12, seed=4)
    first = Hierarchy.of(
        data.design, torch.ones(2).double(), torch.zeros(4).double(), Hyperprior((1.0, 4.0))
    )
    given, found = likelihood(data, first), []
    for scale in (1.0, 3.0):
        hierarchy = replace(first, variance=scale * first.variance, relative=scale * first.relative)
        own = hierarchy.relative[data.design.kind]
        own[0] = 4.0
        features = data.design.features.flatten(0, 1)
        centre = features[:, 0] * 1.0
        covariance = features @ torch.diag(own) @ features.T
        covariance += torch.diag(scale + 1 / data.precision.flatten())
        density = torch.distributions.MultivariateNormal(centre, covariance)
        log_density = float(density.log_prob(data.measured.flatten()))
        found.append(hierarchy.evidence(data.design, given) - log_density)
    assert abs(found[0] - found[1]) < 1e-6


def tied(sizes: list[float]) -> tuple[Design, Tensor]:
    """Groups of unit 1 that are tied, and their variances."""
    count = len(sizes)
    design = replace(drawn(1, seed=0).design, tied=(0, count), unit=torch.ones(count).double())
    return design, torch.tensor(sizes, dtype=torch.float64).square()


@pytest.mark.parametrize("sizes", [[0.5, 0.6, 0.5, 0.55], [0.15, 1.2, 0.3, 0.6]])
def test_how_alike_tied_groups_are_is_learned(sizes: list[float]) -> None:
    """The mean of the degrees of freedom is that of numerical integration over the level."""
    design, variance = tied(sizes)

    def density(freedom: float) -> float:
        def joint(level: float) -> float:
            scale = freedom * level**2 / 2
            each = invgamma.pdf(variance.numpy(), freedom / 2, scale=scale)
            return float(halfnorm.pdf(level) * np.prod(each))

        return quad(joint, 0.0, 10.0, points=[0.3, 0.6, 1.2], limit=200)[0]

    weight = np.array([density(each) for each in TIED])
    expected = np.exp(weight @ np.log(TIED) / weight.sum())
    assert _level(design, variance)[1] == pytest.approx(expected, rel=1e-6)


def test_groups_of_one_size_are_tied_more_closely_than_others() -> None:
    alike, unlike = (_level(*tied(each))[1] for each in ([0.5] * 4, [0.1, 0.3, 0.9, 2.7]))
    assert alike > 3 * unlike
