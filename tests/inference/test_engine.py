"""The engine where the answer is known: closed forms, and scipy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.stats import multivariate_normal, multivariate_t, norm
from torch import Tensor

from retwin.inference import solver
from retwin.inference.noise import Noise, StudentT, Tukey, common_rounding, correlation_time
from retwin.inference.problem import GaussianPrior
from retwin.inference.solver import Bounds, Solution, added_evidence, best_per_row, solve

pytestmark = pytest.mark.numerical

GAUSSIAN = StudentT(1e9)
"""So many degrees of freedom that nothing is an outlier."""


@dataclass(frozen=True, eq=False)
class Linear:
    """Outputs are a design matrix times x, bent a little if `curve` is not 0."""

    design: Tensor  # (R, K, d, P)
    observed: Tensor  # (R, K, d)
    group: Tensor
    measured: Tensor
    curve: float = 0.0
    common: None = None

    @classmethod
    def drawn(cls, rows: int, samples: int, *, seed: int, size: int = 2, latent: int = 3) -> Linear:
        rng = np.random.default_rng(seed)
        shape = (rows, samples)
        return cls(
            torch.tensor(rng.normal(size=(*shape, size, latent))),
            torch.tensor(rng.normal(size=(*shape, size))),
            torch.zeros(shape, dtype=torch.long),
            torch.ones(shape, dtype=torch.float64),
        )

    def __getitem__(self, rows: Tensor) -> Linear:
        parts = (self.design, self.observed, self.group, self.measured)
        return Linear(*(each[rows] for each in parts), self.curve)

    def residual(self, x: Tensor) -> Tensor:
        linear = torch.einsum("nkdp,np->nkd", self.design, x)
        return self.observed - linear - self.curve * linear.sin()

    def linearised(self, x: Tensor) -> tuple[Tensor, Tensor]:
        linear = torch.einsum("nkdp,np->nkd", self.design, x)
        return self.residual(x), (1 + self.curve * linear.cos())[..., None] * self.design


def prior_of(rows: int, *, seed: int, latent: int = 3) -> GaussianPrior:
    root = np.random.default_rng(seed).normal(size=(rows, latent, latent))
    covariance = torch.tensor(root @ root.transpose(0, 2, 1) + 0.3 * np.eye(latent))
    return GaussianPrior.of(torch.full((rows, latent), 0.4, dtype=torch.float64), covariance)


def noise_of(scale: float, loss: StudentT | Tukey) -> Noise:
    return Noise(torch.full((1, 2), scale, dtype=torch.float64), torch.ones(1).double(), loss)


def test_a_linear_gaussian_problem_has_its_closed_form() -> None:
    """Posterior mean, covariance, and differences of log evidence."""
    problem, prior, noise = Linear.drawn(4, 6, seed=0), prior_of(4, seed=1), noise_of(0.7, GAUSSIAN)
    found = solve(problem, prior, noise, torch.zeros(4, 3, dtype=torch.float64))
    for i in range(4):
        design = problem.design[i].flatten(0, 1).numpy()
        observed, mean = problem.observed[i].flatten().numpy(), prior.mean[i].numpy()
        precision = prior.precision[i].numpy()
        covariance = np.linalg.inv(precision + design.T @ design / 0.49)
        wanted = covariance @ (precision @ mean + design.T @ observed / 0.49)
        deviation = np.sqrt(np.diag(covariance))
        np.testing.assert_array_less(np.abs(found.x[i].numpy() - wanted), 0.02 * deviation)
        np.testing.assert_allclose(found.covariance[i], covariance, rtol=1e-5, atol=1e-7)
        whole = design @ np.linalg.inv(precision) @ design.T + 0.49 * np.eye(12)
        evidence = multivariate_normal(design @ mean, whole).logpdf(observed)
        # The engine leaves out the density of the noise at 0.
        wanted = evidence - 12 * norm(scale=0.7).logpdf(0)
        np.testing.assert_allclose(found.evidence[i], wanted, atol=1e-3)


@pytest.mark.parametrize("curve", [0.0, 0.5])
def test_robust_regression_is_that_of_scipy(curve: float) -> None:
    """The mode of Student's t likelihood times the prior, with gross outliers."""
    problem = replace(Linear.drawn(3, 30, seed=2), curve=curve)
    problem.observed[:, ::7] += 8.0
    prior, noise = prior_of(3, seed=3), noise_of(0.5, StudentT(4.0))
    found = solve(problem, prior, noise, prior.mean)
    student = multivariate_t(np.zeros(2), 0.25 * np.eye(2), df=4)
    at_zero = student.logpdf(np.zeros(2))
    for i in range(3):
        one = torch.tensor([i])
        covariance = np.linalg.inv(prior.precision[i].numpy())
        gaussian = multivariate_normal(prior.mean[i].numpy(), covariance)

        def objective(x: np.ndarray, one: Tensor = one, gaussian=gaussian) -> float:
            residual = problem[one].residual(torch.tensor(x)[None])[0].numpy()
            misfit = (at_zero - student.logpdf(residual)).sum()
            return misfit - gaussian.logpdf(x) + gaussian.logpdf(gaussian.mean)

        wanted = minimize(objective, found.x[i].numpy(), tol=1e-10)
        np.testing.assert_allclose(found.objective[i], objective(found.x[i].numpy()), rtol=1e-9)
        assert found.objective[i] - wanted.fun < 1e-3
        deviation = found.covariance[i].diagonal().sqrt().numpy()
        np.testing.assert_array_less(np.abs(found.x[i].numpy() - wanted.x), 0.05 * deviation)


