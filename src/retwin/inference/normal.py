"""Gauss-Newton steps by a compiled kernel, for noise with Student's t: `normal.c`.

What takes time in torch is to pass through the Jacobian, of which most is zero, several times.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.compiler import call, compiled_files
from retwin.inference.noise import Noise, StudentT
from retwin.inference.problem import GaussianPrior, Problem

if TYPE_CHECKING:
    from collections.abc import Sequence


def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a C compiler."""
    return compiled_files(__package__, "normal.c", contract=True)


def compiled_step(
    problem: Problem,
    prior: GaussianPrior,
    noise: Noise,
    x: Tensor,
    linearised: tuple[Tensor, Tensor],
    damping: Tensor | None,
    limits: Sequence[Tensor],
    reweightings: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """The numbers of a `GaussNewtonStep`.

    See `gauss_newton_step` for the arguments. `limits` are the lower and upper limits of x and the
    largest change of a step, (P,) each. None where the kernel does not apply, or equations have no
    solution.
    """
    kernel, loss = library(), noise.loss
    if kernel is None or not isinstance(loss, StudentT) or not _suits(prior, noise, x, *linearised):
        return None
    residual, jacobian = linearised
    rows, samples, outputs, size = jacobian.shape
    there, objective = np.empty((rows, size)), np.empty(rows)
    curvature, determinant = np.empty((rows, size, size)), np.empty(rows)
    done = np.empty(rows, np.uint8)
    tensors = residual, jacobian, x, prior.mean, prior.precision
    damped = None if damping is None else doubles(damping)
    given = (*_samples(problem), *map(doubles, tensors), damped)
    sizes = rows, samples, outputs, size, noise.scale.shape[1], reweightings
    common = [*map(doubles, (noise.scale, noise.thinning, *limits))]
    made = there, objective, curvature, determinant
    call(kernel, "gauss_newton", sizes, loss.freedom, common, (*given, *made, done))
    if not done.all():
        return None
    return tuple(map(torch.from_numpy, made))  # type: ignore[return-value]


def compiled_objective(
    problem: Problem, prior: GaussianPrior, noise: Noise, x: Tensor, residual: Tensor
) -> Tensor | None:
    """The objective (R,) at x (R, P), with the residual (R, K, d) there; see `Solution`.

    None where the kernel does not apply.
    """
    kernel, loss = library(), noise.loss
    if kernel is None or not isinstance(loss, StudentT) or not _suits(prior, noise, x, residual):
        return None
    rows, samples, outputs = residual.shape
    objective = np.empty(rows)
    given = map(doubles, (residual, x, prior.mean, prior.precision))
    sizes = rows, samples, outputs, x.shape[1], noise.scale.shape[1]
    common = [doubles(noise.scale), doubles(noise.thinning)]
    call(kernel, "objectives", sizes, loss.freedom, common, (*_samples(problem), *given, objective))
    return torch.from_numpy(objective)


def _suits(prior: GaussianPrior, noise: Noise, x: Tensor, *others: Tensor) -> bool:
    """Whether all numbers are in double precision on the processor, and no gradient is wanted."""
    tensors = (*others, x, prior.mean, prior.precision, noise.scale)
    graded = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    doubles = all(each.dtype == torch.float64 and each.device.type == "cpu" for each in tensors)
    return doubles and not graded and x.numel() > 0


def _samples(problem: Problem) -> tuple[NDArray | None, ...]:
    """Group and share of every sample, and what is known of its error."""
    common = problem.common
    return (
        np.ascontiguousarray(problem.group.numpy(), np.int64),
        doubles(problem.measured),
        None if common is None else doubles(common.variance),
        None if common is None else doubles(common.block),
    )


def doubles(values: Tensor) -> NDArray:
    """The numbers in double precision, as kernels take them."""
    return np.ascontiguousarray(values.detach().numpy(), np.float64)
