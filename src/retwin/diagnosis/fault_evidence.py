"""`FaultEvidence`: how well faults of a system with states explain one record.

The likelihood is that of the extended Kalman filter, as a mean over the sizes and times of a fault
and over the posterior of the twin's parameters, on which predictions depend linearly.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from retwin.data.trajectories import Trajectories
from retwin.diagnosis.adaptive_grid import Integral, integrated
from retwin.twins.faults import ends_of
from retwin.twins.system_faults import (
    ActuatorGain,
    ParameterFault,
    SensorBias,
    SensorDrift,
    SensorFreeze,
    SizedFault,
    TimedFault,
    parameter_changes,
)
from retwin.update.dynamics import DynamicsTwin
from retwin.update.dynamics.prediction import root_of, whitened

COVERAGE = 0.9
"""Coverage of all intervals."""
LEVELS = (0.03, 0.1, 0.3, 1.0)
"""Standard deviations of what is unknown: of process noise per sample, in usual steps of a state,
or of measurement noise, in standard deviations of an output in the record."""
TOLERANCE = 0.1
"""Share of a fault's effect by which it may differ from that of its equation."""
FROZEN = np.array([1.0, 1e-2, 1e-4])
"""Standard deviations of a sensor that is frozen, in those of its noise in calibration."""
SMALLEST = 0.1
"""Smallest effect of parameters that counts: a change of the log density by 0.005 nats."""
ROWS = 256
"""Simulations that are filtered together, which bounds memory."""


NOTHING = np.full(3, np.nan)
"""The size, onset and end of no fault."""

_Noise = tuple[NDArray | float, NDArray | float]
_Given = tuple[NDArray, NDArray, NDArray, NDArray | None]


