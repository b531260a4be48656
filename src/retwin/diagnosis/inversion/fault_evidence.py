"""`FaultEvidence`: how well faults of a system with states explain one record.

The likelihood is that of the extended Kalman filter, as a mean over the sizes and times of a fault
and over the posterior of the twin's parameters, on which predictions depend linearly.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from retwin.data.trajectories import Trajectories
from retwin.diagnosis.inversion.adaptive_grid import Integral, integrate
from retwin.twins.faults.actuator_faults import ends_of
from retwin.twins.faults.system_faults import (
    ActuatorGain,
    ParameterFault,
    SensorError,
    SensorFreeze,
    SizedFault,
    TimedFault,
)
from retwin.update.dynamics import DynamicsTwin
from retwin.update.dynamics.filter.likelihood import NoiseVariances, Record, Variants
from retwin.update.dynamics.filter.prediction import root_of, whitened
from retwin.update.identification.identifiability import correlation_time

LEVELS = (0.03, 0.1, 0.3, 1.0)
"""Standard deviations of what is unknown: of process noise per sample, in usual steps of a state,
or of measurement noise, in standard deviations of an output in the record."""
FROZEN = np.array([1e-2, 1e-4])
"""Standard deviations of a sensor that is frozen, in those of its noise in calibration. With all of
that noise it would be the last sample that is held, which predicts a machine at rest better than a
twin whose noise contains what it lacks."""
ROWS = 256
"""Simulations that are filtered together, which bounds memory."""


NOTHING = np.full(3, np.nan)
"""The size, onset and end of no fault."""

_Hypothesis = tuple[TimedFault | None, NDArray]
"""A fault with its size, onset and end, (3,), in samples."""


@dataclass(frozen=True, eq=False)
class FaultEvidence:
    """One trajectory, with the filter of a twin.

    Attributes
    ----------
    record : Record
        The commands and outputs of the trajectory, with the corrected dynamics.

    """

    record: Record

    @classmethod
    def of(cls, twin: DynamicsTwin, trajectory: Trajectories, known_start: bool) -> FaultEvidence:
        """That of one trajectory, whose outputs are 0 where they were not measured."""
        seen = trajectory.mask[0]
        measured = np.where(seen, trajectory.observed[0].astype(np.float64), 0.0)
        commands = trajectory.commands[0].astype(np.float64)
        return cls(Record(twin, commands, measured, seen, known_start))

    @property
    def twin(self) -> DynamicsTwin:
        """The corrected dynamics."""
        return self.record.twin

    def largest_error(self) -> float:
        """The largest error of a prediction for the healthy system, in standard deviations."""
        measured, seen = self.record.measured[None], self.record.seen[None]
        mean, covariance, _ = self.record.filtered(Variants())
        errors = whitened(measured - mean, root_of(covariance, seen), seen)
        return float(np.abs(errors).max()) if np.isfinite(errors).all() else np.inf

    def integral(self, fault: TimedFault | None, *, coverage: float = 0.9) -> Integral:
        """The evidence for a fault, and the posterior of its size, onset and end.

        Parameters
        ----------
        coverage : float, default 0.9
            Coverage of all intervals.

        """
        steps, rate = len(self.record.commands), self.twin.rate
        if fault is None:
            return Integral(float(self._under(None, NOTHING[None])[0]), *[NOTHING] * 4)
        sizes = ends_of(fault.size) if isinstance(fault, SizedFault) else (1.0, 1.0)
        limits = np.array([sizes, fault.onset_range(steps, rate), fault.end_range(steps, rate)])

        def log_likelihood(points: NDArray) -> NDArray:
            _, onset, end = points.T
            # As it is drawn: the onset, and then an end after it.
            first = np.maximum(limits[2, 0], onset + 1)
            choices = np.maximum(limits[2, 1], onset + 1) - first + 1
            own = np.log((limits[2, 1] - limits[2, 0] + 1) / choices)
            possible = (end >= first) | (limits[2, 0] == limits[2, 1])
            return np.where(possible, own + self._under(fault, points), -np.inf)

        whole = np.array([False, True, True])
        found = integrate(log_likelihood, limits, whole, coverage, effect=0)
        missing = np.array([not isinstance(fault, SizedFault), False, fault.end is None])
        scale = np.where(missing, np.nan, [1.0, rate, rate])
        low, mean, high = (each / scale for each in (found.low, found.mean, found.high))
        if not missing[0] and np.isfinite(found.evidence):
            more = np.sqrt(self.dispersion(fault, found.best))
            low[0] = max(sizes[0], mean[0] - more * (mean[0] - low[0]))
            high[0] = min(sizes[1], mean[0] + more * (high[0] - mean[0]))
        return Integral(found.evidence, found.best, low, mean, high)

    def dispersion(self, fault: TimedFault | None, point: NDArray) -> float:
        """The long-run variance of the standardised errors with a fault, at least 1.

        They are those with the parameters that are most probable then, independent and of variance
        1 where the twin with the fault lacks nothing. By that factor the variance of a size is
        larger than its likelihood says, and log likelihoods differ by less (Pauli, Racugno and
        Ventura, "Bayesian composite marginal likelihoods", Statistica Sinica 21, 2011).
        """
        variants, _ = self._inputs(fault, point[None])
        _, measured, seen, _ = self.record.inputs(variants)
        mean, covariance, _ = self.record.filtered(variants)
        factor = root_of(covariance, seen)
        errors = np.where(seen, whitened(measured - mean, factor, seen), 0.0)
        if not np.isfinite(errors).all() or not errors.any():
            return 1.0
        by_parameters = np.where(seen[0, ..., None], self._by_parameters, 0.0)
        slopes = np.linalg.solve(factor[0], by_parameters).reshape(errors.size, -1)
        curvature = slopes.T @ slopes + np.eye(slopes.shape[1])
        explained = slopes @ np.linalg.solve(curvature, slopes.T @ errors.ravel())
        errors = errors - explained.reshape(errors.shape)
        variance = np.sum(errors**2) / seen.sum()
        return float(max(1.0, variance * correlation_time(errors)))

    def tolerated(
        self, fault: TimedFault | None, found: Integral, *, tolerance: float = 0.1
    ) -> Integral:
        """The same with the evidence for a fault whose effect differs somewhat from its equation.

        The difference is noise, as probable beforehand as none.

        Parameters
        ----------
        tolerance : float, default 0.1
            Share of a fault's effect by which it may differ from that of its equation.

        """
        if fault is None or not np.isfinite(found.evidence):
            return found
        states, outputs = self._effect(fault, found.best)
        noise = ((tolerance * states) ** 2, (tolerance * outputs) ** 2)
        gain = self._gains([(fault, found.best)], noise)[0]
        return replace(found, evidence=found.evidence + float(np.logaddexp(0, gain) - np.log(2)))

    def unknown(self, faults: Iterable[TimedFault | None], found: Iterable[Integral]) -> float:
        """The evidence for something else besides one of the faults, or besides none.

        It adds noise to what the twin predicts with the most probable size and times of the fault.
        """
        pairs = [each for each in zip(faults, found, strict=True) if np.isfinite(each[1].evidence)]
        points = [(fault, own.best) for fault, own in pairs]
        evidence = np.array([own.evidence for _, own in pairs])
        made = [evidence + self._gains(points, noise) for noise in self._noises()] if pairs else []
        return float(logsumexp(made) - np.log(np.size(made))) if pairs else -np.inf

    def _gains(self, points: Sequence[_Hypothesis], noise: NoiseVariances) -> NDArray:
        """By how much more noise, with the slopes of its filter, raises log densities (J,)."""
        slopes, own = self._slopes(noise), [self._inputs(fault, p[None])[0] for fault, p in points]
        more = np.array([self.record.log_density(each, slopes, noise)[0] for each in own])
        less = [self.record.log_density(each, self._by_parameters)[0] for each in own]
        return np.where(np.isfinite(more), more - less, -np.inf)

    def _effect(self, fault: TimedFault, point: NDArray) -> tuple[NDArray, NDArray]:
        """Root mean square effects of a fault on states, per sample, and on measured outputs."""
        twin, record = self.twin, self.record
        variants, _ = self._inputs(fault, point[None])
        commands, measured, _, changes = record.inputs(variants)
        x = record.filtered(variants)[2][0]
        own = None if changes is None else changes[0]
        slopes = twin.slope(x, commands[0], own) - twin.slope(x, record.commands)
        steps = slopes if twin.equations.step else slopes / twin.rate
        active = _active(point[None], len(record.commands))[0]
        both = (steps[active], (measured[0] - record.measured)[active])
        return tuple(np.sqrt(np.mean(each**2, axis=0)) for each in both)

    def _noises(self) -> list[NoiseVariances]:
        """Variances that are added to those of process or measurement noise."""
        twin = self.twin
        step = twin.domain.speed if twin.equations.step else twin.domain.speed / twin.rate
        columns = zip(self.record.measured.T, self.record.seen.T, strict=True)
        usual = np.array([own[seen].std() if seen.any() else 0.0 for own, seen in columns])
        more: list[NoiseVariances] = [((level * step) ** 2, 0.0) for level in LEVELS]
        return more + [(0.0, (level * usual) ** 2) for level in LEVELS]

    def _under(self, fault: TimedFault | None, points: NDArray) -> NDArray:
        """Log likelihoods (J,) under a fault of these sizes, onsets and ends (J, 3), in samples."""
        made = []
        for rows in range(0, len(points), ROWS):
            variants, gain = self._inputs(fault, points[rows : rows + ROWS])
            made.append(gain + self.record.log_density(variants, self._by_parameters))
        return np.concatenate(made)

    def _inputs(self, fault: TimedFault | None, points: NDArray) -> tuple[Variants, NDArray]:
        """What a fault changes of the record at points (J, 3), and log densities (J,) besides."""
        record, none = self.record, np.zeros(len(points))
        (size, onset, _), active = points.T, _active(points, len(record.commands))
        match fault:
            case ParameterFault(parameter=name):
                change = fault.profiles(active, size, onset, self.twin.rate)
                place = self.twin.equations.names.index(name)
                return Variants(change=change, parameter=place), none
            case ActuatorGain(actuator=place):
                commands = np.tile(record.commands, (len(points), 1, 1))
                commands[..., place] *= 1 + fault.profiles(active, size, onset, self.twin.rate)
                return Variants(commands=commands), none
            case SensorError(output=place):
                measured = np.tile(record.measured, (len(points), 1, 1))
                error = fault.profiles(active, size, onset, self.twin.rate)
                if fault.relative:
                    # Of what is expected from earlier samples: noise is as without the fault.
                    true = measured.copy()
                    true[..., place] /= 1 + error
                    error = error * record.filtered(Variants(measured=true))[0][..., place]
                measured[..., place] -= error
                return Variants(measured=measured), none
            case SensorFreeze(output=place):
                seen = np.tile(record.seen, (len(points), 1, 1))
                pairs = zip(active, seen, strict=True)
                gain = [self._density_frozen(place, own, each) for own, each in pairs]
                return Variants(seen=seen), np.array(gain)
        return Variants(), none

    def _density_frozen(self, output: int, active: NDArray, seen: NDArray) -> float:
        """Log density of a frozen sensor's samples, which are removed from those `seen` (T, d_y).

        It repeats the sample of the onset, with a noise that cannot be smaller than what the steps
        of its digits make.
        """
        places = np.flatnonzero(active & seen[:, output])
        if len(places) < 2:
            return 0.0
        measured, known = self.record.measured[:, output], self.record.seen[:, output]
        error = measured[places[1:]] - measured[places[0]]
        seen[places[1:], output] = False
        least = _digit(measured[known]) / np.sqrt(12)
        deviation = np.maximum(FROZEN * np.sqrt(self.twin.noise[output]), least)
        each = -0.5 * np.sum((error / deviation[:, None]) ** 2, axis=1)
        each -= len(error) * np.log(deviation * np.sqrt(2 * np.pi))
        return float(logsumexp(each) - np.log(len(FROZEN)))

    @cached_property
    def _by_parameters(self) -> NDArray:
        """Those of the twin with its own noise."""
        return self._slopes((0.0, 0.0))

    def _slopes(self, more: NoiseVariances, *, smallest: float = 0.1) -> NDArray:
        """Derivatives (T, d_y, r) of predictions by the parameters, along r directions.

        Parameters
        ----------
        smallest : float, default 0.1
            Smallest effect of parameters that counts: a change of the log density by 0.005 nats.

        """
        record = self.record
        given = (each[None] for each in (record.commands, record.measured, record.seen))
        made = self.twin.filter.slopes(*given, more=more, known_start=record.known_start)[0]
        made = np.where(record.seen[..., None], made, 0.0)
        covariance = record.filtered(Variants(), more)[1]
        factor = root_of(covariance, record.seen[None])[0]
        scaled = np.linalg.solve(factor, made).reshape(made.shape[0] * made.shape[1], -1)
        if not np.isfinite(scaled).all():
            return made[..., :0]
        _, values, directions = np.linalg.svd(scaled, full_matrices=False)
        return made @ directions[values > smallest].T


def _digit(values: NDArray) -> float:
    """The smallest step between values, beyond rounding."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > 1e-9 * np.abs(values).max()]
    return float(steps.min()) if len(steps) else 0.0


def _active(points: NDArray, steps: int) -> NDArray:
    """Whether faults with the onsets and ends of points (J, 3), in samples, act: (J, T) bool."""
    onset, end = points[:, 1:2], points[:, 2:]
    index = np.arange(steps)
    return np.asarray((index >= onset) & (index < np.maximum(end, onset + 1)))
