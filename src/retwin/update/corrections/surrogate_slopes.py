"""Outputs of a surrogate and their slopes by commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from retwin.update.corrections.correction import DifferentiableTwin
from retwin.update.kernels.generation import jacobians
from retwin.update.piecewise_linear import distinct


def outputs_at(surrogate: DifferentiableTwin, commands: Tensor) -> Tensor:
    """Outputs (n, S, d_y) of a memoryless surrogate at commands (n, S, d_u).

    Commands that are those of the sample before are evaluated once.
    """
    different, place = distinct(commands)
    return surrogate(different[None])[0, place]


def slopes_at(surrogate: DifferentiableTwin, commands: Tensor) -> tuple[Tensor, Tensor]:
    """Outputs as of `outputs_at`, and their Jacobian (n, S, d_y, d_u)."""
    different, place = distinct(commands)
    slopes = jacobians(surrogate, different)
    if slopes is not None:
        return surrogate(different[None])[0, place], slopes[place]
    with torch.enable_grad():
        inputs = different[None].requires_grad_()
        outputs = surrogate(inputs)
        sums = outputs.flatten(0, -2).sum(dim=0)
        rows = [torch.autograd.grad(each, inputs, retain_graph=True)[0] for each in sums]
    return outputs.detach()[0, place], torch.cat(rows).movedim(0, 1)[place]


def differences(
    predicted: Callable[[Tensor], Tensor], commands: Tensor, steps: Sequence[float]
) -> Tensor:
    """Change (n, S, d_y, d_u) of the outputs per constant change of an actuator's command.

    By central differences of one step per actuator, of any surrogate.
    """
    columns = []
    for actuator, step in enumerate(steps):
        ends = []
        for move in (-step, step):
            moved = commands.clone()
            moved[..., actuator] += move
            ends.append(predicted(moved).double())
        columns.append((ends[1] - ends[0]) / (2 * step))
    return torch.stack(columns, dim=-1)
