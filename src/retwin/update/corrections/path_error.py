"""How far outputs in motion contradict those at rest: the error of the path between two levels.

Effective commands run from level to level as the commands do, delayed; real actuators need not.
Where outputs at rest leave offsets open, those in motion seem to decide. What they say of offsets
that rest determines shows how much it is worth.
"""

from __future__ import annotations

import torch
from torch import Tensor

from retwin.inference.noise import Noise
from retwin.inference.solver import blocks
from retwin.update.corrections.command_problem import CommandProblem

MINOR = 0.5
"""Largest share of the information about a direction that comes from motion, where that is judged
by what is known without it."""
NEGLIGIBLE = 0.01
"""Share below which there is nothing to judge."""


def contradiction(
    problem: CommandProblem,
    noise: Noise,
    linearised: tuple[Tensor, Tensor],
    covariance: Tensor,
    condition: Tensor,
) -> float:
    """Mean square of the gradients of outputs in motion, in that expected of independent errors.

    Errors of the path are common to a segment and to its replicates, so that gradients are added up
    over them first. 1 if outputs in motion say nothing that others say as well.

    Parameters
    ----------
    problem : CommandProblem
        Of all trajectories.
    noise : Noise
        What the gradients are expected to be due to.
    linearised : tuple of Tensor
        Residual and Jacobian at the most probable x.
    covariance : Tensor
        (n, P, P), of x.
    condition : Tensor
        (n, M) long, the condition of each segment, in order from 0.

    """
    residual, jacobian = linearised
    weight = noise.precision(problem, residual) * (problem.group == 1)[..., None]
    inside, size, total, number = problem.inside, problem.size, 0.0, 0
    for m in range(inside.shape[1]):
        # Outputs in motion depend on the levels before and after.
        own = slice(max(m - 1, 0) * size, (m + 1) * size)
        rows = problem.valid[:, m].nonzero()[:, 0]
        columns = jacobian[rows][..., own].flatten(1, 2)
        weighted = (weight * inside[:, m, :, None])[rows].flatten(1)
        weighted = columns * weighted[..., None]
        parts = (
            weighted.mT @ columns,
            weighted.mT @ residual[rows].flatten(1)[..., None],
            covariance[rows][:, own, own],
        )
        _, index, count = condition[rows, m].unique(return_inverse=True, return_counts=True)
        curvature, gradient, spread = (
            each.new_zeros(len(count), *each.shape[1:]).index_add(0, index, each) for each in parts
        )
        values, vectors = torch.linalg.eigh(spread / count[:, None, None])
        root = (vectors * values.clamp_min(0).sqrt()[:, None]) @ vectors.mT
        # In the coordinates in which x is known equally well, motion's shares of what is known.
        share, vectors = torch.linalg.eigh(root @ curvature @ root)
        away = (vectors.mT @ (root @ gradient))[..., 0]
        judged = (share < MINOR) & (share > NEGLIGIBLE)
        square = away.square() / (share * (1 - share)).clamp_min(1e-12)
        import os
        if os.environ.get('PR')=='2': print(m,[(share[i][judged[i]].numpy().round(3),square[i][judged[i]].numpy().round(2)) for i in range(len(share))])
        total, number = total + float(square[judged].sum()), number + int(judged.sum())
    return total / number if number else 1.0
