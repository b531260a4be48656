"""How far an actuator errs, where its error is one of two intervals: ±(least … greatest).

The outputs tell a Gaussian over the biases of all movements together. The fault says that the size
of each lies between two limits, whatever its sign: 2^M boxes. Their mass is integrated one
movement after the other on a fixed low-discrepancy set (Genz, J. Comput. Graph. Stat. 1, 1992);
the points, weighted, are draws of the severity.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["BiasDraws", "draw_biases"]

POINTS = 512
"""Of the low-discrepancy set."""
LEAST = 1e-300
"""Mass below which an interval counts as empty."""


@dataclass(frozen=True, eq=False)
class BiasDraws:
    """Biases that explain the outputs.

    Attributes
    ----------
    values: (R, K, M).
    weights: (R, K), sum to one.
    gain: (R,), log evidence that the limits add to what a Gaussian bias had.

    """

    values: Tensor
    weights: Tensor
    gain: Tensor

    def summary(self, cover: float) -> Tensor:
        """Mean, and the ends of the central interval that holds `cover`, (R, M, 3)."""
        order = self.values.argsort(dim=1)
        sorted_values = self.values.gather(1, order)
        weights = self.weights[..., None].expand_as(self.values).gather(1, order)
        below = weights.cumsum(dim=1)
        mean = (weights * sorted_values).sum(dim=1)
        ends = [
            sorted_values.gather(1, (below < level).sum(dim=1, keepdim=True).clamp_max(POINTS - 1))
            for level in ((1 - cover) / 2, (1 + cover) / 2)
        ]
        return torch.stack([mean, *(end[:, 0] for end in ends)], dim=-1)


def draw_biases(mean: Tensor, covariance: Tensor, *, width: Tensor, size: Tensor) -> BiasDraws:
    """From a Gaussian belief about biases to one with limits.

    Parameters
    ----------
    mean, covariance: (R, M) and (R, M, M), what is known of the biases if each is believed to be
        Gaussian with mean 0 and standard deviation `width` (R,) beforehand.
    size: least and greatest size (R, 2) of every bias; uniform in between, the sign is random.

    """
    rows, movements = mean.shape
    engine = torch.quasirandom.SobolEngine(max(movements, 1), scramble=True, seed=0)
    uniform = engine.draw(POINTS, dtype=torch.float64)
    ridge = 1e-9 * width.square()[:, None, None] * torch.eye(movements, dtype=mean.dtype)
    factor = torch.linalg.cholesky(covariance + ridge)
    low, high = size.unbind(dim=1)
    # A bias of a known size is an interval as well, a narrow one.
    high = torch.maximum(high, low + 1e-5 * (low + 1e-6 * width))
    noise = mean.new_zeros(rows, POINTS, movements)
    values = torch.zeros_like(noise)
    log_mass = mean.new_zeros(rows, POINTS)
    for m in range(movements):
        centre = mean[:, m, None] + (noise[..., :m] @ factor[:, m, :m, None])[..., 0]
        scale = factor[:, m, m, None]
        noise[..., m], mass = _inside(centre, scale, low[:, None], high[:, None], uniform[:, m])
        values[..., m] = centre + scale * noise[..., m]
        log_mass = log_mass + mass.log()
    density = -torch.log(2 * (high - low))[:, None, None]
    normal = -0.5 * (values / width[:, None, None]).square() - torch.log(
        width[:, None, None] * (2 * torch.pi) ** 0.5
    )
    log_weight = log_mass + (density - normal).sum(dim=-1)
    gain = log_weight.logsumexp(dim=1) - torch.log(torch.tensor(float(POINTS)))
    return BiasDraws(values, log_weight.softmax(dim=1), gain)


def _inside(
    centre: Tensor, scale: Tensor, low: Tensor, high: Tensor, uniform: Tensor
) -> tuple[Tensor, Tensor]:
    """Standard normal draws for which |centre + scale z| is between the limits, and that mass."""
    ndtr, ndtri = torch.special.ndtr, torch.special.ndtri
    ends = [((low - centre) / scale, (high - centre) / scale)]
    ends.append(((-high - centre) / scale, (-low - centre) / scale))
    masses, draws = [], []
    shares = []
    for begin, end in ends:
        # The upper tail is turned over: far out, only the lower one has digits left.
        upper = begin > 0
        left, right = torch.where(upper, -end, begin), torch.where(upper, -begin, end)
        masses.append((ndtr(right) - ndtr(left)).clamp_min(LEAST))
        shares.append((left, right, upper))
    total = masses[0] + masses[1]
    split = masses[0] / total
    for k, (left, right, upper) in enumerate(shares):
        place = uniform / split if k == 0 else (uniform - split) / (1 - split)
        inner = ndtr(left) + place.clamp(0, 1) * (ndtr(right) - ndtr(left))
        drawn = ndtri(inner).clamp(left, right)
        draws.append(torch.where(upper, -drawn, drawn))
    return torch.where(uniform < split, draws[0], draws[1]), total
