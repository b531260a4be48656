"""`DynamicsFilter`: the extended Kalman filter of corrected dynamics, on arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.twins.equations.state_twin import SAMPLES_PER_CHUNK, StateTwin
from retwin.update.dynamics.discrepancy.domain import Domain

STEP = 0.1
"""Differences of parameters, in posterior deviations, by which predictions are differentiated."""


def arrays_of(record: Trajectories) -> tuple[NDArray, NDArray, NDArray]:
    """Commands, outputs and whether these were measured, as `DynamicsFilter` takes them."""
    commands = record.commands.astype(np.float64)
    return commands, np.where(record.mask, record.observed, 0.0).astype(np.float64), record.mask


@dataclass(frozen=True, eq=False)
class DynamicsFilter:
    """The distribution of each sample of a record given all earlier ones; nothing is checked.

    The attributes are those of `DynamicsTwin`.
    """

    equations: StateTwin
    values: NDArray
    factor: NDArray
    process: NDArray
    proportional: NDArray
    noise: NDArray
    domain: Domain

    def __call__(
        self,
        commands: NDArray,
        measured: NDArray,
        seen: NDArray,
        *,
        changes: NDArray | None = None,
        more: tuple[NDArray | float, NDArray | float] = (0.0, 0.0),
        known_start: bool = True,
        moves: NDArray | float = 0.0,
        simulated: NDArray | None = None,
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Filter records; nothing is checked.

        Parameters
        ----------
        commands, measured, seen : ndarray, shapes (n, T, d_u), (n, T, d_y), (n, T, d_y)
            Commands, outputs, and whether these were measured.
        changes : ndarray, shape (n, T, q), optional
            What is added to the parameters at each sample.
        more : tuple of ndarray, default 0
            Variances that are added to those of process and measurement noise.
        known_start : bool, default True
            Whether the first sample is the start of a record as in calibration; otherwise the
            states may be anywhere in their range in calibration.
        moves : ndarray, shape (n, q + d_x), optional
            What is added to `values`.
        simulated : ndarray, shape (n, T, d_x), optional
            The states without noise, if they are known; otherwise they are simulated where process
            noise is in proportion to them.

        Returns
        -------
        mean, covariance, states : ndarray
            See `Prediction`.

        """
        theta, spread = self.start(len(commands), known_start=known_start)
        steps, theta, process = self.equations.steps(), theta + moves, self.process
        if self.proportional.any():
            if simulated is None:
                simulated = steps.run(commands, theta, changes=changes)[1]
            process = self.process_variance(simulated)
        variances = (process + more[0], self.noise + more[1])
        given = (commands, theta, (measured, seen), spread, variances, changes)
        return steps.filter(*given)[:3]

    def slopes(
        self,
        commands: NDArray,
        measured: NDArray,
        seen: NDArray,
        *,
        more: tuple[NDArray | float, NDArray | float] = (0.0, 0.0),
        known_start: bool = True,
    ) -> NDArray:
        """Derivatives (n, T, d_y, r) of the mean by the parameters, for the same arrays.

        They are central differences along the columns of `factor`, in posterior deviations; 0 where
        these are not finite.
        """
        moves = STEP * self.directions(known_start=known_start)
        made = np.zeros((*measured.shape, len(moves)))
        size = max(1, SAMPLES_PER_CHUNK // (2 * measured[..., 0].size))
        for first in range(0, len(moves), size):
            own = moves[first : first + size]
            both = np.repeat(np.concatenate([own, -own]), len(commands), axis=0)
            given = (np.tile(e, (2 * len(own), 1, 1)) for e in (commands, measured, seen))
            mean = self(*given, more=more, known_start=known_start, moves=both)[0]
            up, down = mean.reshape(2, len(own), *measured.shape)
            made[..., first : first + size] = np.moveaxis((up - down) / (2 * STEP), 0, -1)
        return np.where(np.isfinite(made), made, 0.0)

    def directions(self, *, known_start: bool) -> NDArray:
        """Posterior deviations (r, q + d_x) of `values`; of a running system without starts."""
        moves = self.factor.T.copy()
        if not known_start:
            moves[:, -len(self.process) :] = 0.0
        return moves[moves.any(axis=1)]

    def start(self, count: int, *, known_start: bool) -> tuple[NDArray, NDArray]:
        """What the filter knows of `count` trajectories before their first sample.

        Returns
        -------
        theta, spread : ndarray, shapes (n, q + d_x) and (n, d_x, d_x)
            `values` with the expected states, and the covariance of these.

        """
        theta, states = np.tile(self.values, (count, 1)), len(self.process)
        bounds = [(each.low or 0.0, each.high or 0.0) for each in self.equations.states]
        low, high = np.array(bounds, dtype=float).T
        if not known_start:
            low, high = self.domain.low[:states], self.domain.high[:states]
            theta[:, -states:] = (low + high) / 2
        return theta, np.tile(np.diag((high - low) ** 2 / 12), (count, 1, 1))

    def process_variance(self, states: NDArray) -> NDArray:
        """Variances (n, T, d_x) of the process noise after each sample.

        `states` (n, T, d_x) are simulated from commands alone, so that no measured deviation, as by
        a fault, makes larger ones probable. Their change is at most their range in calibration.
        """
        count = len(self.process)
        largest = self.domain.high[:count] - self.domain.low[:count]
        with np.errstate(invalid="ignore"):
            change = np.abs(np.diff(states, axis=1, append=states[:, -1:]))
        return self.process + self.proportional * np.fmin(change, largest) ** 2