def test_extrapolated_steps_are_fewer_and_end_no_higher(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reweighting converges linearly where a fifth of the samples are outliers."""
    problem, prior = Linear.drawn(20, 40, seed=8), prior_of(20, seed=9)
    problem.observed[:, ::5] += 3.0
    steps: list[int] = []
    plain = Linear.linearised

    def counted(self: Linear, x: Tensor) -> tuple[Tensor, Tensor]:
        steps[-1] += len(x)
        return plain(self, x)

    monkeypatch.setattr(Linear, "linearised", counted)
    objectives = []
    for ratio in (0.0, solver.LARGEST_RATIO):
        monkeypatch.setattr(solver, "LARGEST_RATIO", ratio)
        steps.append(0)
        noise = noise_of(0.3, StudentT(1.0))
        objectives.append(solve(problem, prior, noise, prior.mean, reweightings=1).objective)
    assert steps[1] < 0.8 * steps[0]
    assert float((objectives[1] - objectives[0]).max()) < 1e-3


@pytest.mark.parametrize("loss", [StudentT(4.0), StudentT(1.5), Tukey()])
def test_weights_are_derivatives_of_the_loss(loss: StudentT | Tukey) -> None:
    square = torch.linspace(0.01, 40.0, 50, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss.value(square, 3).sum(), square)
    weight = loss.weight(square.detach(), 3)
    torch.testing.assert_close(2 * slope, weight, rtol=1e-6, atol=1e-9)


def test_the_expected_loss_is_the_mean_over_draws() -> None:
    draws = multivariate_t(np.zeros(3), np.eye(3), df=4).rvs(400_000, random_state=0)
    square = torch.tensor((draws**2).sum(axis=1))
    loss = StudentT(4.0)
    np.testing.assert_allclose(loss.value(square, 3).mean(), loss.expected(3), rtol=5e-3)


def test_bounds_hold_and_unmeasured_samples_do_not_count() -> None:
    problem, prior = Linear.drawn(2, 20, seed=4), prior_of(2, seed=5)
    noise = noise_of(0.5, StudentT(4.0))
    infinite = torch.full((3,), torch.inf, dtype=torch.float64)
    low = torch.tensor([0.9, -torch.inf, -torch.inf], dtype=torch.float64)
    bounds = Bounds(low, infinite, 0.2 * torch.ones(3, dtype=torch.float64))
    start = torch.ones(2, 3, dtype=torch.float64)
    assert (solve(problem, prior, noise, start, bounds=bounds).x[:, 0] >= 0.9).all()
    none = replace(problem, measured=torch.zeros_like(problem.measured))
    found = solve(none, prior, noise, start)
    torch.testing.assert_close(found.x, prior.mean, rtol=0, atol=0.02)
    torch.testing.assert_close(found.covariance, torch.linalg.inv(prior.precision))
    torch.testing.assert_close(found.evidence, torch.zeros(2).double(), rtol=0, atol=1e-3)


def test_the_gradient_is_that_of_the_objective_at_a_limit() -> None:
    problem, prior = replace(Linear.drawn(3, 20, seed=4), curve=0.5), prior_of(3, seed=5)
    noise = noise_of(0.5, StudentT(4.0))
    infinite = torch.full((3,), torch.inf, dtype=torch.float64)
    low = torch.tensor([0.9, -torch.inf, -torch.inf], dtype=torch.float64)
    start = torch.ones(3, 3, dtype=torch.float64)
    found = solve(problem, prior, noise, start, bounds=Bounds(low, infinite, infinite))
    x = found.x.clone().requires_grad_()
    objective = noise.misfit(problem, problem.residual(x)).sum() + prior.energy(x).sum()
    (expected,) = torch.autograd.grad(objective, x)
    torch.testing.assert_close(found.gradient, expected, rtol=1e-6, atol=1e-6)
    assert (found.gradient[:, 0] > 1).all(), "each row is kept from its optimum"
    assert not solve(problem, prior, noise, start).gradient.any()


def test_the_gradient_is_that_of_the_objective_where_steps_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Hyperparameters are learned from it, and took what had not converged for an optimum."""
    monkeypatch.setattr(solver, "MAX_STEPS", 1)
    problem, prior = replace(Linear.drawn(3, 20, seed=4), curve=0.9), prior_of(3, seed=5)
    noise, start = noise_of(0.01, StudentT(4.0)), torch.ones(3, 3, dtype=torch.float64)
    found = solve(problem, prior, noise, start)
    x = found.x.clone().requires_grad_()
    objective = noise.misfit(problem, problem.residual(x)).sum() + prior.energy(x).sum()
    (expected,) = torch.autograd.grad(objective, x)
    assert expected.abs().max() > 1
    torch.testing.assert_close(found.gradient, expected)


def test_rows_do_not_depend_on_each_other() -> None:
    problem, prior = replace(Linear.drawn(5, 20, seed=6), curve=0.5), prior_of(5, seed=7)
    noise = noise_of(0.3, StudentT(4.0))
    together = solve(problem, prior, noise, prior.mean)
    for i in range(5):
        row = torch.tensor([i])
        alone = solve(problem[row], prior[row], noise, prior.mean[row])
        torch.testing.assert_close(alone.x, together.x[row], rtol=0, atol=1e-9)
        torch.testing.assert_close(alone.evidence, together.evidence[row], rtol=0, atol=1e-9)


def test_hopeless_rows_are_given_up() -> None:
    problem, prior = replace(Linear.drawn(2, 20, seed=8), curve=0.9), prior_of(2, seed=9)
    noise = noise_of(0.1, StudentT(4.0))
    start = prior.mean + 3.0
    whole = solve(problem, prior, noise, start)
    wanted = whole.evidence + torch.tensor([1e4, -1e4])
    found = solve(problem, prior, noise, start, minimum_evidence=wanted)
    assert found.evidence[0] == -torch.inf
    torch.testing.assert_close(found.evidence[1], whole.evidence[1])


def test_noise_is_learned_by_group() -> None:
    """Scales of two outputs in two groups, one of them correlated in time."""
    rng = np.random.default_rng(10)
    rows, samples = 40, 200
    error = rng.normal(size=(rows, samples, 2)) * [0.3, 2.0]
    for k in range(1, 100):  # the first half of each row, a first-order autoregression
        error[:, k] = 0.6 * error[:, k - 1] + 0.8 * error[:, k]
    error[:, 100:] *= 3.0
    problem = replace(
        Linear.drawn(rows, samples, seed=0),
        group=(torch.arange(samples) >= 100).long().expand(40, -1),
    )
    residual = torch.tensor(error)
    noise = replace(Noise.from_median(problem, residual, groups=2), loss=GAUSSIAN)
    for _ in range(20):
        noise = noise.learned(problem, residual, common=0.1, blocks=400)
    wanted = torch.tensor([[0.3, 2.0], [0.9, 6.0]], dtype=torch.float64)
    torch.testing.assert_close(noise.scale, wanted, rtol=0.05, atol=0)
    # Of the 4000 samples of each group ten make a block, which has a common error besides.
    np.testing.assert_allclose(noise.thinning, [1.6 / 0.4 + 1.0, 1.0 + 1.0], rtol=0.1)


def test_a_group_without_samples_keeps_its_scale() -> None:
    problem = Linear.drawn(3, 10, seed=1)
    noise = Noise(torch.ones(2, 2).double(), torch.ones(2).double())
    residual = 5 * problem.observed
    found = noise.learned(problem, residual, common=0.0, blocks=1)
    assert (found.scale[0] > 1.5).all()
    assert found.scale[1].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.1, 0.2, 0.4])
