"""`OnlineFilter`: one-step predictions of running systems, sample by sample.

The extended Kalman filter of `DynamicsTwin.predictive` with what it carries from one sample to the
next in arrays, so that it can be stopped and continued: however samples are cut into calls, the
results are the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from math import ceil

import numpy as np
from numpy.typing import NDArray

from retwin.twins.equations.interpolation import TAPS
from retwin.update.dynamics.filter.filtering import STEP
from retwin.update.dynamics.filter.prediction import Narrowing
from retwin.update.dynamics.twin import DynamicsTwin

__all__ = ["FilterState", "OnlineFilter", "moved", "with_main_directions"]

GATE = 100.0
"""Number of standard deviations from which on an error is no news of the states: a sample of 1e300
would stay in them. Where such samples persist, the uncertainty grows until they are used."""

MAX_DIRECTIONS = 32
"""Directions in which the parameters of a system may differ from those of its twin, at most: the
filter has a copy for each. A library of terms has hundreds, most of which hardly change outputs."""


@dataclass(frozen=True, eq=False)
class FilterState:
    """What is known of n systems after their last sample.

    Attributes
    ----------
    states, spread : NDArray
        (n, 1 + r, d_x) and (n, 1 + r, d_x, d_x), means and covariances of the states at the most
        probable parameters, and at others along each of r directions.
    simulated : NDArray
        (n, d_x), states that are simulated from commands alone.
    commands : NDArray
        (n, H, d_u), the last commands; NaN before the first sample.
    centre, root : NDArray
        (n, r) and (n, r, r), the parameters of each system along these directions, in posterior
        deviations: their mean, and a factor of their covariance.

    """

    states: NDArray
    spread: NDArray
    simulated: NDArray
    commands: NDArray
    centre: NDArray
    root: NDArray

    def of(self, rows: NDArray) -> FilterState:
        """That of some systems."""
        return FilterState(*(getattr(self, each.name)[rows] for each in fields(self)))

    def merged(self, rows: NDArray, other: FilterState) -> FilterState:
        """The same with that of some systems in place of theirs."""
        made = [getattr(self, each.name).copy() for each in fields(self)]
        for own, new in zip(made, fields(self), strict=True):
            own[rows] = getattr(other, new.name)
        return FilterState(*made)


def moved(twin: DynamicsTwin, centre: Sequence[float]) -> DynamicsTwin:
    """The twin of a system whose parameters are at `centre` (r,), or at () the most probable."""
    if not len(centre):
        return twin
    directions = twin.filter.directions(known_start=False)
    return replace(twin, values=twin.values + np.asarray(centre) @ directions)


def with_main_directions(twin: DynamicsTwin, commands: NDArray) -> DynamicsTwin:
    """The twin whose parameters are uncertain along their `MAX_DIRECTIONS` main directions alone.

    They are the principal ones of the effect of posterior deviations on simulated outputs, in
    deviations of their noise. A twin with no more directions stays as it is.

    Parameters
    ----------
    twin : DynamicsTwin
        The twin.
    commands : ndarray, shape (n, T, d_u)
        Those that are simulated.

    """
    if len(twin.filter.directions(known_start=False)) <= MAX_DIRECTIONS:
        return twin
    running = twin.factor.copy()
    running[-len(twin.process) :] = 0.0  # of a running system the start does not matter
    theta = np.tile(twin.values, (len(commands), 1))
    slopes = twin.equations.steps().sensitivities(commands, theta)[1] @ running
    effects = (slopes / np.sqrt(twin.noise)[:, None]).reshape(-1, running.shape[1])
    effects = effects[np.isfinite(effects).all(axis=1)]
    main = np.linalg.eigh(effects.T @ effects)[1][:, -MAX_DIRECTIONS:]
    return replace(twin, factor=twin.factor @ main)


@dataclass(frozen=True, eq=False)
class OnlineFilter:
    """The filter of a twin for systems that run.

    Commands between samples are interpolated through the present and earlier ones alone, since
    later ones are not known yet.

    Attributes
    ----------
    twin : DynamicsTwin
        The twin.
    effect : float
        By how many posterior deviations the parameters of systems differ from the most probable
        ones. They are estimated as the samples come; with 0 they are the most probable ones.

    """

    twin: DynamicsTwin
    effect: float = 0.0

    @cached_property
    def _moves(self) -> NDArray:
        """What is added to the values of the twin (1 + r, q + d_x); the first row is 0."""
        moves = STEP * self.twin.filter.directions(known_start=False)
        none = np.zeros((1, moves.shape[1]))
        return np.concatenate([none, moves]) if self.effect else none

    def start(self, count: int) -> FilterState:
        """What is known of so many systems before their first sample, which may be anywhere."""
        theta, spread = self.twin.filter.start(count, known_start=False)
        twin, moved = self.twin.equations, len(self._moves)
        delays = [self.twin.values[place] for _, place in twin.delay_places]
        earlier = TAPS if twin.interpolation == "spline" else 1
        earlier += ceil(max(delays) * twin.rate) + 1 if delays else 0
        commands = np.full((count, earlier, len(self.twin.inputs)), np.nan)
        states = theta[:, -spread.shape[1] :]
        both = [np.repeat(each[:, None], moved, axis=1) for each in (states, spread)]
        root = np.tile(self.effect * np.eye(moved - 1), (count, 1, 1))
        centre = np.zeros((count, moved - 1))
        return FilterState(both[0], both[1], states, commands, centre, root)

    def step(
        self,
        state: FilterState,
        commands: NDArray,
        measured: NDArray,
        seen: NDArray,
        learn: NDArray | None = None,
    ) -> tuple[FilterState, NDArray, NDArray]:
        """Predict T more samples of n systems, each from all earlier ones, and then use it.

        Parameters
        ----------
        state : FilterState
            After the samples before.
        commands, measured, seen : ndarray, shapes (n, T, d_u), (n, T, d_y), (n, T, d_y)
            Commands, finite; outputs, and whether each was measured.
        learn : ndarray, shape (n,), optional
            Whether the parameters of each system are estimated from these samples; default all.

        Returns
        -------
        state : FilterState
            After these samples.
        mean, covariance : ndarray, shapes (n, T, d_y) and (n, T, d_y, d_y)
            Of the outputs given all earlier samples, with measurement noise. Not finite where the
            filter diverges, which a new `start` mends.

        """
        learn = np.ones(len(commands), dtype=bool) if learn is None else learn
        earlier = np.where(np.isnan(state.commands), commands[:, :1], state.commands)
        path = np.concatenate([earlier, commands], axis=1)
        count, moved, states = state.states.shape
        theta = np.tile(self.twin.values + self._moves, (count, 1))
        theta[:, -states:] = state.states.reshape(-1, states)
        # The sample before is that of `state`, and was used.
        pad = [(0, 0), (1, 0), (0, 0)]
        given = np.pad(np.where(seen, measured, 0.0), pad), np.pad(seen, pad)
        steps = replace(self.twin.equations.steps(), causal=True)
        first = earlier.shape[1] - 1
        process, simulated = self.twin.process, state.simulated
        if self.twin.proportional.any():
            own = np.concatenate([theta[::moved, :-states], simulated], axis=1)
            course = steps.run(path, own, first=first)[1]
            process, simulated = self.twin.filter.process_variance(course), course[:, -1]
            process = np.repeat(process, moved, axis=0)
        means, covariances, after, spread = steps.filter(
            np.repeat(path, moved, axis=0),
            theta,
            (np.repeat(given[0], moved, axis=0), np.repeat(given[1], moved, axis=0)),
            state.spread.reshape(-1, states, states),
            (process, self.twin.noise),
            first=first,
            gate=GATE,
        )
        means = means[:, 1:].reshape(count, moved, *measured.shape[1:])
        mean, covariance = means[:, 0], covariances[::moved, 1:]
        centre, root = state.centre, state.root
        if moved > 1:
            good = np.isfinite(means).all(axis=1, keepdims=True)
            difference = np.where(good, means, 0.0)
            slopes = np.moveaxis(difference[:, 1:] - difference[:, :1], 1, -1) / STEP
            narrowing = Narrowing(centre, root)
            used = seen & learn[:, None, None]
            mean, covariance = narrowing.run(mean, covariance, measured, used, slopes, GATE)
            centre, root = narrowing.centre, narrowing.root
        last = after[:, -1].reshape(count, moved, states), spread.reshape(state.spread.shape)
        kept = FilterState(*last, simulated, path[:, -earlier.shape[1] :], centre, root)
        return kept, mean, covariance
