"""Gauss-Newton steps by a compiled kernel, for noise with Student's t: `normal.c`.

What takes time in torch is to pass through the Jacobian, of which most is zero, several times.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.compiler import c_source, call, compiled
from retwin.inference.losses import StudentT
from retwin.inference.noise import Noise
from retwin.inference.priors import GaussianPrior
from retwin.inference.problem import Problem

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["compiled_step", "library"]


def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a C compiler."""
    return _library()


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL | None:
    return compiled(c_source(__package__, "normal.c"), contract=True, quiet=True)


def compiled_step(
    problem: Problem,
    prior: GaussianPrior,
    noise: Noise,
    x: Tensor,
    linearised: tuple[Tensor, Tensor],
    damping: Tensor | None,
    limits: Sequence[Tensor],
    reweightings: int,
) -> tuple[Tensor, Tensor, Tensor] | None:
    """The end (R, P) of each step, the objective (R,) predicted there, the curvature (R, P, P).

    See `gauss_newton_step` for the arguments. `limits` are the lower and upper limits of x and the
    largest change of a step, (P,) each. None where the kernel does not apply, or equations have no
    solution.
    """
    kernel, loss, common = library(), noise.loss, problem.common
    tensors = (*linearised, x, prior.mean, prior.precision, noise.scale)
    suits = all(each.dtype == torch.float64 and each.device.type == "cpu" for each in tensors)
    graded = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    if kernel is None or not isinstance(loss, StudentT) or not suits or graded or not x.numel():
        return None
    residual, jacobian = linearised
    rows, samples, outputs, size = jacobian.shape
    there, objective = np.empty((rows, size)), np.empty(rows)
    curvature, done = np.empty((rows, size, size)), np.empty(rows, np.uint8)
    given = (
        np.ascontiguousarray(problem.group.numpy(), np.int64),
        _doubles(problem.measured),
        None if common is None else _doubles(common.variance),
        None if common is None else _doubles(common.block),
        *map(_doubles, (residual, jacobian, x, prior.mean, prior.precision)),
        None if damping is None else _doubles(damping),
    )
    call(
        kernel,
        "gauss_newton",
        (rows, samples, outputs, size, noise.scale.shape[1], reweightings),
        loss.freedom,
        [*map(_doubles, (noise.scale, noise.thinning, *limits))],
        (*given, there, objective, curvature, done),
    )
    if not done.all():
        return None
    return torch.from_numpy(there), torch.from_numpy(objective), torch.from_numpy(curvature)


def _doubles(values: Tensor) -> NDArray:
    return np.ascontiguousarray(values.detach().numpy(), np.float64)
