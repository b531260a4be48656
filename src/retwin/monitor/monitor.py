"""`Monitor`: watches running machines by their corrected twin, and raises alarms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from retwin.arrays import held
from retwin.checks import finite, require
from retwin.data.trajectories import Trajectories
from retwin.monitor.detector import Detector
from retwin.monitor.disturbance import Disturbance
from retwin.monitor.monitor_state import MonitorState
from retwin.monitor.predictors import Predictor, standardised
from retwin.monitor.promise import Promise
from retwin.monitor.scores import ConformalScores, middle
from retwin.monitor.slack import Slack
from retwin.monitor.validity import Validity
from retwin.monitor.watched import Alarm, Watched
from retwin.serialisation.models import read_model, refusing, write_model
from retwin.twins.twin import check_channels
from retwin.update.dynamics.online import FilterState, OnlineFilter
from retwin.update.dynamics.twin import DynamicsTwin

KIND = "monitor"
"""Kind of the saved model."""
IMPLAUSIBLE = 100.0
"""Ranges of a command in calibration by which it may leave that range. What is farther away stands
for a missing one, such as 1e9 or 3.4e38; a filter that took it for real would predict nothing until
the states have decayed from there."""


@dataclass(frozen=True, eq=False)
class Monitor:
    """A corrected twin that watches machines, with a promise of how rare false alarms are.

    A Kalman filter predicts each sample from all earlier ones, an autoregression what its errors
    have in common, and their ranks among those of the calibration are scores. An e-detector sums
    the evidence for a change of these scores (`Detector`), and a test finds out whether the
    promise applies (`Validity`). There are M such predictive models, whose filters follow the
    machine at different speeds; their evidence is averaged with equal weights, which again is that
    of an e-detector.

    Attributes
    ----------
    twin : DynamicsTwin
        The twin.
    disturbance : Disturbance
        Of M * d_y streams, the d_y outputs of the first model first.
    scores : ConformalScores
        The calibration errors of these streams.
    slack : tuple of Slack
        The classes of distributions of their scores.
    resolution : NDArray
        (d_y,), the steps to which the outputs are rounded; 0 for none.
    arl : float
        Average number of measured samples to a false alarm, at least.
    blanking : float
        Time in s after an alarm in which none is raised.
    alpha : float
        Probability of declaring a promise void that applies.
    predictors : tuple of Predictor
        The M predictive models.

    """

    twin: DynamicsTwin
    disturbance: Disturbance
    scores: ConformalScores
    slack: tuple[Slack, ...]
    resolution: NDArray
    arl: float
    blanking: float = 0.0
    alpha: float = 0.01
    predictors: tuple[Predictor, ...] = (Predictor(),)

    @property
    def warm_up(self) -> float:
        """Time in s after the first sample in which no evidence is counted: states are unknown."""
        return min(each.warm_up for each in self.predictors)

    @property
    def promises(self) -> dict[str, Promise]:
        """What is promised of each output."""
        outputs = self.twin.outputs.names
        return {
            name: Promise(
                self.arl,
                self.twin.rate,
                self.slack[i],
                self.alpha,
                self.slack[i + len(outputs) :: len(outputs)],
            )
            for i, name in enumerate(outputs)
        }

    def start(self, count: int) -> MonitorState:
        """What is known of so many machines before their first sample."""
        streams = self._streams(count)
        zeros = np.zeros(count, dtype=np.int64)
        return MonitorState(
            tuple(each.start(count) for each in self._filters),
            streams.disturbance.start(),
            streams.detector.start(count * len(self.slack)),
            streams.validity.start(count * len(self.slack)),
            zeros,
            zeros,
            np.zeros(count, dtype=bool),
        )

    def step(
        self, state: MonitorState, commands: ArrayLike, measured: ArrayLike, ids: ArrayLike = ()
    ) -> tuple[MonitorState, Watched]:
        """Watch T more samples of n machines. However samples are cut, results are the same bytes.

        Where the filter does not stay finite, it begins anew after these samples, and the promise
        does not apply to that machine any more.

        Parameters
        ----------
        state : MonitorState
            After the samples before. It is not changed.
        commands : array_like, shape (n, T, d_u)
            A command that is not finite, or is 100 times its range in calibration away from that,
            is the one before it; the first must be finite.
        measured : array_like, shape (n, T, d_y)
            Outputs; those that are not finite are missing.
        ids : sequence of str, optional
            Names of the machines.

        """
        commands, measured = (np.asarray(each, dtype=float) for each in (commands, measured))
        count, samples = measured.shape[:2]
        require(
            commands.shape == (count, samples, len(self.twin.inputs))
            and measured.shape == (count, samples, len(self.twin.outputs))
            and count == len(state.void),
            "measured",
            expected=f"samples of {len(state.void)} machines with {len(self.twin.inputs)} "
            f"commands and {len(self.twin.outputs)} outputs",
            got=f"shapes {commands.shape} and {measured.shape}",
            remedy="give arrays (machines, samples, channels)",
        )
        seen = np.isfinite(measured)
        known = self._held(state, commands)
        predicted = [
            online.step(own, known, measured, seen)
            for online, own in zip(self._filters, state.filters, strict=True)
        ]
        parts = (
            standardised(measured - mean, covariance, seen, self.resolution)
            for _, mean, covariance in predicted
        )
        pairs = zip(*parts, strict=True)
        error, width = (_by_stream(np.concatenate(each, axis=2)) for each in pairs)
        streams = self._streams(count)
        disturbance, error, scale = streams.disturbance.run(state.disturbance, error)
        width = width / scale
        low, high = self.scores.score(_by_output(error, count), _by_output(width, count))
        low, high = (_by_stream(_by_machine(each, count)) for each in (low, high))
        outputs, rate = len(self.twin.outputs), self.twin.rate
        counted = np.stack([p.used(state.samples, samples, rate) for p in self.predictors], axis=1)
        counted = np.repeat(counted, outputs, axis=1).reshape(low.shape)
        low, high = (np.where(counted, each, np.nan) for each in (low, high))
        filters = tuple(
            _finite(online, filtered)
            for online, (filtered, _, _) in zip(self._filters, predicted, strict=True)
        )
        finite_ = [np.isfinite(each).all(axis=(1, 2)) for _, each, _ in predicted]
        void = state.void | ~np.all(finite_, axis=0)
        state = replace(state, filters=filters, disturbance=disturbance, void=void)
        state, found = self._detected(streams, state, low, high, list(np.asarray(ids, dtype=str)))
        state = replace(state, samples=state.samples + samples)
        evidence, alarm, void, alarms = found
        _, mean, covariance = predicted[0]
        deviation = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
        shape = (count, len(self.slack), samples)
        score = np.moveaxis(middle(low, high).reshape(shape)[:, :outputs], 1, 2)
        outside = self.twin.outside(known) | self._implausible(commands).any(axis=(1, 2))
        return state, Watched(mean, deviation, score, evidence, alarm, void, outside, alarms)

    def watch(self, record: Trajectories) -> Watched:
        """Watch recorded trajectories, each as a machine of its own.

        Raises
        ------
        InputError
            Other channels or another rate than those of the twin.

        """
        check_channels(self.twin, record, "record")
        measured = np.where(record.mask, record.observed, np.nan)
        return self.step(self.start(len(record)), record.commands, measured, record.ids)[1]

    def _detected(
        self,
        streams: _Streams,
        state: MonitorState,
        low: NDArray,
        high: NDArray,
        ids: list[str],
    ) -> tuple[MonitorState, tuple[NDArray, NDArray, NDArray, list[Alarm]]]:
        """Evidence and alarms of scores (n * d_y, T): the detector begins anew after each alarm."""
        count, samples = len(state.void), low.shape[1]
        each = len(self.slack)
        evidence, alarm = np.zeros((count, samples)), np.zeros((count, samples), dtype=bool)
        void, alarms, first = alarm.copy(), [], 0
        pause = round(self.blanking * self.twin.rate)
        while first < samples:
            # The scores up to the next alarm, and of a machine that pauses none.
            number = np.arange(samples - first)
            paused = np.repeat(state.blank[:, None] > number, each, axis=0)
            part = [np.where(paused, np.nan, own[:, first:]) for own in (low, high)]
            detector, found = streams.detector.run(state.detector, *part)
            total = found.reshape(count, each, -1).mean(axis=1)
            raised = total >= self.arl
            ends = np.flatnonzero(raised.any(axis=0))
            last = int(ends[0]) + 1 if len(ends) else samples - first
            if last < samples - first:
                part = [own[:, :last] for own in part]
                detector, found = streams.detector.run(state.detector, *part)
            here = slice(first, first + last)
            evidence[:, here], alarm[:, here] = total[:, :last], raised[:, :last]
            now = raised[:, last - 1]
            flags = np.repeat(raised[:, :last], each, axis=0)
            validity, against = streams.validity.run(state.validity, flags, *part)
            broken = against.reshape(count, each, -1).mean(axis=1) >= 1 / self.alpha
            void[:, here] = np.logical_or.accumulate(broken, axis=1) | state.void[:, None]
            for machine in np.flatnonzero(now):
                sample = int(state.samples[machine]) + first + last - 1
                rows = slice(machine * each, (machine + 1) * each)
                output = int(np.argmax(found[rows, -1]))
                chosen = int(
                    np.argmax(detector.evidence[rows][output] * streams.detector.bets.weights)
                )
                alarms.append(
                    Alarm(
                        ids[machine] if ids else str(machine),
                        sample,
                        sample / self.twin.rate,
                        self.twin.outputs.names[output % len(self.twin.outputs)],
                        streams.detector.change(chosen),
                        float(total[machine, last - 1]),
                    )
                )
            state = replace(
                state,
                detector=streams.detector.reset(detector, np.repeat(now, each)),
                validity=validity,
                blank=np.where(now, pause, np.maximum(state.blank - last, 0)),
                void=void[:, first + last - 1],
            )
            first += last
        return state, (evidence, alarm, void, alarms)

    def _held(self, state: MonitorState, commands: NDArray) -> NDArray:
        """Commands (n, T, d_u), where those that are missing or implausible are as before."""
        given = np.concatenate([state.filters[0].commands[:, -1:], commands], axis=1)
        known = held(np.where(self._implausible(given), np.nan, given), 1)
        # Without a plausible one before, an implausible one is all that is known.
        known = np.where(np.isfinite(known), known, held(given, 1))[:, 1:]
        require(
            np.isfinite(known).all(),
            "commands",
            expected="finite commands at the first sample of each machine",
            got="others",
            remedy="begin at the first sample whose commands are known",
        )
        return known

    def _implausible(self, commands: NDArray) -> NDArray:
        """Whether commands (n, T, d_u) are so far from those of the calibration."""
        domain, states = self.twin.domain, len(self.twin.process)
        low, high = domain.low[states:], domain.high[states:]
        largest = np.maximum(high - low, np.maximum(np.abs(low), np.abs(high)))
        far = IMPLAUSIBLE * np.where(largest > 0, largest, np.inf)
        return np.isfinite(commands) & ((commands < low - far) | (commands > high + far))

    @cached_property
    def _filters(self) -> tuple[OnlineFilter, ...]:
        return tuple(each.filter(self.twin) for each in self.predictors)

    @cached_property
    def _by_count(self) -> dict[int, _Streams]:
        """The parts for each number of machines that was used: their tables take long to make."""
        return {}

    def _streams(self, count: int) -> _Streams:
        if count not in self._by_count:
            self._by_count[count] = _Streams.of(self, count)
        return self._by_count[count]

    def save(self, folder: str | Path) -> None:
        """Write the twin, the calibration and the promise."""
        about = {
            "slack": [[each.kappa, each.shift] for each in self.slack],
            "copies": self.scores.copies,
            "predictors": [[each.process, each.warm_up] for each in self.predictors],
            **{name: getattr(self, name) for name in NUMBERS},
        }
        arrays = {name: getattr(self.disturbance, name) for name in DISTURBANCE}
        arrays |= self.scores.arrays()
        arrays["resolution"] = self.resolution
        tensors = {name: torch.tensor(np.ascontiguousarray(each)) for name, each in arrays.items()}
        with write_model(folder, KIND, about, tensors) as temporary:
            self.twin.save(temporary / "twin")

    @classmethod
    def load(cls, folder: str | Path) -> Monitor:
        """Read what `save` wrote. Raises InputError if it is no monitor or is damaged."""
        about, weights = read_model(folder, KIND)
        with refusing(folder, expected="a monitor"):
            arrays = {name: each.numpy() for name, each in weights.items()}
            nothing = np.zeros((len(arrays["mean"]), 0))
            own = {name: arrays[name] for name in DISTURBANCE}
            disturbance = Disturbance(**own, held_out=nothing, deviation=nothing)
            scores = ConformalScores.of_arrays(arrays, about["copies"])
            slack = tuple(Slack(*each) for each in about["slack"])
            twin = DynamicsTwin.load(Path(folder) / "twin")
            numbers: dict[str, Any] = {
                name: finite(name, about[name], least=0.0) for name in NUMBERS
            }
            predictors = tuple(Predictor(*each) for each in about["predictors"])
            streams = len(predictors) * len(twin.outputs)
            parts = (disturbance.mean, scores.independent, slack, arrays["resolution"])
            shapes = [len(each) for each in parts]
            require(
                shapes == [streams] * 3 + [len(twin.outputs)]
                and np.isfinite(disturbance.coefficients).all()
                and (disturbance.process > 0).all()
                and (disturbance.measurement >= 0).all(),
                "weights",
                expected=f"the calibration of {len(twin.outputs)} outputs",
                got=shapes,
                remedy="save the monitor again",
            )
            numbers |= {"resolution": arrays["resolution"], "predictors": predictors}
            return cls(twin, disturbance, scores, slack, **numbers)


NUMBERS = ("arl", "blanking", "alpha")
"""Attributes of a monitor that are saved as numbers."""
DISTURBANCE = ("coefficients", "mean", "process", "measurement")
"""Attributes of the disturbance that are saved as arrays."""


@dataclass(frozen=True, eq=False)
class _Streams:
    """The parts of a monitor for the outputs of so many machines."""

    disturbance: Disturbance
    detector: Detector
    validity: Validity

    @classmethod
    def of(cls, monitor: Monitor, count: int) -> _Streams:
        repeated = {
            name: np.concatenate([getattr(monitor.disturbance, name)] * count)
            for name in DISTURBANCE
        }
        detector = Detector(monitor.slack * count)
        return cls(
            replace(monitor.disturbance, **repeated),
            detector,
            Validity(detector, monitor.arl, monitor.alpha),
        )


def _finite(online: OnlineFilter, state: FilterState) -> FilterState:
    """The state of a filter, begun anew where it is not finite."""
    kept = np.isfinite(state.states).all(axis=1) & np.isfinite(state.spread).all(axis=(1, 2))
    lost = np.flatnonzero(~kept)
    if not len(lost):
        return state
    return state.merged(lost, replace(online.start(len(lost)), commands=state.commands[lost]))


def _by_stream(values: NDArray) -> NDArray:
    """(n * d_y, T) of (n, T, d_y)."""
    return np.moveaxis(values, 2, 1).reshape(-1, values.shape[1])


def _by_output(values: NDArray, count: int) -> NDArray:
    """(d_y, n * T) of (n * d_y, T)."""
    parted = values.reshape(count, -1, values.shape[1])
    return np.moveaxis(parted, 1, 0).reshape(parted.shape[1], -1)


def _by_machine(values: NDArray, count: int) -> NDArray:
    """(n, T, d_y) of (d_y, n * T)."""
    return np.moveaxis(values.reshape(len(values), count, -1), 0, 2)
