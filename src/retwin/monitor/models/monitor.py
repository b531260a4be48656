"""`Monitor`: watches running machines by their corrected twin, and raises alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.arrays import held
from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.monitor.detect.detector import Detector
from retwin.monitor.detect.disturbance import Disturbance, DisturbanceState
from retwin.monitor.detect.events import CHANGED, FOLLOWS, Course, Rules
from retwin.monitor.detect.noise import DECAYS, Noise, features, own_scale
from retwin.monitor.detect.predictors import (
    Predictor,
    by_stream,
    finite_state,
    implausible,
    span_of,
    standardised,
)
from retwin.monitor.detect.promise import Promise, Tried
from retwin.monitor.detect.scores import ConformalScores, middle
from retwin.monitor.detect.slack import Slack
from retwin.monitor.detect.validity import Validity
from retwin.monitor.models.free_simulation import free_errors
from retwin.monitor.models.saved import DISTURBANCE, read_fields, write_fields
from retwin.monitor.models.state import Alarm, Ending, MonitorState, Part, Visible, Watched
from retwin.twins.twin import check_channels
from retwin.update.dynamics.filter.online import OnlineFilter
from retwin.update.dynamics.twin import BEYOND, DynamicsTwin
from retwin.update.forecast_errors import channel_excess

FAR = 0.25
"""Share of the width of its range by which an output that leaves it is named."""
FREE = 2.0
"""Times the largest error of free simulation in calibration from which on a larger one is named."""
SMALL = 1e-3
"""Share of the values of an output up to which its errors are none: of twins that are exact."""
SIZE = 256
"""Samples that are predicted at once: those after an alarm are predicted again. While an event
lasts, where alarms are frequent, an eighth of them."""


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
    noise : Noise
        What the errors of the disturbance's predictions depend on.
    tried : Tried
        What happened on the records of the calibration, each left out in turn.
    lasting : float
        Time in s after which an event that has not ended is a change.
    alpha : float
        Probability of declaring a promise void that applies.
    predictors : tuple of Predictor
        The M predictive models.
    visible : tuple of Visible
        What is seen of faults, of `visible_sizes`; empty where that was not tried.
    free : tuple of float
        By output, the largest error of free simulation in calibration, see `free_errors`; empty
        where it diverges.

    """

    twin: DynamicsTwin
    disturbance: Disturbance
    scores: ConformalScores
    slack: tuple[Slack, ...]
    resolution: NDArray
    arl: float
    noise: Noise
    tried: Tried
    lasting: float = 3600.0
    alpha: float = 0.01
    predictors: tuple[Predictor, ...] = (Predictor(),)
    visible: tuple[Visible, ...] = ()
    free: tuple[float, ...] = ()

    @property
    def warm_up(self) -> float:
        """Time in s after the first sample in which no evidence is counted: states are unknown."""
        return min(each.warm_up for each in self.predictors)

    @property
    def promises(self) -> dict[str, Promise]:
        """What is promised of each output."""
        names, about = self.twin.outputs.names, (self.run_length, self.twin.rate)
        classes = {name: self.slack[i :: len(names)] for i, name in enumerate(names)}
        return {name: Promise(*about, own[0], self.alpha, own[1:]) for name, own in classes.items()}

    @property
    def run_length(self) -> float:
        """The average run length that is promised: the one that is wanted, if it held there."""
        return self.arl if self.tried.kept(self.arl) else min(self.arl, self.tried.run_length)

    def start(self, count: int) -> MonitorState:
        """What is known of so many machines before their first sample."""
        disturbance, validity = self._streams(count)
        return MonitorState(
            tuple(each.start(count) for each in self._filters),
            disturbance.start(),
            validity.detector.start(count * len(self.slack)),
            validity.start(count * len(self.slack)),
            Course.start(count),
            np.zeros((count, len(DECAYS), len(self.twin.inputs))),
            np.zeros((count * len(self.slack), 2)),
            np.zeros(count, dtype=bool),
            np.zeros((count, len(self.twin.outputs)), dtype=np.int64),
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
            and count == len(state.void)
            and samples > 0,
            "measured",
            expected=f"one or more samples of {len(state.void)} machines with "
            f"{len(self.twin.inputs)} commands and {len(self.twin.outputs)} outputs",
            got=f"shapes {commands.shape} and {measured.shape}",
            remedy="give arrays (machines, samples, channels)",
        )
        known = self._held(state, commands)
        names = list(np.asarray(ids, dtype=str)) or [""] * count
        alarms, endings, parts, first = list[Alarm](), list[Ending](), [], 0
        while first < samples:
            calm = (state.course.event < 0).all()
            size = min(SIZE if calm else SIZE // 8, samples - first)
            own = [each[:, first : first + size] for each in (known, measured)]
            part = self._part(state, *own)
            if (until := part.until) < size:  # the machine begins anew after the first alarm
                part = self._part(state, *(each[:, :until] for each in own))
            state, shown = self._after(state, part, names, alarms, endings)
            parts.append(shown)
            first += part.until
        shown = tuple(np.concatenate(each, axis=1) for each in zip(*parts, strict=True))
        mean, deviation, score, evidence, alarm, event, void = shown
        far = implausible(self.twin, commands).any(axis=2)
        outside = np.asarray((self._outside(known) | far).any(axis=1))
        flags = alarm, event, void, outside
        return state, Watched(mean, deviation, score, evidence, *flags, alarms, endings)

    def watch(self, record: Trajectories) -> Watched:
        """Watch recorded trajectories, each as a machine of its own.

        Raises
        ------
        InputError
            Other channels or another rate than those of the twin.

        """
        check_channels(self.twin, record, "record")
        start = self.start(len(record))
        return self.step(start, record.commands, record.measured, record.ids)[1]

    @property
    def rules(self) -> Rules:
        """When events begin and end."""
        return Rules.of(self.arl, max(1, round(self.lasting * self.twin.rate)))

    def _part(self, state: MonitorState, commands: NDArray, measured: NDArray) -> Part:
        """What is found in samples (n, T, ...) if none of the machines begins anew in them."""
        count, samples = measured.shape[:2]
        seen, learn = np.isfinite(measured), state.course.event < 0
        models = zip(self._filters, state.filters, strict=True)
        found = [online.step(own, commands, measured, seen, learn) for online, own in models]
        filtered, means, covariances = zip(*found, strict=True)
        predicted = zip(means, covariances, strict=True)
        both = [standardised(measured - at, own, seen, self.resolution) for at, own in predicted]
        pairs = zip(*both, strict=True)
        error, width = (by_stream(np.concatenate(each, axis=2)) for each in pairs)
        model, validity = self._streams(count)
        disturbance, error, scale = model.run(state.disturbance, error)
        before, level = state.filters[0].commands[:, -1], np.nan_to_num(means[0])
        changes, noted = features(state.changes, before, commands, level, span_of(self.twin))
        shift, spread = (by_stream(each) for each in self.noise.run(noted))
        error, width = (error - shift) / spread, width / scale / spread
        calm = np.repeat(learn, len(self.slack))
        own, sums = own_scale(state.scale, error, np.tile(self.noise.degrees, count))
        sums = np.where(calm[:, None], sums, state.scale)
        own = np.where(calm[:, None], own, own[:, :1])
        error, width = error / own, width / own
        by_machine = (each.reshape(count, len(self.slack), -1) for each in (error, width))
        scored = self.scores.score(*(np.swapaxes(each, 0, 1) for each in by_machine))
        low, high = (by_stream(np.moveaxis(each, 0, 2)) for each in scored)
        since, rate = state.course.samples - state.course.begun, self.twin.rate
        used = np.stack([each.used(since, samples, rate) for each in self.predictors], axis=1)
        used = np.repeat(used, len(self.twin.outputs), axis=1).reshape(low.shape)
        low, high = (np.where(used, each, np.nan) for each in (low, high))
        detector, evidence = validity.detector.run(state.detector, low, high)
        total = evidence.reshape(count, len(self.slack), -1).mean(axis=1)
        counted = np.isfinite(low).reshape(count, len(self.slack), -1).any(axis=1)
        rules = self.rules
        alarm = rules.alarms(total)
        end_evidence = np.ones(total.shape)
        if not learn.all():
            change = state.course.change + [[len(self.slack), 0]] * np.arange(count)[:, None]
            given = state.course.end_evidence, change, state.detector.previous
            end_evidence = np.where(
                learn[:, None], end_evidence, validity.detector.evidence_of_end(*given, low, high)
            )
        ended = rules.ends(state.course, total, end_evidence, counted) & ~alarm
        entered = self._find_entry(state.entered, measured)
        outside = self._outside(commands) | (entered == 1).any(axis=2)
        changed = rules.changes(state.course, samples) & ~ended
        stays_finite = np.all([np.isfinite(each).all(axis=(1, 2)) for each in means], axis=0)
        after = replace(
            state,
            filters=tuple(map(finite_state, self._filters, filtered)),
            disturbance=disturbance,
            detector=detector,
            changes=changes,
            scale=sums,
            void=state.void | ~stays_finite,
            entered=entered[:, -1],
        )
        deviation = np.sqrt(np.diagonal(covariances[0], axis1=2, axis2=3))
        flags = alarm, ended, changed, counted, outside
        return Part(after, means[0], deviation, low, high, evidence, total, end_evidence, *flags)

    def _after(
        self,
        state: MonitorState,
        part: Part,
        names: list[str],
        alarms: list[Alarm],
        endings: list[Ending],
    ) -> tuple[MonitorState, tuple[NDArray, ...]]:
        """The state after a part whose last sample may have alarms or ends of events."""
        each, course, after = len(self.slack), state.course, part.after
        alarm, ended, changed = (own[:, -1] for own in (part.alarm, part.ended, part.changed))
        opens = alarm & (course.event < 0)
        # Only outside of events, and in the range of the calibration, is something promised.
        calm = np.repeat((course.event < 0)[:, None] & ~part.outside, each, axis=0)
        low, high = (np.where(calm, own, np.nan) for own in (part.low, part.high))
        flags = np.zeros(low.shape, dtype=bool)
        flags[:, -1] = np.repeat(opens & ~part.outside[:, -1], each)
        test = self._streams(len(alarm))[1]
        validity, against = test.run(state.validity, flags, low, high)
        broken = against.reshape(len(alarm), each, -1).mean(axis=1) >= 1 / self.alpha
        void = np.logical_or.accumulate(broken, axis=1) | after.void[:, None]
        lasts = np.repeat((course.event >= 0)[:, None], void.shape[1], axis=1)
        lasts[opens, -1] = True
        rows = np.arange(len(alarm))
        most = part.evidence[:, -1].reshape(-1, each).argmax(axis=1)
        weighed = after.detector.evidence.reshape(len(alarm), each, -1)[rows, most]
        change = np.stack([most, (weighed * test.detector.bets.weights).argmax(axis=1)], axis=1)
        ends = part.counted, alarm, ended, changed, change, part.end_evidence[:, -1]
        course = self.rules.after(course, *ends)
        for machine in np.flatnonzero(alarm):
            stream, number = change[machine].tolist()
            sample = int(course.samples[machine]) - 1
            outputs = self.twin.outputs.names
            alarms.append(
                Alarm(
                    names[machine],
                    sample,
                    sample / self.twin.rate,
                    outputs[stream % len(outputs)],
                    test.detector.change(number),
                    float(part.total[machine, -1]),
                    sample if opens[machine] else int(state.course.event[machine]),
                    not (void[machine, -1] or part.outside[machine, -1]),
                    tuple(after.filters[0].centre[machine].tolist()),
                )
            )
        for machine in np.flatnonzero(ended | changed):
            how = FOLLOWS if ended[machine] else CHANGED
            event, sample = int(state.course.event[machine]), int(course.samples[machine]) - 1
            endings.append(Ending(names[machine], event, sample, how))
        after = replace(after, validity=validity, course=course, void=void[:, -1])
        count = len(self.twin.outputs)
        score = middle(part.low, part.high).reshape(len(alarm), each, -1)[:, :count]
        shown = part.mean, part.deviation, np.moveaxis(score, 1, 2), part.total, part.alarm
        return self._anew(after, alarm | changed, ended, changed), (*shown, lasts, void)

    def _anew(
        self, state: MonitorState, anew: NDArray, ended: NDArray, changed: NDArray
    ) -> MonitorState:
        """The state where filter and detector begin anew; after a change with another machine."""
        (model, validity), each = self._streams(len(anew)), len(self.slack)
        detector = validity.detector.reset(state.detector, np.repeat(anew | ended, each))
        if not anew.any():
            return replace(state, detector=detector)
        rows, first = np.flatnonzero(anew), model.start()
        filters = []
        for online, own in zip(self._filters, state.filters, strict=True):
            old, same = own.of(rows), np.flatnonzero(~changed[rows])
            new = replace(online.start(len(rows)), commands=old.commands, simulated=old.simulated)
            learned = replace(new, centre=old.centre, root=old.root).of(same)
            filters.append(own.merged(rows, new.merged(same, learned)))
        where = np.repeat(anew, each)
        scale = np.where(np.repeat(changed, each)[:, None], 0.0, state.scale)
        disturbance = DisturbanceState(
            np.where(where[:, None], first.mean, state.disturbance.mean),
            np.where(where[:, None, None], first.covariance, state.disturbance.covariance),
        )
        return replace(
            state, filters=tuple(filters), disturbance=disturbance, detector=detector, scale=scale
        )

    def _held(self, state: MonitorState, commands: NDArray) -> NDArray:
        """Commands (n, T, d_u), where those that are missing or implausible are as before."""
        given = np.concatenate([state.filters[0].commands[:, -1:], commands], axis=1)
        known = held(np.where(implausible(self.twin, given), np.nan, given), 1)
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

    @property
    def _command_range(self) -> tuple[NDArray, NDArray]:
        """The range (d_u,) of the commands in both calibrations, and a little beyond."""
        low, high = (each[len(self.twin.process) :] for each in self.twin.bounds)
        least, largest = (each[: len(low)] for each in (self.noise.low, self.noise.high))
        margin = BEYOND * (largest - least)
        return np.minimum(low, least - margin), np.maximum(high, largest + margin)

    def _outside(self, commands: NDArray) -> NDArray:
        """Whether commands (n, T, d_u) leave their range in both calibrations, (n, T)."""
        low, high = self._command_range
        return np.asarray(((commands < low) | (commands > high)).any(axis=2))

    @property
    def _output_range(self) -> tuple[NDArray, NDArray]:
        """The range (d_y,) of the outputs in both calibrations."""
        count = len(self.twin.outputs)
        low, high = self.noise.low[-count:], self.noise.high[-count:]
        if self.twin.forecast is not None:
            low = np.minimum(low, self.twin.forecast.low[-count:])
            high = np.maximum(high, self.twin.forecast.high[-count:])
        return low, high

    def _find_entry(self, before: NDArray, measured: NDArray) -> NDArray:
        """Whether outputs (n, T, d_y) have been in their range; see `MonitorState.entered`."""
        far = channel_excess(measured, *self._output_range) > FAR
        now = np.where(np.isnan(measured), 0, np.where(far, 1, 2))
        return np.maximum.accumulate(np.maximum(now, before[:, None]), axis=1)

    def find_begin(self, record: Trajectories) -> float:
        """Time in s before which an output has only been outside of its range in calibration.

        A machine that begins so, such as a cold one, is in states of which nothing is promised.
        """
        nothing = np.zeros((len(record), len(self.twin.outputs)), dtype=np.int64)
        outside = (self._find_entry(nothing, record.measured) == 1).any(axis=(0, 2))
        return float(outside.sum()) / record.rate

    def find_excursions(self, record: Trajectories) -> dict[str, tuple[float, float, float, float]]:
        """Outputs that leave their range in both calibrations by a quarter of its width.

        The filter follows what changes slowly, so that errors of one step do not show it.

        Returns
        -------
        dict of str to tuple of float
            By output, the time in s at which one does first, the furthest value, and the range.

        """
        return _excursions(record.outputs.names, record.measured, self._output_range, FAR, record)

    def find_commands_outside(
        self, record: Trajectories
    ) -> dict[str, tuple[float, float, float, float]]:
        """Commands that leave their range in both calibrations, as in `find_excursions`."""
        return _excursions(record.inputs.names, record.commands, self._command_range, 0.0, record)

    def find_free_errors(self, record: Trajectories) -> dict[str, tuple[float, float, float]]:
        """Outputs that free simulation predicts much worse than in the calibration.

        A fault that begins slowly, or has a small effect on each sample, is followed by the filter,
        so that errors of one step do not show it. Another day may do the same: it is no alarm.

        Returns
        -------
        dict of str to tuple of float
            By output, the time in s from which on it is so, the largest error as a root mean square
            of a part of the record, and that of the calibration.

        """
        found = free_errors(self.twin, record) if self.free else None
        if found is None:
            return {}
        size, length = found[0].max(axis=0), found[1]
        low, high = self._output_range
        hardly = SMALL * np.maximum(high - low, np.maximum(np.abs(low), np.abs(high)))
        made = {}
        names = self.twin.outputs.names
        for own, usual, least, name in zip(size.T, self.free, hardly, names, strict=True):
            beyond = own > FREE * max(usual, least)
            if beyond.any():
                first = float(beyond.argmax()) * length / record.rate
                made[name] = (first, float(own.max()), usual)
        return made

    @cached_property
    def _filters(self) -> tuple[OnlineFilter, ...]:
        return tuple(each.filter(self.twin) for each in self.predictors)

    @cached_property
    def _by_count(self) -> dict[int, tuple[Disturbance, Validity]]:
        """See `_streams`, for each number of machines that was used: tables take long to make."""
        return {}

    def _streams(self, count: int) -> tuple[Disturbance, Validity]:
        """The models for the outputs of so many machines, those of the first one first."""
        if count not in self._by_count:
            known = {name: getattr(self.disturbance, name) for name in DISTURBANCE}
            repeated = {name: np.concatenate([each] * count) for name, each in known.items()}
            validity = Validity(Detector(self.slack * count), self.run_length, self.alpha)
            self._by_count[count] = replace(self.disturbance, **repeated), validity
        return self._by_count[count]

    def save(self, folder: str | Path) -> None:
        """Write the twin, the calibration and the promise."""
        write_fields(folder, vars(self))

    @classmethod
    def load(cls, folder: str | Path) -> Monitor:
        """Read what `save` wrote. Raises InputError if it is no monitor or is damaged."""
        return cls(**read_fields(folder))


def _excursions(
    names: Sequence[str],
    values: NDArray,
    ends: tuple[NDArray, NDArray],
    far: float,
    record: Trajectories,
) -> dict[str, tuple[float, float, float, float]]:
    """Channels of values (n, T, d) that leave a range by more than a share of its width."""
    low, high = ends
    excess, found = channel_excess(values, low, high), {}
    for i, name in enumerate(names):
        row, furthest = np.unravel_index(np.argmax(excess[..., i]), excess.shape[:2])
        if excess[row, furthest, i] > far:
            first = float(np.argmax(excess[row, :, i] > far)) / record.rate
            found[name] = (first, float(values[row, furthest, i]), float(low[i]), float(high[i]))
    return found
