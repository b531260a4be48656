"""`OnlineFilter`: one-step predictions of running systems, sample by sample.

The extended Kalman filter of `DynamicsTwin.predictive` with what it carries from one sample to the
next in arrays, so that it can be stopped and continued: however samples are cut into calls, the
results are the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import ceil

import numpy as np
from numpy.typing import NDArray

from retwin.twins.interpolation import TAPS
from retwin.update.dynamics.twin import DynamicsTwin

__all__ = ["FilterState", "OnlineFilter"]

GATE = 100.0
"""Number of standard deviations from which on an error is no news of the states: a sample of 1e300
would stay in them. Where such samples persist, the uncertainty grows until they are used."""


@dataclass(frozen=True, eq=False)
class FilterState:
    """What is known of n systems after their last sample.

    Attributes
    ----------
    states, spread : NDArray
        (n, d_x) and (n, d_x, d_x), means and covariances of the states.
    simulated : NDArray
        (n, d_x), states that are simulated from commands alone.
    commands : NDArray
        (n, H, d_u), the last commands; NaN before the first sample.

    """

    states: NDArray
    spread: NDArray
    simulated: NDArray
    commands: NDArray

    def of(self, rows: NDArray) -> FilterState:
        """That of some systems."""
        return FilterState(*(getattr(self, each.name)[rows] for each in fields(self)))

    def merged(self, rows: NDArray, other: FilterState) -> FilterState:
        """The same with that of some systems in place of theirs."""
        made = [getattr(self, each.name).copy() for each in fields(self)]
        for own, new in zip(made, fields(self), strict=True):
            own[rows] = getattr(other, new.name)
        return FilterState(*made)


@dataclass(frozen=True, eq=False)
class OnlineFilter:
    """The filter of a twin for systems that run.

    Commands between samples are interpolated through the present and earlier ones alone, since
    later ones are not known yet.

    Attributes
    ----------
    twin : DynamicsTwin
        The twin at its most probable parameters.

    """

    twin: DynamicsTwin

    def start(self, count: int) -> FilterState:
        """What is known of so many systems before their first sample, which may be anywhere."""
        theta, spread = self.twin.filter.start(count, known_start=False)
        twin = self.twin.equations
        delays = [self.twin.values[place] for _, place in twin.delay_places]
        earlier = TAPS if twin.interpolation == "spline" else 1
        earlier += ceil(max(delays) * twin.rate) + 1 if delays else 0
        commands = np.full((count, earlier, len(self.twin.inputs)), np.nan)
        states = theta[:, -spread.shape[1] :]
        return FilterState(states, spread, states, commands)

    def step(
        self, state: FilterState, commands: NDArray, measured: NDArray, seen: NDArray
    ) -> tuple[FilterState, NDArray, NDArray]:
        """Predict T more samples of n systems, each from all earlier ones, and then use it.

        Parameters
        ----------
        state : FilterState
            After the samples before.
        commands, measured, seen : ndarray, shapes (n, T, d_u), (n, T, d_y), (n, T, d_y)
            Commands, finite; outputs, and whether each was measured.

        Returns
        -------
        state : FilterState
            After these samples.
        mean, covariance : ndarray, shapes (n, T, d_y) and (n, T, d_y, d_y)
            Of the outputs given all earlier samples, with measurement noise. Not finite where the
            filter diverges, which a new `start` mends.

        """
        if self.twin.equations.interpolation != "spline":
            return self._passed(state, commands, measured, seen)
        found = []
        for t in range(commands.shape[1]):  # a later command would change the spline
            part = slice(t, t + 1)
            state, *more = self._passed(state, commands[:, part], measured[:, part], seen[:, part])
            found.append(more)
        mean, covariance = (np.concatenate(each, axis=1) for each in zip(*found, strict=True))
        return state, mean, covariance

    def _passed(
        self, state: FilterState, commands: NDArray, measured: NDArray, seen: NDArray
    ) -> tuple[FilterState, NDArray, NDArray]:
        earlier = np.where(np.isnan(state.commands), commands[:, :1], state.commands)
        path = np.concatenate([earlier, commands], axis=1)
        theta = np.tile(self.twin.values, (len(commands), 1))
        theta[:, -state.states.shape[1] :] = state.states
        # The sample before is that of `state`, and was used.
        pad = [(0, 0), (1, 0), (0, 0)]
        given = np.pad(np.where(seen, measured, 0.0), pad), np.pad(seen, pad)
        steps, first = self.twin.equations.steps(), earlier.shape[1] - 1
        process, simulated = self.twin.process, state.simulated
        if self.twin.proportional.any():
            own = np.concatenate([theta[:, : -simulated.shape[1]], simulated], axis=1)
            course = steps.run(path, own, first=first)[1]
            process, simulated = self.twin.filter.process_variance(course), course[:, -1]
        variances = process, self.twin.noise
        mean, covariance, states, spread = steps.filter(
            path, theta, given, state.spread, variances, first=first, gate=GATE
        )
        after = FilterState(states[:, -1], spread, simulated, path[:, -earlier.shape[1] :])
        return after, mean[:, 1:], covariance[:, 1:]