def test_what_noise_leaves_of_a_rounding_error_is_that_of_simulations(noise: float) -> None:
    rng = np.random.default_rng(0)
    constant = rng.uniform(size=3000)
    samples = np.round(constant[:, None] + noise * rng.normal(size=(3000, 1500)))
    common = float(np.mean((samples.mean(axis=1) - constant) ** 2))
    within = torch.tensor(samples.var(axis=1).mean())
    assert abs(float(common_rounding(within, 1 / 12)) - common) < 0.004


def test_correlation_of_rows_or_of_all() -> None:
    values = torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, 1.0, -1.0]]).double()[..., None]
    counted = torch.ones(2, 4)
    each = correlation_time(values, counted, rows=True, limit=0.9)
    torch.testing.assert_close(each, torch.tensor([1.9 / 0.1, 1.0]).double())
    assert correlation_time(values, counted, rows=False, limit=0.9) == 1.0


def test_evidence_of_alternatives() -> None:
    rows = torch.tensor([2, 0, 2, 0, 0])
    evidence = torch.tensor([1.0, 5.0, 3.0, -torch.inf, 4.0]).double()
    different, best = best_per_row(evidence, rows)
    assert (different.tolist(), best.tolist()) == ([0, 2], [1, 2])
    total = added_evidence(torch.tensor([2.0, 7.0, 0.0]).double(), evidence, rows)
    wanted = np.log([np.exp([2, 5, 4]).sum(), np.exp(7), np.exp([0, 1, 3]).sum()])
    np.testing.assert_allclose(total, wanted)


def test_solutions_are_joined_by_rows() -> None:
    prior = prior_of(3, seed=0)
    whole = Solution.of_prior(prior, torch.ones(3, 3).double())
    part = Solution.of_prior(prior[torch.tensor([1])], torch.zeros(1, 3).double())
    made = whole.put(torch.tensor([1]), part)
    assert made.x.tolist() == [[1.0] * 3, [0.0] * 3, [1.0] * 3]
    assert made.objective[1] == part.objective[0]
    assert whole.x.tolist() == [[1.0] * 3] * 3
