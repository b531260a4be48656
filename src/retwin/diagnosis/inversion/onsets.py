"""The posterior of the onset from which an actuator is stuck.

Each segment is taken for the one in which, or in the rest after which, it happened. The outputs are
explained for the most probable onset in it; then all its onsets are evaluated on the linearised
problem there.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.diagnosis.inversion.hypotheses import Hypotheses
from retwin.inference.noise import Noise
from retwin.inference.problem import Rows
from retwin.inference.solver import gauss_newton_step
from retwin.update.corrections.commands.missed_segments import fitted

FINE = 8
"""Samples before and after the best of them that are evaluated one by one."""


@dataclass(frozen=True, eq=False)
class Onsets(Rows):
    """The posterior of the onset in each of R rows.

    Attributes
    ----------
    samples : Tensor
        (R, G), onsets in order.
    probability : Tensor
        (R, G), of each onset; sums to one.
    best : Tensor
        (R,), the most probable onset.
    gain : Tensor
        (R,), log evidence that all together have beyond that of the best.
    information : Tensor
        (R,), in nats, what the measurements have added to the prior of the onset.

    """

    samples: Tensor
    probability: Tensor
    best: Tensor
    gain: Tensor
    information: Tensor

    @classmethod
    def of(cls, rows: Hypotheses, noise: Noise) -> Onsets:
        """Of every row; where a fault fixes the onset, there is nothing to infer."""
        first, last = rows.onsets.unbind(dim=1)
        none = torch.zeros(len(first), dtype=torch.float64)
        known = cls(first[:, None], torch.ones_like(none)[:, None], first, none, none)
        open_rows = (last > first).nonzero()[:, 0]
        if not len(open_rows):
            return known
        found = cls._infer(rows[open_rows], noise)
        samples = first[:, None].repeat(1, found.samples.shape[1])
        probability = torch.zeros(samples.shape, dtype=torch.float64)
        probability[:, 0] = 1.0
        return cls(samples, probability, first, none, none).put(open_rows, found)

    @classmethod
    def _infer(cls, rows: Hypotheses, noise: Noise) -> Onsets:
        spans = _spans(rows)
        count, parts = len(spans), spans.shape[1]
        each = torch.arange(count).repeat_interleave(parts)
        samples, weight, best, evidence = _explain(rows[each], spans.flatten(0, 1), noise)
        first, last = rows.onsets.unbind(dim=1)
        all_onsets = (last - first + 1).double()
        weight = weight - all_onsets.log()[each, None]
        prior = _cells(samples) / all_onsets[each, None]
        shape = (count, parts)
        at = evidence.unflatten(0, shape).argmax(dim=1, keepdim=True)
        own = evidence.unflatten(0, shape).gather(1, at)[:, 0]
        best = best.unflatten(0, shape).gather(1, at)[:, 0]
        columns = (samples, weight, prior)
        samples, weight, prior = (each.unflatten(0, shape).flatten(1) for each in columns)
        probability = weight.softmax(dim=1)
        information = torch.special.xlogy(probability, probability / prior).sum(dim=1)
        return cls(samples, probability, best, weight.logsumexp(dim=1) - own, information)


def _spans(rows: Hypotheses) -> Tensor:
    """First and last onset (R, K, 2) of what is taken together: a segment and the rest after it.

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


def _explain(
    rows: Hypotheses, limits: Tensor, noise: Noise, *, passes: int = 2, evaluated_first: int = 25
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Onsets (R, G) between limits, the log evidence of each times its cell; the best of them (R,),
    and its log evidence.

    Parameters
    ----------
    passes : int, default 2
        Times that the outputs are explained for the best onset.
    evaluated_first : int, default 25
        Onsets of each segment that are evaluated first.

    """
    first, last = (each[:, None] for each in limits.unbind(dim=1))
    empty = last < first
    last = last.maximum(first)
    share = torch.linspace(0, 1, evaluated_first, dtype=torch.float64)
    samples = coarse = (first + (last - first) * share).round().long()
    x = rows.start
    objective = _objectives(rows, samples, x, None, noise)
    for _ in range(passes):
        at = objective.argmin(dim=1, keepdim=True)
        best = samples.gather(1, at)
        problem = rows.held(best[:, 0]).problem
        fit = fitted(problem, rows.prior, noise, x)
        x = fit.x
        fine = (best + torch.arange(-FINE, FINE + 1)).maximum(first).minimum(last)
        samples = torch.cat([coarse, fine], dim=1).sort(dim=1).values
        objective = _objectives(rows, samples, x, problem.linearised(x)[1], noise)
    # None is explained better than the one that was solved for: linearisation is local.
    own = objective.gather(1, (samples - best).abs().argmin(dim=1, keepdim=True))
    weight = fit.evidence[:, None] - (objective - own).clamp_min(0) + _cells(samples).log()
    weight = weight.masked_fill(empty, -torch.inf)
    return samples, weight, best[:, 0], fit.evidence.masked_fill(empty[:, 0], -torch.inf)


def _objectives(
    rows: Hypotheses, samples: Tensor, x: Tensor, jacobian: Tensor | None, noise: Noise
) -> Tensor:
    """Minus the log posterior (R, G) for every onset: at x, or, with its Jacobian, near it."""
    columns = []
    prior = rows.prior.gaussian
    for onset in samples.unbind(dim=1):
        problem = rows.held(onset).problem
        residual = problem.residual(x)
        if jacobian is None:
            misfit = noise.misfit(problem, residual).sum(dim=1)
            columns.append(misfit + prior.energy(x))
        else:
            step = gauss_newton_step(problem, prior, noise, x, (residual, jacobian))
            columns.append(step.objective)
    return torch.stack(columns, dim=1)
