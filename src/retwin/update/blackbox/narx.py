"""Polynomial NARX: monomials of past outputs and commands, chosen by forward regression.

    y[k] = sum of theta_i term_i(y[k-1], ..., y[k-n], u[k], ..., u[k-n])

Least squares on measured past outputs gives first coefficients, and free simulation the final ones.

References
----------
S. A. Billings, "Nonlinear system identification: NARMAX methods in the time, frequency, and
spatio-temporal domains" (2013), chapters 2 and 3.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.blackbox import estimate
from retwin.update.blackbox.lags import ROWS_PER_TERM, Lags, least_squares
from retwin.update.dynamics.estimation import Estimation, Point
from retwin.update.dynamics.unknowns import coefficients_of

WIDER = 4.0
"""Bound of outputs, in half widths of their range in calibration about its centre: a simulation
that diverges is held there, and the model warns that it leaves the range."""


def fit_narx(observed: Trajectories, seed: int, progress: Progress | None) -> estimate.BlackBox:
    """The polynomial model of past outputs and commands; it needs no seed.

    Forward regression adds nonlinear terms to the linear ones, by the share of the variance that
    each explains beyond those before it. They have a Gaussian prior about 0.
    """
    estimate.check_records(observed)
    # Up to four past samples are tried.
    orders = range(1, 5)
    # Highest degree of the monomials; it is lowered for many variables, see `Library`.
    order, found = estimate.best_order(
        orders, lambda n: Polynomial(Lags(observed, n, 3)).fit(), progress
    )
    return found.model(order, len(observed.outputs))


@dataclass(frozen=True, eq=False)
class Polynomial:
    """Polynomial models of past samples.

    Attributes
    ----------
    lags : Lags
        The past samples and monomials.

    """

    lags: Lags

    def twin(self, chosen: list[list[int]], coefficients: NDArray) -> StateTwin:
        """The model with some terms of each output; its states are the past samples."""
        lags, observed = self.lags, self.lags.observed
        names, outputs = [each.name for each in lags.terms], lags.outputs
        level, height = outputs.centre.tolist(), outputs.scale.tolist()
        width, past = len(observed.outputs), len(observed.outputs) * (lags.order - 1)
        inputs = len(observed.inputs)

        def output(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            values, given = lags.values([*x, *u]), iter(p)
            sums = (sum(next(given) * values[i] for i in own) for own in chosen)
            held = [each.clamp(-WIDER, WIDER) for each in sums]
            return tuple(a + b * each for a, b, each in zip(level, height, held, strict=True))

        def step(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            commands = x[width + past : len(x) - inputs]
            return (*output(x, u, p), *x[:past], *u, *commands)

        places = [(own, i) for own, terms in enumerate(chosen) for i in terms]
        terms = [f"{observed.outputs.names[own]}: {names[i]}" for own, i in places]
        parameters = coefficients_of(terms, coefficients)
        channels = observed.inputs, observed.outputs, observed.rate
        return StateTwin(self._states(), output, *channels, step=step, parameters=parameters)

    @property
    def starts(self) -> NDArray:
        """States (records, d_x) at the first samples, as if each record had been at rest."""
        return np.concatenate([np.tile(each, (1, self.lags.order)) for each in self.lags.first], 1)

    def _states(self) -> list[State]:
        lags = self.lags
        channels = (lags.observed.outputs, lags.observed.inputs)
        units = [unit for each in channels for _ in range(lags.order) for unit in each.units]
        low, high = (each[: len(units)] for each in (lags.domain.low, lags.domain.high))
        # Samples before the first one may lie by its width beyond the range of a channel.
        margin = np.where(high > low, high - low, 1.0)
        columns = (self.starts.mean(axis=0), low - margin, high + margin)
        numbers = (each.tolist() for each in columns)
        return [State(*each) for each in zip(lags.names, units, *numbers, strict=True)]

    def fit(self) -> estimate.BlackBoxFit | None:
        """The model; None where samples are too few or the linear model diverges."""
        if not self.lags.enough:
            return None
        observed, chosen, linear = self.lags.observed, self.chosen(), self.linear

        def start(part: NDArray) -> estimate.BlackBoxFit:
            kept = self.lags.rows.without(part)
            coefficients = np.zeros((len(chosen), max(map(len, chosen))))
            columns = kept.values[:, linear]
            coefficients[:, linear] = [least_squares(columns, y) for y in kept.outputs.T]
            pairs = zip(coefficients, chosen, strict=True)
            flat = np.concatenate([own[: len(terms)] for own, terms in pairs])
            estimation = estimate.estimation_of(self.twin(chosen, flat), observed, part)
            estimation = self._with_prior(estimation, chosen)
            return estimate.BlackBoxFit(estimation, Point(flat, self.starts), np.empty(0))

        return estimate.with_best_prior(start, observed.mask)

    @property
    def linear(self) -> list[int]:
        """The constant and the terms of degree 1, which every model has."""
        return list(range(1 + len(self.lags.domain.low)))

    def _with_prior(self, estimation: Estimation, chosen: list[list[int]]) -> Estimation:
        """The estimation in which nonlinear terms are small, and others free.

        A nonlinear term at the edge of the domain is about as large as a step of its output.
        """
        observed = self.lags.observed
        y = np.where(observed.mask, observed.observed, np.nan).astype(np.float64)
        speed = np.sqrt(np.nanmean(np.diff(y, axis=1) ** 2, axis=(0, 1)))
        size = np.repeat(speed / self.lags.outputs.scale, [len(own) for own in chosen])
        nonlinear = np.concatenate(chosen) > len(self.lags.domain.low)
        unknowns = replace(
            estimation.unknowns,
            mean=np.where(nonlinear, 0.0, estimation.unknowns.mean),
            deviation=np.where(nonlinear, size, np.inf),
        )
        return replace(estimation, unknowns=unknowns)

    def chosen(self, *, max_terms: int = 40, max_rows: int = 20_000) -> list[list[int]]:
        """The terms of each output, in the order of forward regression after the linear ones.

        Parameters
        ----------
        max_terms : int, default 40
            Largest number of terms of an output that is tried.
        max_rows : int, default 20_000
            Number of samples at which terms are ordered.

        """
        rows = self.lags.rows
        some = np.linspace(0, len(rows) - 1, min(len(rows), max_rows)).astype(int)
        most = min(max_terms, len(rows) // ROWS_PER_TERM)
        return [forward(rows.values[some], y, most, self.linear) for y in rows.outputs[some].T]


def forward(columns: NDArray, target: NDArray, count: int, first: list[int]) -> list[int]:
    """Terms in the order in which each explains most beyond those before it.

    Forward regression with orthogonal least squares: the error reduction ratio of a term is the
    share of the target along what the term has beyond the chosen ones. It ends where that is no
    more than noise would have.

    Parameters
    ----------
    columns : NDArray
        (K, k), values of the terms.
    target : NDArray
        (K,).
    count : int
        Number of terms at most.
    first : list of int
        Terms that are chosen in any case.

    """
    rest = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    left, chosen = target.copy(), list(first)
    basis = np.linalg.qr(rest[:, first])[0]
    for _ in range(2):
        left -= basis @ (basis.T @ left)
        rest -= basis @ (basis.T @ rest)
    while len(chosen) < min(count, columns.shape[1]):
        size = np.linalg.norm(rest, axis=0)
        size[chosen] = 0.0
        # Norm of what a term of norm 1 has beyond the chosen ones, below which it is a combination.
        gain = np.divide(rest.T @ left, size, out=np.zeros(len(size)), where=size > 1e-5)
        best = int(np.argmax(np.abs(gain)))
        # What a term explains at least, over the variance of the error that is left: the largest of
        # some hundred terms explains as much of white noise with a probability of 5 %.
        if gain[best] ** 2 <= 12.0 * (left @ left) / len(left):
            break
        direction = rest[:, best] / size[best]
        left -= direction * (direction @ left)
        rest -= np.outer(direction, direction @ rest)
        chosen.append(best)
    return chosen
