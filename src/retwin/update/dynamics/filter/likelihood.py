"""`Record`: the likelihood of a record by corrected dynamics, under many variants of its inputs.

It is that of the extended Kalman filter, as a mean over the posterior of the parameters, on which
predictions depend linearly. Variants are computed several at a time, and what they have in common
with the record before they differ from it is computed once.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.compiler import c_source, call, compiled
from retwin.twins.compiled.model import Model
from retwin.update.dynamics.filter.prediction import root_of, whitened
from retwin.update.dynamics.twin import DynamicsTwin

COMPILED = 64
"""Number of models whose kernels are kept in this process."""

NoiseVariances = tuple[NDArray | float, NDArray | float]
"""What is added to the variances of process noise (d_x,) and of measurement noise (d_y,)."""


@dataclass(frozen=True, eq=False)
class Variants:
    """What J variants of a record have in place of what was recorded; None for the same.

    Attributes
    ----------
    commands : NDArray or None
        (J, T, d_u).
    measured : NDArray or None
        (J, T, d_y), the outputs.
    seen : NDArray or None
        (J, T, d_y) bool, whether they were measured.
    change : NDArray or None
        (J, T), what is added to one parameter.
    parameter : int
        The index of that parameter.

    """

    commands: NDArray | None = None
    measured: NDArray | None = None
    seen: NDArray | None = None
    change: NDArray | None = None
    parameter: int = 0

    def __len__(self) -> int:
        """J, or 1 where nothing differs."""
        parts = (self.commands, self.measured, self.seen, self.change)
        return max((len(each) for each in parts if each is not None), default=1)


@dataclass(frozen=True, eq=False)
class Record:
    """One measured record, with the filter of a twin.

    Attributes
    ----------
    twin : DynamicsTwin
        The corrected dynamics.
    commands, measured, seen : NDArray
        (T, d_u), (T, d_y), 0 where nothing was measured, and (T, d_y) bool.
    known_start : bool
        See `DynamicsFilter`.

    """

    twin: DynamicsTwin
    commands: NDArray
    measured: NDArray
    seen: NDArray
    known_start: bool

    def inputs(self, variants: Variants) -> tuple[NDArray, NDArray, NDArray, NDArray | None]:
        """Commands, outputs, whether these were measured, and changes, as `filter` takes them."""
        own = (variants.commands, variants.measured, variants.seen)
        common = (self.commands, self.measured, self.seen)
        shape = (len(variants), 1, 1)
        commands, measured, seen = (
            np.tile(given, shape) if each is None else each
            for each, given in zip(own, common, strict=True)
        )
        if variants.change is None:
            return commands, measured, seen, None
        changes = np.zeros((*variants.change.shape, len(self._parameters)))
        changes[..., variants.parameter] = variants.change
        return commands, measured, seen, changes

    def filtered(
        self, variants: Variants, more: NoiseVariances = (0.0, 0.0)
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Mean, covariance and states of each variant; see `DynamicsFilter`."""
        commands, measured, seen, changes = self.inputs(variants)
        known = self.known_start
        given = (commands, measured, seen)
        return self.twin.filter(*given, changes=changes, more=more, known_start=known)

    def log_density(
        self, variants: Variants, slopes: NDArray, more: NoiseVariances = (0.0, 0.0)
    ) -> NDArray:
        """Log densities (J,) of what was measured; minus infinity where they are not finite.

        Parameters
        ----------
        variants : Variants
            What is evaluated.
        slopes : NDArray
            (T, d_y, r), derivatives of the predictions by parameters that are standard Gaussian.
        more : tuple of NDArray, default 0
            See `NoiseVariances`.

        """
        library = _library(self.twin.equations.stepped)
        given = (variants, slopes, more)
        sums = self._in_numpy(*given) if library is None else self._in_c(library, *given)
        squares, logs, gradient, curvature = sums
        made = np.full(len(squares), -np.inf)
        finite = np.isfinite(curvature).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1)
        good = np.flatnonzero(finite & np.isfinite(squares) & np.isfinite(logs))
        curvature, gradient = curvature[good] + np.eye(slopes.shape[2]), gradient[good]
        gain = np.sum(gradient * np.linalg.solve(curvature, gradient[..., None])[..., 0], axis=1)
        gain -= np.linalg.slogdet(curvature)[1]
        seen = self.seen[None] if variants.seen is None else variants.seen
        count = np.broadcast_to(seen.sum(axis=(1, 2)), len(made))[good]
        made[good] = 0.5 * (gain - squares[good] - logs[good] - count * np.log(2 * np.pi))
        return made

    def _in_numpy(
        self, variants: Variants, slopes: NDArray, more: NoiseVariances
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Sums of squares (J,), of log variances (J,), and products (J, r) and (J, r, r)."""
        measured, seen = self.inputs(variants)[1:3]
        mean, covariance, _ = self.filtered(variants, more)
        factor, count = root_of(covariance, seen), len(seen)
        errors = whitened(measured - mean, factor, seen).reshape(count, -1)
        own = np.linalg.solve(factor, np.where(seen[..., None], slopes, 0.0))
        own = own.reshape(count, errors.shape[1], -1)
        logs = 2 * np.log(np.diagonal(factor, axis1=2, axis2=3)).sum(axis=(1, 2))
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.sum(errors**2, axis=1) + 0.0 * mean.sum(axis=(1, 2))
            across = own.swapaxes(1, 2)
            return squares, logs, (across @ errors[..., None])[..., 0], across @ own

    def _in_c(
        self, library: ctypes.CDLL, variants: Variants, slopes: NDArray, more: NoiseVariances
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """The same as `_in_numpy`, by the kernel."""
        steps, count, width = self.twin.equations.steps(), len(variants), slopes.shape[2]
        noise, common, process = self.twin.noise + more[1], self._common, self._process[None]
        own = [None, None, variants.measured, variants.seen, variants.change]
        if variants.commands is not None:
            own[0] = self._coefficients(variants.commands)
        if self.twin.proportional.any() and (own[0] is not None or own[4] is not None):
            commands, _, _, changes = self.inputs(variants)
            states = steps.run(commands, np.tile(self._theta, (count, 1)), changes=changes)[1]
            own[1] = self.twin.filter.process_variance(states) + more[0]
        common = [common[0], (process + more[0])[0], *common[1:]]
        first = _first_difference(own, [*common, np.zeros(1)], count, len(self.commands))
        order = np.argsort(first, kind="stable")
        rows = [None if e is None else _doubles(e[order]) for e in own]
        sums = np.empty((count, 2 + width + width * (width + 1) // 2))
        parameters = self._parameters
        start = (parameters, self._theta[len(parameters) :], self._spread)
        call(
            library,
            "likelihood",
            (count, len(self.commands), steps.substeps, width, variants.parameter),
            steps.period,
            [_doubles(each) for each in (*start, noise, slopes, *common)],
            [np.ascontiguousarray(first[order]), *rows, sums],
        )
        sums[order] = sums.copy()
        curvature, low = np.zeros((count, width, width)), np.tril_indices(width)
        curvature[:, low[0], low[1]] = curvature[:, low[1], low[0]] = sums[:, 2 + width :]
        return sums[:, 0], sums[:, 1], sums[:, 2 : 2 + width], curvature

    @cached_property
    def _start(self) -> tuple[NDArray, NDArray]:
        theta, spread = self.twin.filter.start(1, known_start=self.known_start)
        return theta[0], spread[0]

    @property
    def _theta(self) -> NDArray:
        """Parameters and expected start (q + d_x,)."""
        return self._start[0]

    @property
    def _parameters(self) -> NDArray:
        """(q,)."""
        return self._theta[: -len(self.twin.process)]

    @property
    def _spread(self) -> NDArray:
        """Covariance (d_x, d_x) of the start."""
        return self._start[1]

    @cached_property
    def _common(self) -> list[NDArray]:
        """The record's commands as coefficients, its outputs, and whether they were measured."""
        coefficients = self._coefficients(self.commands[None])[0]
        return [coefficients, self.measured, self.seen.astype(np.float64)]

    @cached_property
    def _process(self) -> NDArray:
        """Variances (T, d_x) of the record's process noise."""
        if not self.twin.proportional.any():
            return np.tile(self.twin.process, (len(self.commands), 1))
        steps = self.twin.equations.steps()
        states = steps.run(self.commands[None], self._theta[None])[1]
        return self.twin.filter.process_variance(states)[0]

    def _coefficients(self, commands: NDArray) -> NDArray:
        """Cubic polynomials (J, T, 4, d_u) of commands (J, T, d_u) between samples."""
        given = torch.tensor(commands, dtype=torch.float64)
        theta = torch.tensor(np.tile(self._theta, (len(commands), 1)))
        return self.twin.equations.steps().coefficients(given, theta).numpy()


@lru_cache(maxsize=COMPILED)
def _library(model: Model) -> ctypes.CDLL | None:
    """The kernel for a model; None without a C compiler."""
    # Variants that are computed at a time: numbers in a register of the widest processors.
    source = "\n".join([model.lanes_source(8), c_source(__package__, "likelihood.c")])
    return compiled(source, quiet=True)


def _first_difference(
    variants: list[NDArray | None], record: list[NDArray], count: int, samples: int
) -> NDArray:
    """The first sample (J,) at which a variant differs from the record; T where it does not."""
    first = np.full(count, samples)
    for own, common in zip(variants, record, strict=True):
        if own is not None:
            other = (own != common).reshape(count, samples, -1).any(axis=2)
            first = np.minimum(first, np.where(other.any(axis=1), other.argmax(axis=1), samples))
    return first


def _doubles(values: NDArray) -> NDArray:
    return np.ascontiguousarray(values, np.float64)
