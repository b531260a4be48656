"""Generation by compiled kernels, for surrogates without memory in single precision.

Every function has the arguments of its counterpart in torch, or gives None where it does not apply:
no C compiler, a gradient, another precision, another kind of network. Results differ from torch's
by the rounding of single precision.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.compiler import call, compiled_files
from retwin.data.segments import Segments
from retwin.inference.normal import doubles
from retwin.update.piecewise_linear import TOLERANCE

SOURCES = ("network.c", "pieces.c", "warp.c", "linearised.c")
OUTPUTS = 6
"""Outputs of a layer that are computed together, as in `network.c`."""


def library() -> ctypes.CDLL | None:
    """The compiled kernels; None without a C compiler, and where torch traces a graph."""
    graph = torch.compiler.is_compiling() or torch.jit.is_tracing()
    return None if graph else compiled_files(__package__, *SOURCES, contract=True)


def along_pieces(surrogate: Any, commands: NDArray) -> NDArray | None:
    """The outputs (n, T, d_y) of a surrogate; see `evaluate_piecewise_linear`."""
    kernel, packed = library(), _pack(surrogate)
    if kernel is None or packed is None or commands.shape[1] < 2 or not len(commands):
        return None
    values = np.ascontiguousarray(commands, np.float32)
    out = np.empty((*values.shape[:2], len(packed[2])), np.float32)
    # Points of a ramp per standard deviation of the commands that it covers, beyond five; too few
    # are found out, and cost a second evaluation. With 3 the default network of the arm takes least
    # time.
    call(kernel, "pieces", values.shape[:2], 3.0, packed, (values, out))
    return out


def at_effective_commands(context: Any, z: Tensor, when: Tensor) -> Tensor | None:
    """The outputs (n, S, d_y) at the samples `when` (n, S) of effective commands of a `Context`."""
    reference, segments, frozen = context.faulty_commands, context.segments, context.frozen
    kernel, packed = library(), _pack(context.surrogate)
    plain = _plain(reference, z) and not when.is_floating_point() and len(reference) == len(z)
    if kernel is None or packed is None or not plain or not reference.numel():
        return None
    n, steps, _ = reference.shape
    out = np.empty((n, when.shape[1], len(packed[2])), np.float32)
    size = reference.abs().amax(dim=0).amax(dim=0).double().numpy()
    rows = (_floats(reference), *_times(segments), _floats(z), *map(doubles, (frozen, when)), out)
    sizes = (n, steps, segments.max_count, when.shape[1])
    call(kernel, "executed", sizes, 0.0, (*packed[:2], size), rows)
    return torch.from_numpy(out)


def jacobians(surrogate: Any, commands: Tensor) -> Tensor | None:
    """The Jacobians (k, d_y, d_u) of a surrogate's outputs at commands (k, d_u).

    None depends on the others. Of a surrogate in double precision that has the attribute `single`,
    these are the derivatives of that one.
    """
    kernel, packed = library(), _pack(getattr(surrogate, "single", surrogate))
    if kernel is None or packed is None or not commands.numel():
        return None
    shape = len(commands), len(packed[2])
    outputs = np.empty(shape, np.float32)
    found = np.empty((*shape, commands.shape[1]), np.float32)
    call(kernel, "slopes", shape[:1], 0.0, packed[:2], (_floats(commands), outputs, found))
    return torch.from_numpy(found)


def effective_commands_at(
    reference: Tensor, segments: Segments, z: Tensor, times: Tensor, frozen: Tensor
) -> Tensor | None:
    """The effective commands (n, S, d_u) in double precision; see `effective_commands`."""
    kernel, tensors = library(), (reference, z, times, frozen)
    graded = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    suits = z.dtype == torch.float64 and z.is_cpu
    if kernel is None or graded or not suits or not times.numel():
        return None
    if bool((times[:, 1:] < times[:, :-1]).any()):  # the kernel takes times in order
        return None
    n, samples = times.shape
    out = np.empty((n, samples, reference.shape[2]))
    size = reference.abs().amax(dim=0).amax(dim=0).clamp_min(1e-12)
    source = np.arange(n) * len(reference) // n
    rows = (source, *_times(segments), *map(doubles, (z, frozen, times)), out)
    sizes = (n, reference.shape[1], segments.max_count, samples, reference.shape[2])
    call(kernel, "commands", sizes, 0.0, (doubles(size), doubles(reference)), rows)
    return torch.from_numpy(out)


def linearised_outputs(problem: Any, x: Tensor, step: float) -> tuple[Tensor, Tensor] | None:
    """The outputs that a `CommandProblem` predicts, and their Jacobian by x.

    Finite differences of the commands have the step `step`.

    Returns
    -------
    Tensor
        (n, S, d_y), the outputs in `unit`, which the network computes in single precision. None
        depends on the other trajectories.
    Tensor
        (n, S, d_y, P), the derivatives of the outputs in `unit`.

    """
    kernel, packed = library(), _pack(getattr(problem.surrogate, "single", problem.surrogate))
    (n, samples), reference = problem.sample.shape, problem.reference
    suits = x.dtype == torch.float64 and x.numel() and samples
    if kernel is None or packed is None or not suits:
        return None
    found = np.empty((n, samples, len(packed[2])))
    jacobian = np.empty((*found.shape, x.shape[1]))
    size = reference.abs().amax(dim=0).amax(dim=0).clamp_min(1e-12)
    sizes = n, reference.shape[1], problem.segments.max_count, samples, int(problem.own_delays)
    common = (*packed[:2], doubles(size), doubles(problem.unit))
    rows = map(doubles, (x, problem.missed, problem.frozen, problem.sample))
    given = (doubles(reference), *_times(problem.segments), *rows)
    call(kernel, "linearised", sizes, step, common, (*given, found, jacobian))
    return torch.from_numpy(found), torch.from_numpy(jacobian)


def delayed_path(segments: Segments, path: Tensor, z: Tensor) -> Tensor | None:
    """The path (n, T, d_y), delayed and offset by z (n, M, 1 + d_y); see `path_at`."""
    kernel = library()
    if kernel is None or not _plain(path, z) or not path.numel() or not segments.max_count:
        return None
    out = np.empty(tuple(path.shape), np.float32)
    sizes = (len(path), path.shape[1], segments.max_count, path.shape[2])
    call(kernel, "delayed", sizes, 0.0, (), (_floats(path), *_times(segments), _floats(z), out))
    return torch.from_numpy(out)


def joined_samples(values: Tensor, phase: Tensor, steps: int, every: int) -> Tensor | None:
    """The record (n, steps, d_y) of values (n, R, d_y), the first at `phase` (n,), joined."""
    kernel = library()
    if kernel is None or not _plain(values) or not values.numel():
        return None
    n, samples, width = values.shape
    out = np.empty((n, steps, width), np.float32)
    sizes = (n, steps, samples, every, width)
    phases = np.ascontiguousarray(phase.numpy(), np.int64)
    call(kernel, "joined", sizes, 0.0, (), (_floats(values), phases, out))
    return torch.from_numpy(out)


def _plain(*tensors: Tensor) -> bool:
    """Whether no gradient is wanted, and all are in single precision on the processor."""
    graded = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    return not graded and all(each.dtype == torch.float32 and each.is_cpu for each in tensors)


def _pack(surrogate: Any) -> tuple[NDArray, NDArray, NDArray] | None:
    """Widths, numbers and tolerances of a network, as the kernels take them; None of another."""
    layers = list(getattr(surrogate, "network", ()))
    dense = layers[::2]
    suits = (
        getattr(surrogate, "memoryless", False)
        and all(isinstance(each, nn.Linear) for each in dense)
        and all(isinstance(each, nn.SiLU) for each in layers[1::2])
        and len(dense) == len(layers) // 2 + 1
    )
    if not suits or not _plain(*(each.weight.detach() for each in dense)):
        return None
    before, after = surrogate.before, surrogate.after
    mean, scale = after.mean.numpy(), after.scale.numpy()
    numbers = [before.mean.numpy(), before.scale.numpy(), mean, scale, *map(_group, dense)]
    widths = [len(dense), dense[0].in_features, *(each.out_features for each in dense)]
    packed = np.concatenate(numbers, dtype=np.float32)
    return np.array(widths, np.int64), packed, (TOLERANCE * scale).astype(np.float32)


def _group(dense: nn.Linear) -> NDArray:
    """The weights of a layer and then its biases, for so many outputs at a time."""
    weights = dense.weight.detach().numpy()
    groups = -(-dense.out_features // OUTPUTS)
    rows = np.zeros((groups * OUTPUTS, dense.in_features + 1), np.float32)
    rows[: len(weights), :-1] = weights
    rows[: len(weights), -1] = dense.bias.detach().numpy()
    return rows.reshape(groups, OUTPUTS, -1).transpose(0, 2, 1).ravel()


def _times(segments: Segments) -> tuple[NDArray, NDArray, NDArray]:
    """Starts and settle times (n, M), and the number (n,) of segments."""
    ends = (np.ascontiguousarray(each, np.float64) for each in (segments.start, segments.settle))
    start, settle = ends
    return start, settle, np.asarray(segments.valid).sum(axis=1).astype(np.int64)


def _floats(values: Tensor) -> NDArray:
    return np.ascontiguousarray(values.detach().numpy(), np.float32)
