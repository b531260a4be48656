"""A neural state-space model: a linear one and a small network inside its state equations.

    x[k+1] = A x[k] + B u[k] + c + W tanh(V [x[k], u[k]] + b),   y[k] = C x[k] + D u[k] + e

The linear part begins as the best linear model of the records, with white states of unit variance,
and W at 0. All numbers have Gaussian priors about where they begin. They are estimated on free
simulation over whole records from a strong prior to a weak one, which ends where held-out blocks
are no longer predicted better.

References
----------
M. Schoukens, "Improved initialization of state-space artificial neural networks", European Control
Conference (2021).

"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.blackbox.arx import Linear, best_linear
from retwin.update.blackbox.estimate import (
    BlackBox,
    BlackBoxFit,
    best_order,
    coefficients_of,
    estimation_of,
    states_within,
    with_best_prior,
)
from retwin.update.blackbox.lags import Lags
from retwin.update.dynamics.estimation import Point

SAMPLES_PER_WEIGHT = 10
"""Measured samples per number of the network at least."""
WIDTHS = (2, 16)
"""Least and largest width of the hidden layer."""
START = 3.0
"""Bound of the states at the first sample, over their largest value in the linear model."""


def fit_neural_ss(observed: Trajectories, seed: int, progress: Progress | None) -> BlackBox:
    """The neural state-space model whose first weights are drawn with a seed.

    It has as many states per output as the best linear model has past samples, or one more, and a
    hidden layer whose width depends on the number of samples.
    """
    began = time.perf_counter()
    report = progress or (lambda _: None)
    linear, _ = best_linear(observed, lambda share: report(0.2 * share))

    def fit(order: int) -> BlackBoxFit | None:
        own = Linear(Lags(observed, order, 1))
        found = own.without(np.zeros(observed.mask.shape[:2], dtype=bool))
        if found is None:
            return None
        network = NeuralModel.of(own, found, np.random.default_rng(seed))
        return with_best_prior(network.start, observed.mask)

    orders = range(linear.lags.order, linear.lags.order + 2)
    order, found = best_order(orders, fit, lambda share: report(0.2 + 0.8 * share))
    names = [each.name for each in found.estimation.twin.states]
    return found.model(order, began, names)


@dataclass(frozen=True, eq=False)
class NeuralModel:
    """The neural state-space model of some records, where it begins.

    Attributes
    ----------
    linear : Linear
        The linear model of the records.
    arrays : dict of str to NDArray
        The parameters A, B, c, C, D, e, V, b and W, in scaled units.
    starts : NDArray
        (records, n), the states at the first samples.
    speed : NDArray
        (n,), root mean square of the steps of the states, by which W is scaled.

    """

    linear: Linear
    arrays: dict[str, NDArray]
    starts: NDArray
    speed: NDArray

    @classmethod
    def of(cls, linear: Linear, fit: BlackBoxFit, rng: np.random.Generator) -> NeuralModel:
        """The linear model in coordinates in which its states are white, and a random network."""
        width, inputs, n = linear.sizes
        size = n * width
        constant, past, given = linear.parts(fit.point.shared.reshape(width, -1))
        out = np.eye(width, size)
        a = np.eye(size, k=width) + np.concatenate(past) @ out
        b = np.concatenate(given[1:]) + np.concatenate(past) @ given[0]
        c = np.concatenate([constant, np.zeros(size - width)])
        states = fit.estimation.simulated(fit.point)[1]
        middle = states.mean(axis=(0, 1))
        covariance = np.cov((states - middle).reshape(-1, size).T).reshape(size, size)
        values, directions = np.linalg.eigh(covariance)
        deviation = np.sqrt(np.maximum(values, 1e-12 * values.max()))
        whiten, back = (directions / deviation).T, directions * deviation
        white = (states - middle) @ whiten.T
        speed = np.sqrt(np.mean(np.diff(white, axis=1) ** 2, axis=(0, 1)))
        samples = int(fit.estimation.seen.sum())
        hidden = samples // (SAMPLES_PER_WEIGHT * (2 * size + inputs + 1))
        hidden = int(np.clip(hidden, *WIDTHS))
        arrays = {
            "A": whiten @ a @ back,
            "B": whiten @ b,
            "c": whiten @ (a @ middle + c - middle),
            "C": out @ back,
            "D": given[0],
            "e": out @ middle,
            "V": rng.normal(size=(hidden, size + inputs)),
            "b": rng.normal(size=hidden),
            "W": np.zeros((size, hidden)),
        }
        speed = np.where(speed > 0, speed, 1.0)
        return cls(linear, arrays, white[:, 0], speed)

    @cached_property
    def twin(self) -> StateTwin:
        """The equations."""
        observed, scales = self.linear.lags.observed, self.linear.lags.scales
        shapes = [each.shape for each in self.arrays.values()]
        ends = np.cumsum([0, *(each.size for each in self.arrays.values())])
        places = [slice(*pair) for pair in pairwise(ends.tolist())]
        centre, scale = torch.tensor(scales.commands.centre), torch.tensor(scales.commands.scale)
        level, height = torch.tensor(scales.outputs.centre), torch.tensor(scales.outputs.scale)
        speed = torch.tensor(self.speed)

        def parts(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            flat, pairs = torch.stack(list(p)), zip(places, shapes, strict=True)
            arrays = [flat[place].reshape(shape) for place, shape in pairs]
            return torch.stack(list(x)), (torch.stack(list(u)) - centre) / scale, *arrays

        def step(x: Any, u: Any, p: Any) -> Any:
            x, u, a, b, c, _, _, _, v, shift, w = parts(x, u, p)
            inside = torch.tanh(v @ torch.cat([x, u]) + shift)
            return tuple((a @ x + b @ u + c + speed * (w @ inside)).unbind())

        def output(x: Any, u: Any, p: Any) -> Any:
            x, u, _, _, _, out, direct, constant, *_ = parts(x, u, p)
            return tuple((level + height * (out @ x + direct @ u + constant)).unbind())

        bound = START * max(1.0, float(np.abs(self.starts).max()))
        return StateTwin(
            states_within(self.starts, bound),
            output,
            observed.inputs,
            observed.outputs,
            observed.rate,
            step=step,
            parameters=coefficients_of(
                [f"{name}{i + 1}" for name, each in self.arrays.items() for i in range(each.size)],
                np.concatenate([each.ravel() for each in self.arrays.values()]),
            ),
        )

    def start(self, part: NDArray) -> BlackBoxFit:
        """The model where it begins, without a part (n, T) of the samples."""
        estimation = estimation_of(self.twin, self.linear.lags.observed, part)
        unknowns = estimation.unknowns
        unknowns = replace(unknowns, deviation=np.ones(unknowns.count))
        return BlackBoxFit(
            replace(estimation, unknowns=unknowns), Point(unknowns.mean, self.starts), np.empty(0)
        )
