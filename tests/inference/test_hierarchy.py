"""A prior whose mean is a regression: closed forms, recovery, and honest intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from retwin.inference.hierarchy import Design, Hierarchy
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
    )
    error = torch.tensor(rng.normal(size=(rows, 4))) * VARIANCE[group].sqrt()
    x = features @ COEFFICIENTS + error
    noise = torch.tensor(rng.uniform(0.2, 2.0, size=(rows, 4)))
    return Drawn(design, x, x + noise * torch.tensor(rng.normal(size=(rows, 4))), noise**-2)


def learned(data: Drawn) -> Hierarchy:
    first = Hierarchy.of(data.design, torch.ones(2).double(), torch.zeros(4).double())
    return first.learned(data.design, data.solution(first), torch.ones(2).double())


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
    shrinkage = (found.relative[data.design.kind] * found.variance[data.design.owner]).reciprocal()
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
        found.append(first.learned(data.design, solution, torch.ones(2).double()))
    torch.testing.assert_close(found[1].variance, found[0].variance, rtol=0.02, atol=0)
    torch.testing.assert_close(found[1].coefficients, found[0].coefficients, rtol=0.02, atol=0.01)


def test_intervals_from_few_rows_cover() -> None:
    """Nominal 90 %: 8 rows, 200 sets. A binomial share of 6400 has a deviation of 0.004; variables
    of a set are correlated, so its 200 means are what counts, with a deviation of about 0.01."""
    covered = []
    for seed in range(200):
        data = drawn(8, seed=100 + seed)
        found = learned(data)
        solution = data.solution(found)
        covariance = found.posterior_covariance(data.design, solution)
        deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
        covered.append(((solution.x - data.x).abs() < 1.645 * deviation).double().mean())
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
        data.design = Design(
            features, data.design.group, data.design.wider, data.design.used,
            data.design.owner, data.design.kind,
        )  # fmt: skip
        found = learned(data)
        errors.append(float((data.solution(found).x - data.x).square().mean().sqrt()))
    assert errors[1] < 1.03 * errors[0]


def test_unused_variables_do_not_count() -> None:
    data = drawn(50, seed=3)
    data.measured[:, 3] += 100.0
    used, wider = data.design.used.clone(), data.design.wider.clone()
    used[:, 3], wider[:, 3] = 0.0, 1e4
    data.design = Design(
        data.design.features, data.design.group, wider, used, data.design.owner, data.design.kind
    )
    found = learned(data)
    assert found.variance[1] < 3 * VARIANCE[1]
