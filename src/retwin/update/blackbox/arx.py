"""The best linear model: ARX by least squares, then output error by free simulation.

    y[k] = c + sum over i of A_i y[k-i] + sum over i of B_i u[k-i],   i up to n, from 0 for u

It is simulated in observer form, whose states are as few as possible:

    y[k] = x_1[k] + B_0 u[k],   x_i[k+1] = A_i y[k] + B_i u[k] + x_{i+1}[k] (+ c for i = 1)

References
----------
L. Ljung, "System identification: theory for the user" (1999), chapters 4 and 7.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.blackbox import estimate
from retwin.update.blackbox.lags import Lags, least_squares
from retwin.update.dynamics.estimation import Point
from retwin.update.dynamics.unknowns import coefficients_of


def fit_arx(observed: Trajectories, seed: int, progress: Progress | None) -> estimate.BlackBox:
    """The linear model of the order that predicts held-out blocks best; it needs no seed."""
    linear, fit = best_linear(observed, progress)
    return fit.model(linear.lags.order, len(observed.outputs))


def best_linear(
    observed: Trajectories, progress: Progress | None = None, *, max_order: int = 8
) -> tuple[Linear, estimate.BlackBoxFit]:
    """The linear model of the best order, and its fit.

    Parameters
    ----------
    max_order : int, default 8
        Largest number of past samples that is tried.

    """
    estimate.check_records(observed)
    orders = range(1, max_order + 1)
    order, fit = estimate.best_order(orders, lambda n: Linear(Lags(observed, n, 1)).fit(), progress)
    return Linear(Lags(observed, order, 1)), fit


@dataclass(frozen=True, eq=False)
class Linear:
    """Linear models of past samples, in scaled units.

    Attributes
    ----------
    lags : Lags
        The past samples; the degree is 1.

    """

    lags: Lags

    @cached_property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of outputs, of commands, and of past samples."""
        observed = self.lags.observed
        return len(observed.outputs), len(observed.inputs), self.lags.order

    def parts(self, theta: Any) -> tuple[Any, list[Any], list[Any]]:
        """c, the A_i from i = 1 and the B_i from i = 0, of coefficients (d_y, k)."""
        width, inputs, n = self.sizes
        begin = 1 + n * width
        by_outputs = [theta[:, 1 + i * width : 1 + (i + 1) * width] for i in range(n)]
        places = (begin + i * inputs for i in (n, *range(n)))
        return theta[:, 0], by_outputs, [theta[:, place : place + inputs] for place in places]

    def twin(self, theta: NDArray) -> StateTwin:
        """The model in observer form, its parameters beginning at coefficients (d_y, k)."""
        observed, lags = self.lags.observed, self.lags
        width, _, n = self.sizes
        centre, scale = torch.tensor(lags.commands.centre), torch.tensor(lags.commands.scale)
        level, height = torch.tensor(lags.outputs.centre), torch.tensor(lags.outputs.scale)

        def scaled(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            constant, a, b = self.parts(torch.stack(list(p)).reshape(theta.shape))
            given = (torch.stack(list(u)) - centre) / scale
            states = torch.stack(list(x)).reshape(n, width)
            return states[0] + b[0] @ given, given, states, constant, a, b

        def output(x: Any, u: Any, p: Any) -> Any:
            return tuple((level + height * scaled(x, u, p)[0]).unbind())

        def step(x: Any, u: Any, p: Any) -> Any:
            y, given, states, constant, a, b = scaled(x, u, p)
            following = []
            for i in range(n):
                each = a[i] @ y + b[i + 1] @ given
                each = each + (constant if i == 0 else 0.0)
                following += (each + states[i + 1] if i + 1 < n else each).unbind()
            return tuple(following)

        starts = self.starts(theta)
        # Bound of the states at the first sample, over their largest value at rest.
        bound = 10.0 * (1.0 + float(np.abs(starts).max()))
        terms = [each.name for each in self.lags.terms]
        names = [f"{own}: {term}" for own in observed.outputs.names for term in terms]
        channels = observed.inputs, observed.outputs, observed.rate
        states, parameters = estimate.states_within(starts, bound), coefficients_of(names, theta)
        return StateTwin(states, output, *channels, step=step, parameters=parameters)

    def starts(self, theta: NDArray) -> NDArray:
        """States (records, n d_y) at the first samples, as if each record had been at rest."""
        (y, u), lags = self.lags.first, self.lags
        y = (y - lags.outputs.centre) / lags.outputs.scale
        u = (u - lags.commands.centre) / lags.commands.scale
        constant, a, b = self.parts(theta)
        later, found = np.zeros_like(y), list[NDArray]()
        for i in reversed(range(len(a))):
            later = later + y @ a[i].T + u @ b[i + 1].T + (constant if i == 0 else 0.0)
            found.insert(0, later)
        return np.concatenate(found, axis=1)

    def fit(self) -> estimate.BlackBoxFit | None:
        """The model; None where samples are too few or a simulation diverges."""
        return (
            estimate.cross_validated(self.lags.observed.mask, self.without)
            if self.lags.enough
            else None
        )

    def without(self, part: NDArray) -> estimate.BlackBoxFit | None:
        """The model without a part (n, T) of the samples; None where its simulation diverges."""
        kept = self.lags.rows.without(part)
        theta = np.stack([least_squares(kept.values, y) for y in kept.outputs.T])
        estimation = estimate.estimation_of(self.twin(theta), self.lags.observed, part)
        return estimate.followed(estimation, Point(theta.ravel(), self.starts(theta)))
