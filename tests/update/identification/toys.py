"""Twins whose parameters are known, and data of theirs with noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.signal import lfilter

import retwin as rt
from retwin.twins.function import FunctionTwin
from retwin.twins.twin import Chunk, simulate_in_chunks
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin

INPUTS = rt.Channels(("u", "v"), ("1", "1"))
OUTPUT = rt.Channels(("y",), ("m",))
RATE = 10.0


def line(commands: np.ndarray, a: float, b: float) -> np.ndarray:
    return a * commands[..., :1] + b * commands[..., 1:]


def affine(commands: np.ndarray, a: float, b: float) -> np.ndarray:
    return a * commands[..., :1] + b


def lag(commands: np.ndarray, gain: float, share: float) -> np.ndarray:
    """A first-order lag that keeps `share` of its value per sample."""
    return lfilter([gain * (1 - share)], [1.0, -share], commands[..., :1], axis=-2)


def product(commands: np.ndarray, a: float, b: float) -> np.ndarray:
    return a * b * commands[..., :1]


def build(function, values: Mapping[str, float]) -> FunctionTwin:
    return FunctionTwin(partial(function, **values), INPUTS, OUTPUT, RATE)


def parametric(function, **bounds: tuple[float, float]) -> ParametricTwin:
    free = [Parameter(name, "1", low, high) for name, (low, high) in bounds.items()]
    return ParametricTwin.built(partial(build, function), free)


LINE = parametric(line, a=(-3.0, 5.0), b=(-4.0, 4.0))
AFFINE = parametric(affine, a=(-3.0, 5.0), b=(-4.0, 4.0))
LAG = parametric(lag, gain=(0.1, 5.0), share=(0.1, 0.98))
PRODUCT = parametric(product, a=(0.5, 2.0), b=(0.5, 2.0))


@dataclass(frozen=True)
class Batched:
    """y = a u + b v with values of its own for every simulation, in one go."""

    inputs: rt.Channels = INPUTS
    outputs: rt.Channels = OUTPUT
    rate: float = RATE

    def simulate(self, commands, *, faults=None, seed, progress=None, parameters=None):
        given = {"a": 1.0, "b": 0.0, **(parameters or {})}
        a, b = (np.broadcast_to(given[name], len(commands))[:, None, None] for name in "ab")

        def run(chunk: Chunk) -> tuple[np.ndarray, np.ndarray]:
            some = chunk.index
            nominal, observed = (
                line(each, a[some], b[some]) for each in (chunk.commands, chunk.held_commands)
            )
            return nominal, observed

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, size=4096
        )


FAST = ParametricTwin(Batched(), LINE.parameters)


def commands(count: int = 4, steps: int = 60, seed: int = 0) -> np.ndarray:
    """Two commands that step to a new value every ten samples."""
    levels = np.random.default_rng(seed).normal(size=(count, -(-steps // 10), 2))
    return np.repeat(levels, 10, axis=1)[:, :steps]


def measured(
    twin: ParametricTwin, noise: float, *, seed: int, count: int = 4, **true: float
) -> rt.Trajectories:
    made = twin.with_values(true).simulate(commands(count), seed=0)
    rng = np.random.default_rng(seed)
    return made.replace(observed=made.observed + noise * rng.normal(size=made.observed.shape))