@dataclass(frozen=True, eq=False)
class FaultEvidence:
    """One trajectory, with the filter of a twin.

    Attributes
    ----------
    twin : DynamicsTwin
        The corrected dynamics.
    commands, measured, seen : NDArray
        (T, d_u), (T, d_y) and (T, d_y) bool.
    known_start : bool
        See `StateInversionDiagnoser.diagnose`.

    """

    twin: DynamicsTwin
    commands: NDArray
    measured: NDArray
    seen: NDArray
    known_start: bool

    @classmethod
    def of(cls, twin: DynamicsTwin, trajectory: Trajectories, known_start: bool) -> FaultEvidence:
        """That of one trajectory, whose outputs are 0 where they were not measured."""
        seen = trajectory.mask[0]
        measured = np.where(seen, trajectory.observed[0].astype(np.float64), 0.0)
        return cls(twin, trajectory.commands[0].astype(np.float64), measured, seen, known_start)

    def largest_error(self) -> float:
        """The largest error of a prediction for the healthy system, in standard deviations."""
        given = (self.commands[None], self.measured[None], self.seen[None])
        mean, covariance, _ = self.twin.filter(*given, known_start=self.known_start)
        errors = whitened(self.measured - mean, root_of(covariance, given[2]), given[2])
        return float(np.abs(errors).max()) if np.isfinite(errors).all() else np.inf

    def integral(self, fault: TimedFault | None) -> Integral:
        """The evidence for a fault, and the posterior of its size, onset and end."""
        steps, rate = len(self.commands), self.twin.rate
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

        found = integrated(log_likelihood, limits, np.array([False, True, True]), COVERAGE)
        missing = np.array(
            [not isinstance(fault, SizedFault), False, fault.end is None], dtype=bool
        )
        scale = np.array([1.0, rate, rate])
        ends = (np.where(missing, np.nan, e / scale) for e in (found.low, found.mean, found.high))
        return Integral(found.evidence, found.best, *ends)

    def tolerated(self, fault: TimedFault | None, found: Integral) -> Integral:
        """The same with the evidence for a fault whose effect differs somewhat from its equation.

        The difference is noise, as probable beforehand as none.
        """
        if fault is None or not np.isfinite(found.evidence):
            return found
        states, outputs = self._effect(fault, found.best)
        noise = ((TOLERANCE * states) ** 2, (TOLERANCE * outputs) ** 2)
        gain = self._gain(fault, found.best, noise, self._slopes(noise))
        return replace(found, evidence=found.evidence + float(np.logaddexp(0, gain) - np.log(2)))

    def unknown(self, faults: Iterable[TimedFault | None], found: Iterable[Integral]) -> float:
        """The evidence for something else besides one of the faults, or besides none.

        It adds noise to what the twin predicts with the most probable size and times of the fault.
        """
        pairs = [each for each in zip(faults, found, strict=True) if np.isfinite(each[1].evidence)]
        made = []
        for noise in self._noises():
            slopes = self._slopes(noise)
            for fault, own in pairs:
                made.append(own.evidence + self._gain(fault, own.best, noise, slopes))
        return float(logsumexp(made) - np.log(len(made))) if made else -np.inf

    def _gain(
        self, fault: TimedFault | None, point: NDArray, noise: _Noise, slopes: NDArray
    ) -> float:
        """By how much more noise, with the slopes of its filter, raises a log density."""
        given, _ = self._inputs(fault, point[None])
        more = self._log_density(*given, more=noise, slopes=slopes)
        less = self._log_density(*given, slopes=self._by_parameters)
        return float(more[0] - less[0]) if np.isfinite(more[0]) else -np.inf

    def _effect(self, fault: TimedFault, point: NDArray) -> tuple[NDArray, NDArray]:
        """Root mean square effects of a fault on states, per sample, and on measured outputs."""
        twin = self.twin
        (commands, measured, seen, changes), _ = self._inputs(fault, point[None])
        x = twin.filter(commands, measured, seen, changes=changes, known_start=self.known_start)[2]
        own = None if changes is None else changes[0]
        slopes = twin.slope(x[0], commands[0], own) - twin.slope(x[0], self.commands)
        steps = slopes if twin.equations.step else slopes / twin.rate
        active = _fixed(fault, point, twin.rate).active(len(self.commands), twin.rate)
        both = (steps[active], (measured[0] - self.measured)[active])
        return tuple(np.sqrt(np.mean(each**2, axis=0)) for each in both)

    def _noises(self) -> list[_Noise]:
        """Variances that are added to those of process or measurement noise."""
        twin = self.twin
        step = twin.domain.speed if twin.equations.step else twin.domain.speed / twin.rate
        columns = zip(self.measured.T, self.seen.T, strict=True)
        usual = np.array([own[seen].std() if seen.any() else 0.0 for own, seen in columns])
        more: list[_Noise] = [((level * step) ** 2, 0.0) for level in LEVELS]
        return more + [(0.0, (level * usual) ** 2) for level in LEVELS]

    def _under(self, fault: TimedFault | None, points: NDArray) -> NDArray:
        """Log likelihoods (J,) under a fault of these sizes, onsets and ends (J, 3), in samples."""
        made = []
        for rows in range(0, len(points), ROWS):
            given, gain = self._inputs(fault, points[rows : rows + ROWS])
            made.append(gain + self._log_density(*given, slopes=self._by_parameters))
        return np.concatenate(made)

    def _inputs(self, fault: TimedFault | None, points: NDArray) -> tuple[_Given, NDArray]:
        """What the filter takes under a fault at points (J, 3), and log densities (J,) besides."""
        steps, rate = len(self.commands), self.twin.rate
        shape = (len(points), 1, 1)
        commands, measured = np.tile(self.commands, shape), np.tile(self.measured, shape)
        seen, gain, changes = np.tile(self.seen, shape), np.zeros(len(points)), None
        made = [_fixed(fault, point, rate) for point in points] if fault is not None else []
        if isinstance(fault, ParameterFault):
            changes = parameter_changes(made, self.twin.shiftable, steps, rate)
        for i, each in enumerate(made):
            match each:
                case ActuatorGain(actuator=actuator):
                    commands[i, :, actuator] *= 1 + each.profile(steps, rate)
                case SensorFreeze(output=output):
                    gain[i] = self._frozen(output, each.active(steps, rate), seen[i])
                case SensorBias(output=output) | SensorDrift(output=output):
                    measured[i, :, output] -= each.profile(steps, rate)
        return (commands, measured, seen, changes), gain

    def _frozen(self, output: int, active: NDArray, seen: NDArray) -> float:
        """Log density of a frozen sensor's samples, which are removed from those `seen` (T, d_y).

        It repeats the sample of the onset, with a noise that cannot be smaller than what the steps
        of its digits make.
        """
        places = np.flatnonzero(active & seen[:, output])
        if len(places) < 2:
            return 0.0
        error = self.measured[places[1:], output] - self.measured[places[0], output]
        seen[places[1:], output] = False
        least = _digit(self.measured[self.seen[:, output], output]) / np.sqrt(12)
        deviation = np.maximum(FROZEN * np.sqrt(self.twin.noise[output]), least)
        each = -0.5 * np.sum((error / deviation[:, None]) ** 2, axis=1)
        each -= len(error) * np.log(deviation * np.sqrt(2 * np.pi))
        return float(logsumexp(each) - np.log(len(FROZEN)))

    def _log_density(
        self,
        commands: NDArray,
        measured: NDArray,
        seen: NDArray,
        changes: NDArray | None,
        *,
        slopes: NDArray,
        more: _Noise = (0.0, 0.0),
    ) -> NDArray:
        """Log densities (J,) of what was measured; minus infinity where they are not finite.

        They are means over the posterior of the twin's parameters, on which the predictions depend
        linearly, with `slopes` (T, d_y, r), those of the healthy system.
        """
        mean, covariance, _ = self.twin.filter(
            commands, measured, seen, changes=changes, more=more, known_start=self.known_start
        )
        made, factor = np.full(len(commands), -np.inf), root_of(covariance, seen)
        finite = np.isfinite(mean).all(axis=(1, 2)) & np.isfinite(factor).all(axis=(1, 2, 3))
        good = np.flatnonzero(finite)
        if not len(good):
            return made
        own, factor = seen[good], factor[good]
        errors = whitened((measured - mean)[good], factor, own).reshape(len(good), -1)
        slopes = np.where(own[..., None], slopes, 0.0)
        slopes = np.linalg.solve(factor, slopes).reshape(len(good), errors.shape[1], -1)
        curvature = np.eye(slopes.shape[2]) + slopes.swapaxes(1, 2) @ slopes
        gradient = (slopes.swapaxes(1, 2) @ errors[..., None])[..., 0]
        gain = np.sum(gradient * np.linalg.solve(curvature, gradient[..., None])[..., 0], axis=1)
        gain -= np.linalg.slogdet(curvature)[1]
        logs = 2 * np.log(np.diagonal(factor, axis1=2, axis2=3)).sum(axis=(1, 2))
        constant = own.sum(axis=(1, 2)) * np.log(2 * np.pi)
        with np.errstate(over="ignore", invalid="ignore"):
            made[good] = 0.5 * (gain - np.sum(errors**2, axis=1) - logs - constant)
        return np.where(np.isnan(made), -np.inf, made)

    @cached_property
    def _by_parameters(self) -> NDArray:
        """Those of the twin with its own noise."""
        return self._slopes((0.0, 0.0))

    def _slopes(self, more: _Noise) -> NDArray:
        """Derivatives (T, d_y, r) of predictions by the parameters, along r directions."""
        given = tuple(each[None] for each in (self.commands, self.measured, self.seen))
        made = self.twin.slopes(*given, more=more, known_start=self.known_start)[0]
        made = np.where(self.seen[..., None], made, 0.0)
        covariance = self.twin.filter(*given, more=more, known_start=self.known_start)[1]
        factor = root_of(covariance[:1], self.seen[None])[0]
        scaled = np.linalg.solve(factor, made).reshape(-1, made.shape[2])
        if not np.isfinite(scaled).all():
            return made[..., :0]
        _, values, directions = np.linalg.svd(scaled, full_matrices=False)
        return made @ directions[values > SMALLEST].T


def _digit(values: NDArray) -> float:
    """The smallest step between values, beyond rounding."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > 1e-9 * np.abs(values).max()]
    return float(steps.min()) if len(steps) else 0.0


def _fixed(fault: TimedFault, point: NDArray, rate: float) -> TimedFault:
    """The fault with the size, and from and to the samples, of a point (3,)."""
    size, onset, end = point.tolist()
    timed = replace(fault, onset=onset / rate, end=max(end, onset + 1) / rate)
    return replace(timed, size=size) if isinstance(timed, SizedFault) else timed
