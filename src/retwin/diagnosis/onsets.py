"""When did an actuator get stuck? Every onset that its fault allows is weighed.

Each movement is taken for the one in which, or after which, it happened. The outputs are explained
for the onset in it that seems best; then all its onsets are tried on that explanation, which may
give way for each as far as it is unsure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from retwin.diagnosis.evidence import Noise, reach, solve

if TYPE_CHECKING:
    from retwin.diagnosis.hypotheses import Hypotheses

__all__ = ["Onsets"]

COARSE = 25
"""Onsets of each movement that are tried first."""
FINE = 8
"""Samples before and after the best of them that are tried one by one."""
PASSES = 2
"""Of explaining the outputs for the best onset."""


@dataclass(frozen=True, eq=False)
class Onsets:
    """What the outputs say of the onset, in each of R rows.

    Attributes
    ----------
    samples: (R, G), onsets in order.
    chance: (R, G), the probability of each, sums to one.
    best: (R,), the most probable one.
    gain: (R,), log evidence that all together have beyond that of the best.

    """

    samples: Tensor
    chance: Tensor
    best: Tensor
    gain: Tensor

    @classmethod
    def of(cls, rows: Hypotheses, noise: Noise) -> Onsets:
        """Those of every row; where a fault names one onset, there is nothing to find."""
        first, last = rows.onsets.unbind(dim=1)
        loose = (last > first).nonzero()[:, 0]
        found = cls._found(rows[loose], noise) if len(loose) else None
        size = 1 if found is None else found.samples.shape[1]
        samples = first[:, None].repeat(1, size)
        chance = torch.zeros(samples.shape, dtype=torch.float64)
        chance[:, 0] = 1.0
        best, gain = first.clone(), torch.zeros(len(first), dtype=torch.float64)
        if found is not None:
            samples[loose], chance[loose] = found.samples, found.chance
            best[loose], gain[loose] = found.best, found.gain
        return cls(samples, chance, best, gain)

    @classmethod
    def _found(cls, rows: Hypotheses, noise: Noise) -> Onsets:
        stretches = _stretches(rows)
        count, parts = len(stretches), stretches.shape[1]
        each = torch.arange(count).repeat_interleave(parts)
        samples, weight, best, evidence = _explained(rows[each], stretches.flatten(0, 1), noise)
        first, last = rows.onsets.unbind(dim=1)
        weight = weight - (last - first + 1).log()[each, None]
        shape = (count, parts)
        at = evidence.unflatten(0, shape).argmax(dim=1, keepdim=True)
        own = evidence.unflatten(0, shape).gather(1, at)[:, 0]
        best = best.unflatten(0, shape).gather(1, at)[:, 0]
        samples, weight = (each.unflatten(0, shape).flatten(1) for each in (samples, weight))
        return cls(samples, weight.softmax(dim=1), best, weight.logsumexp(dim=1) - own)


def _stretches(rows: Hypotheses) -> Tensor:
    """First and last onset (R, K, 2) of what is taken together: a movement and the rest after it.

    Those that the fault does not allow are empty: the last is before the first.
    """
    first, last = (each[:, None] for each in rows.onsets.unbind(dim=1))
    start = torch.as_tensor(rows.problem.segments.start).ceil().long()
    begin = torch.cat([torch.zeros_like(first), start[:, 1:]], dim=1)
    end = torch.cat([start[:, 1:] - 1, last], dim=1)
    return torch.stack([begin.maximum(first), end.minimum(last)], dim=-1)


def _cells(samples: Tensor) -> Tensor:
    """How many onsets each of the sorted samples (..., G) stands for."""
    ends = torch.cat([samples[..., :1], samples, samples[..., -1:]], dim=-1).double()
    half = (ends[..., 2:] - ends[..., :-2]) / 2
    half[..., 0] += 0.5
    half[..., -1] += 0.5
    return half.clamp_min(1e-9)


def _explained(
    rows: Hypotheses, limits: Tensor, noise: Noise
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Onsets (R, G) between limits, the log evidence of each times its cell; the best of them (R,),
    and its log evidence.
    """
    first, last = (each[:, None] for each in limits.unbind(dim=1))
    empty = last < first
    last = last.maximum(first)
    share = torch.linspace(0, 1, COARSE, dtype=torch.float64)
    samples = coarse = (first + (last - first) * share).round().long()
    x = rows.start()
    misfit = _misfits(rows, samples, x, None, noise)
    for _ in range(PASSES):
        at = misfit.argmin(dim=1, keepdim=True)
        best = samples.gather(1, at)
        problem = rows.held(best[:, 0]).problem
        fit = solve(problem, x, torch.zeros_like(x[..., 1:]), rows.belief, noise)
        x = fit.x
        fine = (best + torch.arange(-FINE, FINE + 1)).maximum(first).minimum(last)
        samples = torch.cat([coarse, fine], dim=1).sort(dim=1).values
        misfit = _misfits(rows, samples, x, problem.linearised(x, fit.missed)[1], noise)
    # None is explained better than the one that was solved for: slopes reach only so far.
    own = misfit.gather(1, (samples - best).abs().argmin(dim=1, keepdim=True))
    weight = fit.evidence[:, None] - (misfit - own).clamp_min(0) + _cells(samples).log()
    weight = weight.masked_fill(empty, -torch.inf)
    return samples, weight, best[:, 0], fit.evidence.masked_fill(empty[:, 0], -torch.inf)


def _misfits(
    rows: Hypotheses, samples: Tensor, x: Tensor, jacobian: Tensor | None, noise: Noise
) -> Tensor:
    """Minus the log posterior (R, G) for every onset: at x, or, with its slopes, near it."""
    columns = []
    missed = torch.zeros_like(x[..., 1:])
    damping = torch.zeros(len(x), dtype=torch.float64)
    for onset in samples.unbind(dim=1):
        problem = rows.held(onset).problem
        residual, near = problem.residual(x, missed), x
        if jacobian is not None:
            move, _ = reach(problem, x, residual, jacobian, rows.belief, noise, damping)
            residual = residual - torch.einsum("nsyp,np->nsy", jacobian, move)
            near = x + move.unflatten(1, x.shape[1:])
        misfit = noise.misfit(problem, residual).sum(dim=1)
        columns.append(misfit + rows.belief.energy(near))
    return torch.stack(columns, dim=1)
