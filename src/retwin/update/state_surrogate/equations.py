"""The equations of a state surrogate: a linear model with one hidden layer, from a known start.

    x[k+1] = A x[k] + B v[k] + c + s W tanh(V [x[k], v[k]] + b),   x[0] = 0
    y[k]   = C x[k] + D v[k] + e +     Y tanh(V [x[k], v[k]] + b)

v are the commands and the parameters of the twin, in scaled units. All simulations of a twin begin
at the same state, or at one that its parameters determine, which is 0 in suitable coordinates.
A neural black box has the same equations without Y, from unknown starts.

References
----------
P. Van Overschee and B. De Moor, "Subspace identification for linear systems" (1996), for the start
of the linear part. M. Schoukens, "Improved initialization of state-space artificial neural
networks", European Control Conference (2021), for that of the network.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.limits import Limits
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parametric import Parameter
from retwin.update.dynamics.unknowns import coefficients_of

DISTINCT = 1e-10
"""Singular values, over the largest one, below which columns are combinations of others."""


@dataclass(frozen=True, eq=False)
class ChannelScale:
    """Means and standard deviations of channels.

    Attributes
    ----------
    mean, deviation : NDArray
        (d,); the deviation of a constant is 1.

    """

    mean: NDArray
    deviation: NDArray

    @classmethod
    def of(cls, values: NDArray) -> ChannelScale:
        """The scale of values (n, T, d)."""
        mean, deviation = values.mean(axis=(0, 1)), values.std(axis=(0, 1))
        small = deviation <= 1e-9 * np.abs(mean)
        return cls(mean, np.where(small | (deviation == 0), 1.0, deviation))

    def __call__(self, values: Any) -> Any:
        """Values (..., d), an array or a tensor, in scaled units."""
        return (values - _like(values, self.mean)) / _like(values, self.deviation)

    def inverse(self, values: Any) -> Any:
        """Scaled values (..., d) in physical units."""
        return _like(values, self.mean) + _like(values, self.deviation) * values


def _like(values: Any, numbers: NDArray) -> Any:
    return torch.tensor(numbers) if isinstance(values, torch.Tensor) else numbers


@dataclass(frozen=True, eq=False)
class Equations:
    """State equations with certain weights.

    Attributes
    ----------
    arrays : dict of str to NDArray
        A, B, c, C, D, e, V, b, W and Y, in scaled units; without Y the network acts on the states
        alone.
    speed : NDArray
        (d_x,), root mean square of the steps of the states, s.
    given, outputs : ChannelScale
        Of commands and parameters, and of outputs.

    """

    arrays: dict[str, NDArray]
    speed: NDArray
    given: ChannelScale
    outputs: ChannelScale

    @classmethod
    def begun(
        cls, made: Trajectories, order: int, hidden: int, rng: np.random.Generator
    ) -> Equations:
        """The linear model of simulations, of some order, beside a random network without effect.

        The inputs of the simulations are the commands and the parameters.
        """
        whole = made[np.flatnonzero(made.mask.all(axis=(1, 2)))]
        v, y = (np.asarray(each, np.float64) for each in (whole.commands, whole.observed))
        given, outputs = ChannelScale.of(v), ChannelScale.of(y)
        v, y = given(v), outputs(y)
        a, b, c, out, direct, e = model = _linear(v, y, order)
        begin = _start(model, v, y)
        states = _simulate(model, begin, v)[0]
        size = states.std(axis=(0, 1))
        size = np.where(size > 0, size, 1.0)
        speed = np.sqrt(np.mean(np.diff(states / size, axis=1) ** 2, axis=(0, 1)))
        arrays = {
            "A": a * size / size[:, None],
            "B": b / size[:, None],
            "c": (c + a @ begin - begin) / size,
            "C": out * size,
            "D": direct,
            "e": e + out @ begin,
            "V": rng.normal(size=(hidden, order + v.shape[2])),
            "b": rng.normal(size=hidden),
            "W": np.zeros((order, hidden)),
            "Y": np.zeros((y.shape[2], hidden)),
        }
        return cls(arrays, np.where(speed > 0, speed, 1.0), given, outputs)

    @property
    def flat(self) -> NDArray:
        """All weights (k,)."""
        return np.concatenate([each.ravel() for each in self.arrays.values()])

    def at(self, flat: Any) -> dict[str, Any]:
        """Weights (k,), an array or a tensor, in their shapes."""
        ends = np.cumsum([0, *(each.size for each in self.arrays.values())]).tolist()
        shapes = ((name, each.shape) for name, each in self.arrays.items())
        return {
            name: flat[first:last].reshape(shape)
            for (name, shape), (first, last) in zip(shapes, pairwise(ends), strict=True)
        }

    def with_weights(self, flat: NDArray) -> Equations:
        """The same equations with other weights (k,)."""
        return replace(self, arrays=self.at(flat))

    def trainable(self, made: Trajectories, states: Sequence[State] = ()) -> StateTwin:
        """The equations whose parameters are the weights, and whose inputs are v.

        Channels and rate are those of trajectories. Without `states`, all of them begin at 0.
        """
        names = [f"{name}{i + 1}" for name, each in self.arrays.items() for i in range(each.size)]
        weights = coefficients_of(names, self.flat)
        step, output = self._make_functions(lambda u, p: ([*u], self.at(torch.stack([*p]))))
        states, channels = states or self._states(), (made.inputs, made.outputs, made.rate)
        return StateTwin(states, output, *channels, step=step, parameters=weights)

    def twin(
        self, like: Twin, parameters: Sequence[Parameter], limits: Limits, starts: NDArray | None
    ) -> StateTwin:
        """The equations with constant weights, whose parameters are those of the twin `like`.

        `starts` (2, d_x) are the bounds of the states at the first sample, where it is unknown.
        """
        constant = {name: torch.tensor(each) for name, each in self.arrays.items()}
        step, output = self._make_functions(lambda u, p: ([*u, *p], constant))
        return StateTwin(
            self._states(starts), output, like.inputs, like.outputs, like.rate,
            step=step, parameters=parameters, limits=limits, learned=True,
        )  # fmt: skip

    def _make_functions(
        self, given: Callable[[Any, Any], tuple[list[Any], dict[str, Any]]]
    ) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """The step and the output of a `StateTwin`; `given` makes v and weights of its u and p."""

        def step(x: Any, u: Any, p: Any) -> Any:
            return self._next([*x], *given(u, p))

        def output(x: Any, u: Any, p: Any) -> Any:
            return self._output([*x], *given(u, p))

        return step, output

    def _states(self, starts: NDArray | None = None) -> list[State]:
        count = len(self.speed)
        ends = [(None, None)] * count if starts is None else starts.T.tolist()
        return [State(f"x{i + 1}", "1", 0.0, *each) for i, each in enumerate(ends)]

    def _next(self, x: list[Any], v: list[Any], w: dict[str, Any]) -> tuple[Any, ...]:
        state, given, inside = self._inside(x, v, w)
        linear = w["A"] @ state + w["B"] @ given + w["c"]
        return tuple((linear + torch.tensor(self.speed) * (w["W"] @ inside)).unbind())

    def _output(self, x: list[Any], v: list[Any], w: dict[str, Any]) -> tuple[Any, ...]:
        state, given, inside = self._inside(x, v, w)
        made = w["C"] @ state + w["D"] @ given + w["e"]
        if "Y" in w:
            made = made + w["Y"] @ inside
        return tuple(self.outputs.inverse(made).unbind())

    def _inside(self, x: list[Any], v: list[Any], w: dict[str, Any]) -> tuple[Any, Any, Any]:
        state, given = torch.stack(x), self.given(torch.stack(v))
        return state, given, torch.tanh(w["V"] @ torch.cat([state, given]) + w["b"])


Linear = tuple[NDArray, ...]
"""A, B, c, C, D and e of a linear model."""


def _linear(v: NDArray, y: NDArray, order: int, *, stable: float = 0.999) -> Linear:
    """A linear model by a subspace method, from inputs (n, T, d_v) and outputs (n, T, d_y).

    The states are the leading components of what past samples predict of future outputs.

    Parameters
    ----------
    stable : float, default 0.999
        Largest modulus of an eigenvalue of the linear part where it begins.

    """
    # Least number of past samples from which the first estimate of the states is made.
    lags = min(max(10, 2 * order), (v.shape[1] - 1) // 3)
    count = v.shape[1] - 2 * lags + 1

    def window(values: NDArray, begins: Sequence[int]) -> NDArray:
        parts = [values[:, first : first + count] for first in begins]
        return np.concatenate(parts, axis=2)

    def rows(*parts: NDArray) -> NDArray:
        return np.concatenate([each.reshape(-1, each.shape[2]) for each in parts], axis=1)

    one = np.ones((len(v), count, 1))
    past = rows(*(window(each, range(lags)) for each in (y, v)))
    ahead = range(lags, 2 * lags)
    future = rows(window(v, ahead), one)
    both = np.concatenate([past, future], axis=1)
    by_all = np.linalg.lstsq(both, rows(window(y, ahead)), rcond=DISTINCT)[0]
    predicted = past @ by_all[: past.shape[1]]
    directions = np.linalg.svd(predicted - predicted.mean(axis=0), full_matrices=False)[0]
    states = directions[:, :order].reshape(len(v), count, -1) * np.sqrt(len(predicted))
    states = np.pad(states, ((0, 0), (0, 0), (0, order - states.shape[2])))
    now = np.concatenate([states, window(v, [lags]), one], axis=2)
    pairs = (now[:, :-1], states[:, 1:]), (now, window(y, [lags]))
    flow, read = (np.linalg.lstsq(rows(a), rows(b), rcond=DISTINCT)[0].T for a, b in pairs)
    parts = [(each[:, :order], each[:, order:-1], each[:, -1]) for each in (flow, read)]
    (a, b, c), (out, direct, e) = parts
    modulus = float(np.abs(np.linalg.eigvals(a)).max())
    return a * min(1.0, stable / max(modulus, 1e-300)), b, c, out, direct, e


def _start(model: Linear, v: NDArray, y: NDArray) -> NDArray:
    """The common first state (d_x,) of all simulations, by least squares."""
    a, out = model[0], model[3]
    alone = _simulate(model, np.zeros(len(a)), v)[1]
    power, effects = np.eye(len(a)), []
    for _ in range(v.shape[1]):
        effects.append(out @ power)
        power = power @ a
    target = (y - alone).mean(axis=0).ravel()
    return np.linalg.lstsq(np.concatenate(effects), target, rcond=1e-8)[0]


def _simulate(model: Linear, begin: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    """States (n, T, d_x) and outputs (n, T, d_y) of a linear model from a common first state."""
    a, b, c, out, direct, e = model
    x, states = np.tile(begin, (len(v), 1)), []
    for now in v.swapaxes(0, 1):
        states.append(x)
        x = x @ a.T + now @ b.T + c
    every = np.stack(states, axis=1)
    return every, every @ out.T + v @ direct.T + e
