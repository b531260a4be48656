"""The severity of a fault: the bias of an actuator in every segment, or where it is stuck.

A bias has one of two intervals: ±(smallest … largest). The outputs give a Gaussian over the biases
of all segments together; the fault limits the size of each, whatever its sign: 2^M boxes. Their
probability is integrated one segment after the other on a fixed low-discrepancy set (Genz, J.
Comput. Graph. Stat. 1, 1992); the points, weighted, are draws of the severity.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.diagnosis.inversion.hypotheses import Hypotheses
from retwin.inference.noise import Noise
from retwin.update.corrections.commands.effective_commands import effective_commands
from retwin.update.corrections.commands.missed_segments import CommandFit

POINTS = 512
"""Points of the low-discrepancy set."""


def biases(rows: Hypotheses, fit: CommandFit, coverage: float) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and central interval of each segment's bias, and what its limits add to the evidence.

    Parameters
    ----------
    rows : Hypotheses
        R of them.
    fit : CommandFit
        Their most probable z.
    coverage : float
        Probability of the interval, between 0 and 1.

    Returns
    -------
    tuple of Tensor
        (R, M, 3), in the unit of the biased actuator's command, NaN where there is no bias; (R,),
        log evidence that the limits add; and (R,), the information about the bias, see `BiasDraws`.

    """
    place = rows.offset_index
    summary = torch.full((*place.shape, 3), torch.nan, dtype=torch.float64)
    gain = torch.zeros(len(place), dtype=torch.float64)
    information = torch.zeros_like(gain)
    biased = (rows.width > 0).nonzero()[:, 0]
    if not len(biased):
        return summary, gain, information
    prior, width = rows.prior[biased].gaussian, rows.width[biased]
    square = width.square()[:, None, None]
    pick = torch.nn.functional.one_hot(place[biased], prior.mean.shape[1]).double()
    # The conditional mean of the bias, given an actuator's whole error.
    share = square * pick @ prior.precision
    rest = square * (torch.eye(place.shape[1], dtype=torch.float64) - share @ pick.mT)
    drawn = draw_biases(
        (share @ (fit.x[biased] - prior.mean)[..., None])[..., 0],
        share @ fit[biased].solution.covariance @ share.mT + rest,
        width=width,
        size=rows.size[biased],
    )
    summary[biased], gain[biased] = drawn.summary(coverage), drawn.gain
    information[biased] = drawn.information
    return summary, gain, information


def stuck_level(
    rows: Hypotheses, fit: CommandFit, onset: Tensor, noise: Noise
) -> tuple[Tensor, Tensor]:
    """Where the faulty actuator stands at the end, in its command's unit.

    Parameters
    ----------
    rows : Hypotheses
        R of them.
    fit : CommandFit
        Their most probable z.
    onset : Tensor
        (R,), the sample from which it is stuck.
    noise : Noise
        What a healthy sample leaves unexplained, in the outputs' units.

    Returns
    -------
    level, deviation : Tensor
        (R,), the posterior mean and its standard deviation.

    """
    problem = rows.problem.with_missed(fit.missed)
    x = fit.x.clone().requires_grad_()
    last = onset.clamp_max(problem.reference.shape[1] - 1)[:, None]
    with torch.enable_grad():
        z = torch.cat([problem.per_segment(x), problem.missed], dim=-1)
        reached = effective_commands(problem.reference, problem.segments, z, last)
        level = reached[:, 0].gather(1, rows.actuator[:, None])[:, 0]
        slope = torch.autograd.grad(level.sum(), x, allow_unused=True)[0]
    slope = torch.zeros_like(x) if slope is None else slope
    variance = torch.einsum("np,npq,nq->n", slope, fit.solution.covariance, slope).clamp_min(0)
    # At rest the errors of all samples are common: they are worth one sample.
    commands = problem.commands(fit.x)
    step = torch.nn.functional.one_hot(rows.actuator, commands.shape[2])[:, None]
    change = problem.predicted(commands + step) - problem.predicted(commands)
    square = (change.double() / noise.scale[0]).square().sum(dim=-1) * problem.measured
    variance = variance + problem.measured.sum(dim=1) / square.sum(dim=1).clamp_min(1e-12)
    return level.detach(), variance.sqrt()


@dataclass(frozen=True, eq=False)
class BiasDraws:
    """Draws of the biases from their posterior.

    Attributes
    ----------
    values : Tensor
        (R, K, M), in the command's unit.
    weights : Tensor
        (R, K), sum to one.
    gain : Tensor
        (R,), log evidence that the limits add to that of a Gaussian bias.
    information : Tensor
        (R,), in nats, what the measurements have added to the prior of the biases: the
        Kullback-Leibler divergence of the posterior from it.

    """

    values: Tensor
    weights: Tensor
    gain: Tensor
    information: Tensor

    def summary(self, coverage: float) -> Tensor:
        """Mean, and the ends of the central interval of that coverage, (R, M, 3)."""
        order = self.values.argsort(dim=1)
        weights = self.weights[..., None].expand_as(self.values).gather(1, order)
        return central_interval(self.values.gather(1, order), weights, coverage)


