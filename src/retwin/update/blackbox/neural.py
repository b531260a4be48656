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

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.update.blackbox.arx import Linear, best_linear
from retwin.update.blackbox.estimate import (
    BlackBox,
    BlackBoxFit,
    best_order,
    estimation_of,
    states_within,
    with_best_prior,
)
from retwin.update.blackbox.lags import Lags
from retwin.update.dynamics.estimation import Point
from retwin.update.state_surrogate.equations import ChannelScale, Equations

WIDTHS = (2, 16)
"""Least and largest width of the hidden layer."""


def fit_neural_ss(observed: Trajectories, seed: int, progress: Progress | None) -> BlackBox:
    """The neural state-space model whose first weights are drawn with a seed.

    It has as many states per output as the best linear model has past samples, or one more, and a
    hidden layer whose width depends on the number of samples.
    """
    report = progress or (lambda _: None)
    linear, _ = best_linear(observed, lambda share: report(0.2 * share))

    def fit(order: int) -> BlackBoxFit | None:
        own = Linear(Lags(observed, order, 1))
        found = own.without(np.zeros(observed.mask.shape[:2], dtype=bool))
        if found is None:
            return None
        equations, starts = begin_with(own, found, np.random.default_rng(seed))
        # Bound of the states at the first sample, over their largest value in the linear model.
        states = states_within(starts, 3.0 * max(1.0, float(np.abs(starts).max())))
        twin = equations.trainable(observed, states)

        def start(part: NDArray) -> BlackBoxFit:
            estimation = estimation_of(twin, observed, part)
            unknowns = estimation.unknowns
            unknowns = replace(unknowns, deviation=np.ones(unknowns.count))
            estimation = replace(estimation, unknowns=unknowns)
            return BlackBoxFit(estimation, Point(unknowns.mean, starts), np.empty(0))

        return with_best_prior(start, observed.mask)

    orders = range(linear.lags.order, linear.lags.order + 2)
    order, found = best_order(orders, fit, lambda share: report(0.2 + 0.8 * share))
    return found.model(order, len(found.estimation.twin.states))


def begin_with(
    linear: Linear, fit: BlackBoxFit, rng: np.random.Generator, *, samples_per_weight: int = 10
) -> tuple[Equations, NDArray]:
    """A linear model in coordinates in which its states are white, beside a random network.

    Parameters
    ----------
    linear : Linear
        The linear model of the records.
    fit : BlackBoxFit
        Its coefficients, which `Linear.without` found.
    rng : Generator
        Of the weights of the network, which have no effect yet.
    samples_per_weight : int, default 10
        Measured samples per number of the network at least.

    Returns
    -------
    Equations
        The linear model and the network.
    NDArray
        (records, d_x), the states at the first samples.

    """
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
    hidden = samples // (samples_per_weight * (2 * size + inputs + 1))
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
    ranges = linear.lags.commands, linear.lags.outputs
    commands, outputs = (ChannelScale(each.centre, each.scale) for each in ranges)
    return Equations(arrays, np.where(speed > 0, speed, 1.0), commands, outputs), white[:, 0]
