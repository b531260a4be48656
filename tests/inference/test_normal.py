"""Compiled Gauss-Newton steps are those of the same function in torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from retwin.inference import normal
from retwin.inference.noise import Noise, Tukey
from retwin.inference.problem import CommonError, GaussianPrior
from retwin.inference.solver import Bounds, GaussNewtonStep, gauss_newton_step

pytestmark = pytest.mark.skipif(normal.library() is None, reason="there is no C compiler")

ROWS, SAMPLES, OUTPUTS, SIZE = 4, 50, 3, 6


@dataclass(frozen=True)
class Posed:
    """The parts of a problem that a step uses."""

    group: Tensor
    measured: Tensor
    common: CommonError | None


def posed(*, shared: bool, common: bool) -> tuple[Posed, GaussianPrior, Noise, Tensor, Any]:
    """A problem with outliers, samples that were not measured, and a Jacobian with zeros."""
    draw = torch.Generator().manual_seed(0)

    def normals(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=draw)

    group = (normals(ROWS, SAMPLES) > 0).long()
    measured = (normals(ROWS, SAMPLES) > -1).double()
    error = CommonError(normals(ROWS, SAMPLES, OUTPUTS).square(), torch.full_like(measured, 9.0))
    scale = normals(2, 1 if shared else OUTPUTS).abs() + 0.1
    noise = Noise(scale, torch.tensor([1.0, 3.0], dtype=torch.float64))
    root = normals(ROWS, SIZE, SIZE)
    covariance = root @ root.mT + 0.1 * torch.eye(SIZE, dtype=torch.float64)
    prior = GaussianPrior.of(normals(ROWS, SIZE), covariance)
    jacobian = normals(ROWS, SAMPLES, OUTPUTS, SIZE)
    jacobian[:, : SAMPLES // 2, :, : SIZE // 2] = 0.0
    jacobian[:, -9:] = 0.0
    residual = normals(ROWS, SAMPLES, OUTPUTS)
    residual[:, ::7] *= 30.0
    problem = Posed(group, measured, error if common else None)
    return problem, prior, noise, normals(ROWS, SIZE), (residual, jacobian)


def both(
    monkeypatch: pytest.MonkeyPatch, *given: Any, **options: Any
) -> tuple[GaussNewtonStep, GaussNewtonStep]:
    fast = gauss_newton_step(*given, **options)
    with monkeypatch.context() as patch:
        patch.setattr(normal, "library", lambda: None)
        return fast, gauss_newton_step(*given, **options)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("common", [False, True])
@pytest.mark.parametrize("limited", [False, True])
def test_steps_are_those_in_torch(
    monkeypatch: pytest.MonkeyPatch, shared: bool, common: bool, limited: bool
) -> None:
    given = posed(shared=shared, common=common)
    limit = torch.full((SIZE,), 0.3, dtype=torch.float64)
    options = (
        {"bounds": Bounds(-limit, 2 * limit, limit), "damping": limit[:ROWS], "reweightings": 2}
        if limited
        else {}
    )
    fast, slow = both(monkeypatch, *given, **options)
    for found, expected in zip(vars(fast).values(), vars(slow).values(), strict=True):
        assert torch.allclose(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("common", [False, True])
def test_objectives_are_those_in_torch(shared: bool, common: bool) -> None:
    problem, prior, noise, x, (residual, _) = posed(shared=shared, common=common)
    found = normal.compiled_objective(problem, prior, noise, x, residual)
    assert found is not None
    expected = noise.misfit(problem, residual).sum(dim=1) + prior.energy(x)
    assert torch.allclose(found, expected, rtol=1e-12)


def test_what_the_kernel_cannot_do_is_left_to_torch() -> None:
    problem, prior, noise, x, linearised = posed(shared=True, common=False)
    free = torch.full((SIZE,), torch.inf, dtype=torch.float64)
    limits = (-free, free, free)

    def made(noise: Noise = noise, x: Tensor = x, linearised: Any = linearised) -> object:
        return normal.compiled_step(problem, prior, noise, x, linearised, None, limits, 3)

    assert made() is not None
    assert made(noise=Noise(noise.scale, noise.thinning, Tukey())) is None
    assert made(x=x.float()) is None
    assert made(linearised=(linearised[0] * torch.nan, linearised[1])) is None
