"""Student's t in place of the normal distribution, compared with scipy's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from retwin.nets.flows import FlowHead
from retwin.nets.mixtures import GaussianMixture
from retwin.nets.student import Student, shared_factor
from retwin.nets.training import isolated

pytestmark = pytest.mark.numerical

DEGREES = [1.0, 1.6, 4.0, 30.0]
SIGMA = 0.5


def normal(size: int = 1) -> GaussianMixture:
    """A normal distribution of mean 2 and standard deviation `SIGMA`, as a mixture."""
    return GaussianMixture(
        torch.zeros(1), torch.full((1, size), 2.0), SIGMA * torch.eye(size)[None]
    )


def bimodal() -> GaussianMixture:
    means = torch.tensor([[-1.0, 0.0], [2.0, 1.0]])
    factors = torch.tensor([[[0.5, 0.0], [0.2, 0.3]], [[0.2, 0.0], [-0.4, 0.6]]])
    return GaussianMixture(torch.tensor([0.3, -0.4]), means, factors)


@pytest.mark.parametrize("degrees", DEGREES)
def test_a_normal_distribution_becomes_student_s(degrees: float) -> None:
    """Density and probabilities within the 99 % interval."""
    exact = stats.t(degrees, loc=2.0, scale=SIGMA)
    value = np.linspace(*exact.interval(0.99), 201)
    student = Student(normal(), degrees)
    given = torch.tensor(value, dtype=torch.float32)[:, None]
    score = student.normal_scores(given)[:, 0].numpy()
    np.testing.assert_allclose(stats.norm.cdf(score), exact.cdf(value), atol=2e-3)
    middle = np.abs(value - 2.0) < exact.interval(0.95)[1] - 2.0
    density = student.log_prob(given).numpy()
    np.testing.assert_allclose(density[middle], exact.logpdf(value)[middle], atol=0.05)
    # Far out the largest factor ends it.
    assert (density <= exact.logpdf(value) + 0.1).all()


@pytest.mark.parametrize("degrees", DEGREES)
def test_the_normal_one_beside_it_has_intervals_as_wide(degrees: float) -> None:
    equal = Student(normal(), degrees).normal
    ends = torch.tensor(stats.t(degrees, loc=2.0, scale=SIGMA).interval(0.9))[:, None]
    score = equal.normal_scores(ends.float())[:, 0].numpy()
    np.testing.assert_allclose(score, [-1.6449, 1.6449], atol=1e-3)


def test_a_known_width_changes_nothing() -> None:
    block, student = bimodal(), Student(bimodal(), np.inf)
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(50, 2, generator=generator)
    torch.testing.assert_close(student.log_prob(value), block.log_prob(value))
    scores = student.normal_scores(value), block.normal_scores(value)
    torch.testing.assert_close(*scores, atol=1e-3, rtol=0)
    torch.testing.assert_close(student.variance, block.variance)


@pytest.mark.parametrize("degrees", DEGREES)
def test_draws_have_its_distribution(degrees: float) -> None:
    """The PIT of draws is uniform, and as many are in a box as their density states."""
    generator = torch.Generator().manual_seed(0)
    student = Student(bimodal(), degrees).expand((4000,))
    uniform = torch.rand(4000, generator=generator)
    drawn = student.from_noise(uniform, torch.randn(4000, 2, generator=generator))
    for score in student.normal_scores(drawn).T.numpy():
        assert stats.kstest(score, "norm").pvalue > 1e-3
    # The density of a box, by the midpoints of its cells.
    cells = torch.cartesian_prod(torch.linspace(-1.49, 1.49, 150), torch.linspace(-0.99, 0.99, 100))
    box = float(Student(bimodal(), degrees).log_prob(cells).exp().mean()) * 6.0
    inside = (drawn[:, 0].abs() < 1.5) & (drawn[:, 1].abs() < 1.0)
    assert float(inside.float().mean()) == pytest.approx(box, abs=4 * (0.25 / 4000) ** 0.5)


def test_a_flow_becomes_heavy_tailed_too() -> None:
    """The PIT of draws is uniform, and the density is the derivative of the distribution."""
    with isolated(0):
        head = FlowHead(3, 1, transforms=1, bins=4)
    flow = head(torch.ones(3), torch.tensor([1.0]), torch.tensor([2.0]))
    generator = torch.Generator().manual_seed(0)
    student = Student(flow, 2.0)
    with torch.no_grad():
        uniform = torch.rand(2000, generator=generator)
        noise = torch.randn(2000, 1, generator=generator)
        drawn = student.expand((2000,)).from_noise(uniform, noise)
        value = torch.linspace(-5.0, 7.0, 2001)[:, None]
        level = torch.special.ndtr(student.normal_scores(value))[:, 0]
        density = student.log_prob(value).exp()
    assert stats.kstest(student.normal_scores(drawn)[:, 0].detach(), "norm").pvalue > 1e-3
    area = torch.cumulative_trapezoid(density, value[:, 0])
    torch.testing.assert_close(level[1:] - level[0], area, atol=2e-3, rtol=0)


def test_segments_of_a_trajectory_share_the_factor() -> None:
    """Given the same normal noise, deviations of two segments are equal, of trajectories not."""
    generator = torch.Generator().manual_seed(0)
    student = Student(normal(2), 3.0).expand((500, 2))
    shared = torch.rand(500, 1, 1, generator=generator)
    uniform = shared_factor(shared, torch.rand(500, 2, 1, generator=generator))[..., 0]
    deviation = student.from_noise(uniform, torch.ones(500, 2, 2)) - 2.0
    assert torch.equal(deviation, deviation[:, :1, :1].expand(500, 2, 2))
    assert len(deviation[:, 0, 0].unique()) > 50
    exact = np.sqrt(3.0 / stats.chi2(3.0).ppf([0.75, 0.25]))
    found = np.quantile(deviation[:, 0, 0].numpy() / SIGMA, [0.25, 0.75])
    np.testing.assert_allclose(found, exact, rtol=0.15)
