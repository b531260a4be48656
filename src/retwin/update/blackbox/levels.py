"""The black box of a machine whose commands are not recorded: each output has a level.

    y[k] = level + an error, whose autocorrelation is left to what uses the model

There is nothing by which outputs could be simulated, so a level is all that a simulation can give;
its uncertainty is that of a mean of autocorrelated samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from retwin.data.trajectories import Trajectories
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.wrappers.parametric import Parameter
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.discrepancy.terms import WIDEST
from retwin.update.dynamics.estimation import correlation_time
from retwin.update.dynamics.twin import DynamicsTwin


def fit_levels(observed: Trajectories) -> DynamicsTwin:
    """The level of each output (d_y), with the variance of the samples about it."""
    count = len(observed.outputs)
    values = np.where(observed.mask, observed.observed, np.nan).astype(float)
    level, noise = np.nanmean(values, axis=(0, 1)), np.nanvar(values, axis=(0, 1))
    residual = np.where(observed.mask, values - level, 0.0)
    times = [correlation_time(residual[..., [i]]) for i in range(count)]
    samples = observed.mask.sum(axis=(0, 1)) / times
    deviation = np.sqrt(noise / np.maximum(samples, 1.0))

    def output(x: Any, u: Any, p: Any) -> Any:
        return tuple(p)

    def step(x: Any, u: Any, p: Any) -> Any:
        return (x[0],)

    channels, states = observed.outputs, [State("rest", "1", 0.0)]
    parameters = [
        Parameter(f"level of {name}", unit, -WIDEST, WIDEST, value)
        for name, unit, value in zip(channels.names, channels.units, level.tolist(), strict=True)
    ]
    equations = StateTwin(
        states, output, observed.inputs, channels, observed.rate, step=step, parameters=parameters
    )
    nothing, inputs = np.zeros(1), len(observed.inputs)
    low = np.concatenate([nothing, observed.commands.min(axis=(0, 1))]) if inputs else nothing
    domain = Domain(low, low, low, np.ones(1))
    return DynamicsTwin(
        equations,
        np.append(level, 0.0),
        np.concatenate([np.diag(deviation), np.zeros((1, count))]),
        nothing,
        nothing,
        nothing,
        nothing,
        noise,
        np.ones(count),
        np.sqrt(noise),
        domain,
        ("rest",),
        observed.emulated,
    )
