"""What machines of a kind have in common: what some have shown is the prior of another.

Replicates, conditions and machines are three levels of one hierarchy. Of a machine the posterior of
its hyperparameters counts, as means and variances; those of a further machine are normal about the
mean of a kind's machines, with a variance between machines that several of them show (restricted
maximum likelihood by expectation-maximisation: Raudenbush and Bryk, J. Educ. Stat. 10, 75, 1985).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.inference.hierarchy import FREEDOM, Hierarchy
from retwin.inference.hyperprior import Hyperprior, Variances

FACTOR = 2 * math.log(1.5)
"""Expected standard deviation between machines of the logarithm of a variance: their standard
deviations differ by a factor of 1.5."""
MISSED = 0.5, 20.0
"""Missed segments, and segments, that are assumed besides those of each machine."""

Learned = dict[str, list[list[float]]]
"""What a machine has shown: means and variances of each kind of hyperparameter, `delay` in s,
`offset` in the commands' units, logarithms of variances (`log_total`, and where segments have
replicates `log_error` and `log_effect`, see `Hierarchy`); and `missed`, how many segments were
missed, and how many there were."""


def learned(draws: Sequence[Hierarchy], missed: Tensor, healthy: Tensor, rate: float) -> Learned:
    """What a machine has shown, from draws of its hyperparameters for constant offsets.

    Delays of the draws are in samples; `missed` and `healthy` are (n, M, d_u).
    """
    width = missed.shape[-1]
    variances = {"log_total": [each.total() for each in draws]}
    if draws[0].common.any():
        variances["log_error"] = [each.variance for each in draws]
        variances["log_effect"] = [each.common for each in draws]
    first = torch.stack([each.coefficients[: 1 + width] for each in draws])
    times = _times(width, rate)
    found = {"delay": first[:, :1] / rate, "offset": first[:, 1:]}
    found |= {name: torch.stack(each).log() - times for name, each in variances.items()}
    counts = [float((missed * healthy).sum()), float(healthy.sum())]
    made = {name: torch.stack([x.mean(0), x.var(0)], 1).tolist() for name, x in found.items()}
    return made | {"missed": [counts]}


def _times(width: int, rate: float) -> Tensor:
    """(d_u + 2,), the logarithm of a variance in samples over that in s, 0 of an offset."""
    times = torch.zeros(width + 2, dtype=torch.float64)
    times[[0, -1]] = 2 * math.log(rate)
    return times


@dataclass(frozen=True, eq=False)
class OtherMachines:
    """The distribution of the hyperparameters of a further machine of the kind.

    Attributes
    ----------
    count : int
        The number of machines from which it is known.
    values : mapping of str to tuple of NDArray
        Mean and variance (k,) of each kind of hyperparameter, see `Learned`.
    missed : tuple of float
        Missed segments, and segments, that count as if this machine had shown them.

    """

    count: int
    values: Mapping[str, tuple[NDArray, NDArray]]
    missed: tuple[float, float]

    @property
    def text(self) -> str:
        """Where the prior came from."""
        return f"prior from {self.count} other machine{'s' * (self.count > 1)}"

    @classmethod
    def of(cls, machines: Sequence[Mapping[str, Any]]) -> OtherMachines:
        """That of a machine like these, of each what `learned` gave."""
        kinds = {kind for each in machines for kind in each} - {"missed"}
        values = {}
        for kind in sorted(kinds):
            shown = np.array([each[kind] for each in machines if kind in each])
            values[kind] = _predict(shown[..., 0], shown[..., 1], kind)
        missed, all_ = np.sum([each["missed"][0] for each in machines], axis=0) + MISSED
        strength = MISSED[1] * len(machines)
        return cls(len(machines), values, (float(strength * missed / all_), strength))

    def hyperprior(self, rate: float, *, replicated: bool) -> Hyperprior:
        """What a hierarchy is to expect, with delays in samples."""
        unit = np.append(rate, np.ones(len(self.values["offset"][0])))
        mean, variance = (
            np.concatenate([self.values[name][i] for name in ("delay", "offset")]) for i in (0, 1)
        )
        flat = torch.tensor(mean * unit), torch.tensor(variance * unit**2)
        times = _times(len(unit) - 1, rate)
        total = self._variances("log_total", times)
        if not replicated:
            return Hyperprior(flat, error=total)
        if "log_error" in self.values:
            error, effect = (self._variances(f"log_{each}", times) for each in ("error", "effect"))
            return Hyperprior(flat, error=error, effect=effect)
        half = Variances(total.expected / 2, torch.full_like(total.count, FREEDOM))
        return Hyperprior(flat, error=half, effect=half)

    def _variances(self, kind: str, times: Tensor) -> Variances:
        mean, variance = (torch.tensor(each) for each in self.values[kind])
        return Variances.of_logarithm(mean + times, variance)


def _predict(shown: NDArray, variance: NDArray, kind: str) -> tuple[NDArray, NDArray]:
    """Mean and variance (k,) of one more, from K that are `shown` (K, k) with an error.

    Values of a kind have one variance between machines. It is expected to be FACTOR² for
    logarithms; delays and offsets are expected to differ by as much as they are.
    """
    usual = FACTOR**2 if kind.startswith("log_") else float(np.square(shown).mean())
    between = usual
    # Steps of expectation-maximisation.
    for _ in range(200):
        weight = 1 / (variance + between)
        total = weight.sum(axis=0)
        mean = (weight * shown).sum(axis=0) / total
        part = between * weight
        square = (part * (shown - mean)) ** 2 + between * (1 - part) + part**2 / total
        between = (square.sum() + FREEDOM * usual) / (square.size + FREEDOM)
    return mean, between + 1 / total
