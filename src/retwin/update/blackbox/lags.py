"""Regression of outputs on past outputs and commands, measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.update.dynamics.discrepancy.equations import Domain
from retwin.update.dynamics.discrepancy.library import Library
from retwin.update.dynamics.discrepancy.terms import Term

ROWS_PER_TERM = 10
"""Least number of samples per term."""


@dataclass(frozen=True, eq=False)
class MeasuredRows:
    """The samples before which enough samples are measured.

    Attributes
    ----------
    values : NDArray
        (K, k), the terms.
    outputs : NDArray
        (K, d_y), in scaled units.
    record, sample : NDArray
        (K,), their places.

    """

    values: NDArray
    outputs: NDArray
    record: NDArray
    sample: NDArray

    def __len__(self) -> int:
        return len(self.values)

    def without(self, part: NDArray) -> MeasuredRows:
        """The rows outside a part (n, T) of the samples."""
        kept = ~part[self.record, self.sample]
        return MeasuredRows(*(each[kept] for each in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Lags:
    """Monomials of so many past samples of records.

    The variables are the past outputs, then the past commands, the latest first, then the present
    commands.

    Attributes
    ----------
    observed : Trajectories
        The n records.
    order : int
        Past samples of outputs and commands.
    degree : int
        Highest degree of the monomials.

    """

    observed: Trajectories
    order: int
    degree: int

    @cached_property
    def outputs(self) -> Domain:
        """Ranges of the d_y outputs in calibration, of measured samples alone."""
        return _ranges_of(np.where(self.observed.mask, self.observed.observed, np.nan))

    @cached_property
    def commands(self) -> Domain:
        """Ranges of the d_u commands in calibration."""
        return _ranges_of(self.observed.commands)

    @cached_property
    def names(self) -> list[str]:
        """Names of the past samples."""
        channels = (self.observed.outputs, self.observed.inputs)
        return [
            f"{name}[k-{lag}]"
            for each in channels
            for lag in range(1, self.order + 1)
            for name in each.names
        ]

    @cached_property
    def domain(self) -> Domain:
        """Ranges of the variables."""
        y, u = self.outputs, self.commands
        n, pairs = self.order, ((y.low, u.low), (y.high, u.high), (y.mean, u.mean))
        low, high, mean = (np.concatenate([*[a] * n, *[b] * (n + 1)]) for a, b in pairs)
        return Domain(low, high, mean, np.ones(len(self.names)))

    @cached_property
    def terms(self) -> list[Term]:
        """All monomials: the constant, those of degree 1 in the order of the variables, others."""
        variables = [*self.names, *(f"{name}[k]" for name in self.observed.inputs.names)]
        return Library(self.degree, (), False).terms(variables, len(self.names))

    def values(self, variables: Sequence[Any]) -> list[Any]:
        """The values of all terms, for tensors of the variables in physical units.

        Those of degree 1 are linear everywhere; others hold their variables beyond the range in
        calibration, see `Domain.scaled`.
        """
        domain, held = self.domain, self.domain.scaled(variables)
        places = zip(variables, domain.centre.tolist(), domain.scale.tolist(), strict=True)
        free = [(each - centre) / scale for each, centre, scale in places]
        last = len(variables)
        return [term.value(free if i <= last else held) for i, term in enumerate(self.terms)]

    @cached_property
    def rows(self) -> MeasuredRows:
        """The samples before which all `order` samples of all outputs are measured."""
        import torch

        n, samples = self.order, self.observed.steps
        pair = self.observed.observed, self.observed.commands
        y, u = (each.astype(np.float64) for each in pair)
        whole = np.asarray(self.observed.mask.all(axis=2))
        spans = [whole[:, n - lag : max(n, samples) - lag] for lag in range(n + 1)]
        record, sample = np.nonzero(np.all(spans, axis=0))
        sample = sample + n
        past = [each[record, sample - lag] for each in (y, u) for lag in range(1, n + 1)]
        variables = torch.tensor(np.concatenate([*past, u[record, sample]], axis=1))
        ones = torch.ones(len(variables), dtype=torch.float64)
        columns = [each * ones for each in self.values(list(variables.unbind(1)))]
        outputs = (y[record, sample] - self.outputs.centre) / self.outputs.scale
        return MeasuredRows(torch.stack(columns, 1).numpy(), outputs, record, sample)

    @cached_property
    def enough(self) -> bool:
        """Whether there are enough rows for a linear model."""
        return len(self.rows) >= ROWS_PER_TERM * (1 + len(self.domain.low))

    @cached_property
    def first(self) -> tuple[NDArray, NDArray]:
        """The first measured outputs (n, d_y) of each record, and its first commands (n, d_u)."""
        y, mask = self.observed.observed.astype(np.float64), self.observed.mask
        found = np.take_along_axis(y, mask.argmax(axis=1)[:, None], axis=1)[:, 0]
        known = mask.any(axis=1)
        mean = np.where(known, found, 0.0).sum(axis=0) / known.sum(axis=0)
        return np.where(known, found, mean), self.observed.commands[:, 0].astype(np.float64)


def _ranges_of(values: NDArray) -> Domain:
    """Ranges (d,) of values (n, T, d), of which some may be NaN."""
    given = values.astype(np.float64)
    low, high, mean = (make(given, axis=(0, 1)) for make in (np.nanmin, np.nanmax, np.nanmean))
    return Domain(low, high, mean, np.ones(len(low)))


def least_squares(columns: NDArray, target: NDArray) -> NDArray:
    """Coefficients of the columns, those of the smallest norm where several are equally good."""
    return np.linalg.lstsq(columns, target, rcond=None)[0]