def central_interval(values: Tensor, weights: Tensor, coverage: float) -> Tensor:
    """Mean and ends (R, ..., 3) of sorted values (R, K, ...) with weights that sum to one."""
    below, last = weights.cumsum(dim=1), values.shape[1] - 1
    levels = ((1 - coverage) / 2, (1 + coverage) / 2)
    places = [(below < level).sum(dim=1, keepdim=True).clamp_max(last) for level in levels]
    ends = (values.gather(1, place)[:, 0] for place in places)
    return torch.stack([(weights * values).sum(dim=1), *ends], dim=-1)


def draw_biases(mean: Tensor, covariance: Tensor, *, width: Tensor, size: Tensor) -> BiasDraws:
    """The posterior of biases with limits, from that of Gaussian ones.

    Parameters
    ----------
    mean, covariance : Tensor
        (R, M) and (R, M, M), the posterior of the biases if each is Gaussian beforehand, with mean
        0 and standard deviation `width`.
    width : Tensor
        (R,).
    size : Tensor
        (R, 2), smallest and largest size of every bias; uniform in between, the sign is random.

    """
    rows, segments = mean.shape
    engine = torch.quasirandom.SobolEngine(max(segments, 1), scramble=True, seed=0)
    uniform = engine.draw(POINTS, dtype=torch.float64)
    ridge = 1e-9 * width.square()[:, None, None] * torch.eye(segments, dtype=mean.dtype)
    factor = torch.linalg.cholesky(covariance + ridge)
    low, high = size.unbind(dim=1)
    # A bias of a known size is an interval as well, a narrow one.
    high = torch.maximum(high, low + 1e-5 * (low + 1e-6 * width))
    noise = mean.new_zeros(rows, POINTS, segments)
    values = torch.zeros_like(noise)
    log_mass = mean.new_zeros(rows, POINTS)
    for m in range(segments):
        centre = mean[:, m, None] + (noise[..., :m] @ factor[:, m, :m, None])[..., 0]
        scale = factor[:, m, m, None]
        noise[..., m], mass = _inside(centre, scale, low[:, None], high[:, None], uniform[:, m])
        values[..., m] = centre + scale * noise[..., m]
        log_mass = log_mass + mass.log()
    density = -torch.log(2 * (high - low))[:, None, None]
    wide = width[:, None, None]
    normal = -0.5 * (values / wide).square() - torch.log(wide * (2 * torch.pi) ** 0.5)
    log_weight = log_mass + (density - normal).sum(dim=-1)
    gain = log_weight.logsumexp(dim=1) - torch.log(torch.tensor(float(POINTS)))
    weights = log_weight.softmax(dim=1)
    # Posterior over prior: the Gaussian posterior over the Gaussian prior that `gain` is beyond.
    spread = torch.log(factor.diagonal(dim1=1, dim2=2) * (2 * torch.pi) ** 0.5).sum(dim=1)
    gaussian = -0.5 * noise.square().sum(dim=-1) - spread[:, None]
    information = (weights * (gaussian - normal.sum(dim=-1))).sum(dim=1) - gain
    return BiasDraws(values, weights, gain, information)


def _inside(
    centre: Tensor, scale: Tensor, low: Tensor, high: Tensor, uniform: Tensor
) -> tuple[Tensor, Tensor]:
    """Standard normal draws for which |centre + scale z| is between the limits, and that mass."""
    ndtr, ndtri = torch.special.ndtr, torch.special.ndtri
    masses, draws, shares = [], [], []
    for first, last in ((low, high), (-high, -low)):
        begin, end = (first - centre) / scale, (last - centre) / scale
        # The upper tail is turned over: far out, only the lower one has digits left.
        upper = begin > 0
        left, right = torch.where(upper, -end, begin), torch.where(upper, -begin, end)
        # Probability below which an interval counts as empty.
        masses.append((ndtr(right) - ndtr(left)).clamp_min(1e-300))
        shares.append((left, right, upper))
    total = masses[0] + masses[1]
    split = masses[0] / total
    for k, (left, right, upper) in enumerate(shares):
        place = uniform / split if k == 0 else (uniform - split) / (1 - split)
        inner = ndtr(left) + place.clamp(0, 1) * (ndtr(right) - ndtr(left))
        drawn = ndtri(inner).clamp(left, right)
        draws.append(torch.where(upper, -drawn, drawn))
    return torch.where(uniform < split, draws[0], draws[1]), total
