"""Which segments actuators missed, before anything is known of offsets, delays and noise.

Where most segments are missed, offsets that learn to undo them explain outputs too, and a search
from offsets alone never finds out. So it starts from what the outputs at rest show.
"""

from __future__ import annotations

import torch
from torch import Tensor

from retwin.update.corrections.commands.problem import CommandProblem


@torch.no_grad()
def first_missed(problem: CommandProblem, deviation: Tensor, odds: float) -> Tensor:
    """The most probable missed segments (n, M, d_u), those of one segment after the other.

    Compared are the medians of each segment's outputs at rest, where delays do not matter. Offsets
    are errors with a standard deviation (d_u,) and, through the gain, covariances of the outputs;
    noise is taken to be as large as they are. Of a segment all flips of one actuator are tried, and
    that all actuators missed it.

    Parameters
    ----------
    problem : CommandProblem
        Of n trajectories, nothing of them missed.
    deviation : Tensor
        (d_u,), of offsets, in the commands' units.
    odds : float
        Log odds that an actuator misses a segment.

    """
    missed, margin = problem.missed.clone(), max(problem.delay_range[1], 0.0)
    rest = problem.at_rest(margin) & (problem.measured > 0)[:, None]
    if not rest.any():
        return missed
    precision = _precision(problem, rest, deviation)

    def cost(rows: Tensor, missed: Tensor, m: int) -> Tensor:
        """Minus the log posterior (k,) of what was missed in segment `m`."""
        part = problem[rows].with_missed(missed)
        seen = rest[rows, m, :, None]
        middle = torch.where(seen, part.residual(part.zero), torch.nan).nanmedian(dim=1).values
        middle = middle.nan_to_num(0.0)
        square = ((precision[rows, m] @ middle[..., None])[..., 0] * middle).sum(dim=-1)
        return 0.5 * square - odds * missed[:, m].sum(dim=-1)

    every = torch.arange(len(problem))
    for m in range(missed.shape[1]):
        rows, now = every, cost(every, missed, m)
        for _ in range(missed.shape[2]):
            # An actuator more that missed the segment costs `odds`, whatever it explains.
            rows, now = (each[now > -odds] for each in (rows, now))
            if not len(rows):
                break
            tried = _flipped(missed[rows], problem.healthy[rows, m], m)
            costs = torch.stack([cost(rows, each, m) for each in tried])
            least, best = costs.min(dim=0)
            better = least < now
            rows, now = rows[better], least[better]
            missed[rows] = torch.stack(tried)[best, torch.arange(len(best))][better]
    return missed


def _flipped(missed: Tensor, healthy: Tensor, m: int) -> list[Tensor]:
    """Missed segments (k, M, d_u) with other ones in segment `m`, where actuators are healthy."""
    changes = torch.eye(missed.shape[2], dtype=missed.dtype)
    tried = [*((missed[:, m] - each * healthy).abs() for each in changes), healthy.to(missed)]
    return [missed.index_copy(1, torch.tensor([m]), each[:, None]) for each in tried]


def _precision(problem: CommandProblem, rest: Tensor, deviation: Tensor) -> Tensor:
    """(n, M, d_y, d_y) of the outputs at rest that offsets and noise of their size cause."""
    count = rest.sum(dim=-1)[..., None, None].clamp_min(1)
    gain = torch.einsum("nms,nsyu->nmyu", rest.double(), problem.gain()) / count
    gain = gain * deviation
    covariance = gain @ gain.mT
    identity = torch.eye(covariance.shape[-1], dtype=covariance.dtype)
    size = covariance.diagonal(dim1=-2, dim2=-1).mean(dim=(0, 1, 2))
    return torch.linalg.inv(covariance + size.clamp_min(1e-30) * identity)
