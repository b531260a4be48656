"""Causes of alarms: which fault of the system explains what was measured before one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from retwin.checks import require, whole
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.diagnosis.estimate import Estimate
from retwin.diagnosis.inversion.fault_evidence import FaultEvidence
from retwin.diagnosis.inversion.states import StateInversionDiagnoser
from retwin.monitor.models.state import Alarm
from retwin.progress import Progress, tracked
from retwin.twins.faults.actuator_faults import Fault, ends_of
from retwin.twins.faults.system_faults import (
    ActuatorGain,
    ParameterDrift,
    ParameterFault,
    ParameterShift,
    SensorBias,
    SensorDrift,
    SensorError,
    SensorFreeze,
    SensorGain,
    SizedFault,
    TimedFault,
)
from retwin.update.dynamics.filter.online import moved
from retwin.update.dynamics.twin import DynamicsTwin

PROBABLE = 0.5
"""Probability from which on it is said that there is more than a cause, or which one is second."""
BEFORE = 100
"""Samples before an alarm from which its cause is inferred."""
MIN_WINDOW = 10
"""A cause is inferred from more samples than this."""
OFFSET = 3.0
"""Largest offset of a sensor, in ranges of its output in calibration: a level that leaves its range
would else be taken for a frozen sensor."""
EVENT = 500
"""Samples of an event that are looked at, at most, to tell whether a second fault began in it."""
GROWTH = 0.25
"""Share of its age by which an event is older when its cause is inferred again."""

AT_LIMIT = 0.02
"""Share of the range of a fault's size within which its interval is at an end of it."""


@dataclass(frozen=True)
class Cause:
    """What explains an alarm best.

    Attributes
    ----------
    alarm : Alarm
        The alarm.
    name : str
        The most probable class.
    probability : float
        Its probability, if one of the classes is the true one.
    unknown : float
        Probability that there is something besides: none of the classes, or one that does more than
        its equation.
    size, onset : tuple of float
        Value, and ends of the 90 % interval; the onset is in s from the first sample of the record.
        NaN where the class has none.
    probabilities : dict of str to float
        Of all classes.
    same : bool
        Whether its event has a cause already, which explains this alarm too; else it is the first
        one of the event, or a further one.
    unit : str
        Of the size; "" where it has none.
    limit : bool
        Whether the size is at an end of the range in which it was searched.
    earlier : bool
        Whether the onset may be before the samples by which the cause was inferred.

    """

    alarm: Alarm
    name: str
    probability: float
    unknown: float
    size: tuple[float, float, float]
    onset: tuple[float, float, float]
    probabilities: dict[str, float]
    same: bool = False
    unit: str = ""
    limit: bool = False
    earlier: bool = False

    @property
    def likely(self) -> bool:
        """Whether its class, and nothing besides, is more probable than all else."""
        return self.probability * (1 - self.unknown) > PROBABLE


def cause_text(cause: Mapping[str, Any], since: str, *, rival: float = 0.2) -> str:
    """A cause with its onset, size and probability, and whether there is more to it.

    Of a `Cause` as a mapping, or of `cause_data`; `since` is its onset, "" where that is not known.
    Others whose probability is at least `rival` are named: outputs may not tell them apart.
    """
    known = cause["name"] != HEALTHY  # else it explains the alarm best, which has no known cause
    more = cause["unknown"] > PROBABLE and known
    doubt = "not clear, most likely " * (known and cause["probability"] < PROBABLE)
    name = doubt + cause["name"] if known else "no known fault"
    since += " or earlier" * bool(since and cause.get("earlier"))
    text = name + (f" from {since}" if since else "")
    text += ", and more than that" if since and more else ""
    value, low, high = cause["size"]
    of = f" {cause['unit']}" if cause["unit"] not in ("", "1") else ""
    end = " at the end of its range, so that it may be something else" if cause["limit"] else ""
    sized = value is not None and np.isfinite(value)
    size = f"size {value:.3g}{of} ({low:.3g} to {high:.3g}){end}, " if sized else ""
    among = " among the known causes" if more else ""
    rivals = [
        f", or {other} ({share:.2f})"
        for other, share in cause["probabilities"].items()
        if share >= rival and other not in (cause["name"], HEALTHY)
    ]
    return f"{text}; {size}probability {cause['probability']:.2f}{among}{''.join(rivals)}"


def size_unit(fault: Fault | None, twin: DynamicsTwin) -> str:
    """The unit of a fault's size; "" where it has none."""
    if isinstance(fault, ParameterFault):
        parameters = twin.equations.parameters
        own = [each.unit for each in parameters if each.name == fault.parameter]
        return f"{own[0]}{' per second' * fault.grows}" if own else ""
    if isinstance(fault, ActuatorGain):
        return "of the command"
    if isinstance(fault, SensorGain):
        return "of the true value"
    if isinstance(fault, SensorError):
        return f"{twin.outputs.units[fault.output]}{'/s' * fault.grows}"
    return ""


def cause_data(
    name: str,
    probability: float,
    unknown: float,
    probabilities: Mapping[str, float],
    size: Sequence[float | None] = (None,) * 3,
    unit: str = "",
    onset: Sequence[float | None] = (None,) * 3,
) -> dict[str, Any]:
    """A cause as data of the log, None where there is no number; see `Cause`.

    The onset is in nanoseconds.
    """
    return {
        "name": name,
        "probability": probability,
        "unknown": unknown,
        "size": list(size),
        "unit": unit,
        "limit": False,
        "earlier": False,
        "onset": list(onset),
        "probabilities": dict(probabilities),
    }


def possible_causes(
    twin: DynamicsTwin, faults: Mapping[str, Fault | None] | None = None
) -> dict[str, TimedFault | None]:
    """What may cause an alarm: the faults that are known, or else any change of the system.

    Without known faults these are a shift and a drift of each parameter of the twin within its
    bounds, another gain of each command, and an offset, another gain, a drift and a freeze of each
    sensor, by up to the range that the output has in calibration, or three of these for an offset.
    A gain is as many times too low as the largest offset makes the usual level too high, or up to
    twice as much too high: so its range is no narrower than that of the offset, and the offset is
    somewhat more probable where both are the same, since the output hardly varies.

    Parameters
    ----------
    twin : DynamicsTwin
        The twin of the monitor.
    faults : mapping of str to Fault or None, optional
        Known faults, such as `Case.alarm_causes`; those that cannot be inverted are left out, and
        all where the twin has none of their parameters: it is a black box.

    Returns
    -------
    dict of str to TimedFault or None
        Classes, with the healthy one; see `find_causes`.

    """
    known = {name: each for name, each in (faults or {}).items() if isinstance(each, TimedFault)}
    used = {each.parameter for each in known.values() if isinstance(each, ParameterFault)}
    if used and not used & {each.name for each in twin.equations.parameters}:
        known = {}
    return {HEALTHY: None, **(known or _any_change(twin))}


def _any_change(twin: DynamicsTwin) -> dict[str, TimedFault]:
    """Any change of parameters, commands and sensors that the twin can simulate."""
    made: dict[str, TimedFault] = {}
    names = twin.equations.names
    present = dict(zip(names, twin.values.tolist(), strict=True))
    fixed = {names[place] for _, place in twin.equations.delay_places}  # dead times do not change
    for each in twin.equations.parameters:
        # Those of the discrepancy have names of several words.
        if each.name.isidentifier() and each.name not in fixed:
            value = min(max(present[each.name], each.low), each.high)
            size = (each.low - value, each.high - value)
            made[f"{each.name} changed"] = ParameterShift(parameter=each.name, size=size)
            slow = (size[0] * twin.rate / BEFORE, size[1] * twin.rate / BEFORE)
            made[f"{each.name} drifting"] = ParameterDrift(parameter=each.name, size=slow)
    states = len(twin.process)
    moved = twin.domain.high[states:] > twin.domain.low[states:]
    for i in np.flatnonzero(moved).tolist():
        name = f"{twin.inputs.names[i]}: another effect"
        made[name] = ActuatorGain(actuator=i, size=(-1.0, 1.0))
    for i, (level, range_) in enumerate(zip(*output_levels(twin), strict=True)):
        name, rate, offset = twin.outputs.names[i], range_ * twin.rate / BEFORE, OFFSET * range_
        gain = offset / level
        made[f"{name}: sensor offset"] = SensorBias(output=i, size=(-offset, offset))
        made[f"{name}: sensor gain"] = SensorGain(output=i, size=(-gain / (1 + gain), 2 * gain))
        made[f"{name}: sensor drift"] = SensorDrift(output=i, size=(-rate, rate))
        made[f"{name}: sensor frozen"] = SensorFreeze(output=i)
    return made


def output_levels(twin: DynamicsTwin) -> tuple[list[float], list[float]]:
    """Root mean squares, and widths of uniform distributions, of outputs as in calibration."""
    commands = twin.domain.mean[None, None, len(twin.process) :]
    unseen = np.zeros((1, 1, len(twin.noise)))
    mean, spread, _ = twin.filter(commands, unseen, unseen.astype(bool), known_start=False)
    variances = np.diagonal(spread[0, 0])
    return np.hypot(mean[0, 0], np.sqrt(variances)).tolist(), np.sqrt(12 * variances).tolist()


def find_causes(
    twin: DynamicsTwin,
    record: Trajectories,
    alarms: Sequence[Alarm],
    faults: Mapping[str, Fault | None],
    before: int = BEFORE,
    *,
    known_start: bool = True,
    progress: Progress | None = None,
) -> list[Cause]:
    """The causes of alarms, from the samples before each up to it.

    The cause of an event is inferred at its first alarm, and again each time that the event is a
    quarter older (`is_due`). Other alarms of it have the cause that was inferred last.

    Parameters
    ----------
    twin : DynamicsTwin
        The twin of the monitor.
    record : Trajectories
        What was watched.
    alarms : sequence of Alarm
        Alarms of `Monitor.watch`.
    faults : mapping of str to Fault or None
        Classes, None for the healthy one. Their sizes count; a fault may begin at any sample before
        the alarm and lasts until it.
    before : int
        Number of samples before the first alarm of an event from which its cause is inferred. They
        begin after the last alarm of the event before it, if that is later.
    known_start : bool
        Whether the record starts as those in calibration do; a stream may start anywhere.
    progress : callable, optional
        Called with the share of the alarms that is done.

    Raises
    ------
    InputError
        Faults that cannot be inverted (`fit_inversion`), or an alarm of another record.

    """
    whole("before", before, at_least=MIN_WINDOW)
    ids, found = record.ids.tolist(), list[Cause]()
    newest, inferred = dict[str, Alarm](), dict[tuple[str, int], list[Alarm]]()
    current, latest = dict[tuple[str, int], tuple[str, float]](), dict[tuple[str, int], Cause]()
    for alarm in tracked(alarms, len(alarms), progress):
        require(
            alarm.trajectory in ids and alarm.sample < record.steps,
            "alarms",
            expected="alarms of this record",
            got=f"one of {alarm.trajectory!r} at sample {alarm.sample}",
            remedy="give the record that was watched",
        )
        event = alarm.trajectory, alarm.event
        earlier = [newest[alarm.trajectory]] if alarm.trajectory in newest else []
        known = inferred.setdefault(event, earlier)
        newest[alarm.trajectory] = alarm
        if is_due([each.sample for each in known if each.event == alarm.event], alarm.sample):
            known.append(alarm)
            own, has = record[[ids.index(alarm.trajectory)]], current.get(event, ("", 0.0))
            cause = CauseSearch(twin, own, faults, before, known_start).find(known, has)
            latest[event] = cause
            if not cause.same or cause.name == has[0]:
                current[event] = cause.name, cause.unknown
            found.append(cause)
        else:
            found.append(replace(latest[event], alarm=alarm, same=True))
    return found


def is_due(inferred: Sequence[int], sample: int) -> bool:
    """Whether the cause of an event is inferred at an alarm.

    The evidence for a cause grows with the samples since the event began, so that it can turn only
    when these have become more by some share of them.

    Parameters
    ----------
    inferred : sequence of int
        Samples of the alarms of the event at which it was inferred; the first one is its first.
    sample : int
        That of the alarm.

    """
    if not inferred:
        return True
    return sample - inferred[-1] > max(MIN_WINDOW, GROWTH * (inferred[-1] - inferred[0]))


@dataclass(frozen=True, eq=False)
class CauseSearch:
    """A search for the causes of alarms in a record of one trajectory.

    Its attributes are the parameters of `find_causes`.
    """

    twin: DynamicsTwin
    record: Trajectories
    faults: Mapping[str, Fault | None]
    before: int = BEFORE
    known_start: bool = True

    def find(self, alarms: Sequence[Alarm], current: tuple[str, float] = ("", 0.0)) -> Cause:
        """The cause of the last of the trajectory's alarms.

        A further alarm of an event is of the `same` fault unless another class is probable, for all
        of the event or else for what came last, and explains it better: in place of the first
        fault, or after it. That one alone may last or have ended.

        Parameters
        ----------
        alarms : sequence of Alarm
            The newest one before the event, if any, and those of the event at which its cause is
            inferred.
        current : tuple of str and float
            The cause that the event has, "" for none, and the probability that there was something
            besides. It is also that of a cause which explains the newest samples alone: in few of
            them each cause seems to.

        """
        alarm, own = alarms[-1], [each for each in alarms if each.event == alarms[-1].event]
        opening, before = own[0].sample, self.before
        start = max(0, opening - before)
        if len(own) < len(alarms):
            start = max(start, min(alarms[0].sample + 1, opening - MIN_WINDOW))
        if len(own) == 1:
            return self._infer(start, alarm)
        whole = self._infer(start, alarm) if alarm.sample - opening <= before else None
        begin = max(0, own[-2].sample + 1, alarm.sample - before)
        cause = whole if whole is not None and whole.likely else self._infer(begin, alarm)
        same = cause.name in (current[0], HEALTHY) or not cause.likely
        known = self.faults.get(current[0])
        if not same and isinstance(known, TimedFault):
            both = known, self.faults[cause.name]
            window = max(start, alarm.sample - EVENT), begin, alarm
            same = not self._better(window, both, np.log(alarm.evidence), whole is not None)
        if whole is not None and same:
            cause = whole
        elif cause is not whole:
            cause = replace(cause, unknown=max(cause.unknown, current[1]))
        return replace(cause, same=same)

    def _infer(self, first: int, alarm: Alarm) -> Cause:
        """The cause of an alarm from the samples since the first one."""
        rate = self.record.rate
        begin, latest = first / rate, (alarm.sample - first) / rate
        lasting = {name: _lasting(fault, latest) for name, fault in self.faults.items()}
        diagnoser = StateInversionDiagnoser(moved(self.twin, alarm.machine), lasting)
        window, known_start = self._window(first, alarm.sample), self.known_start and first == 0
        made = diagnoser.diagnose(window, known_start=known_start)
        best = int(made.probabilities[0].argmax())

        def interval(estimate: Estimate, shift: float = 0.0) -> tuple[float, float, float]:
            parts = (getattr(estimate, part)[0, best] for part in ("value", "low", "high"))
            value, low, high = (shift + float(each) for each in parts)
            return value, low, high

        name, size, onset = made.classes[best], interval(made.size), interval(made.onset, begin)
        return Cause(
            alarm,
            name,
            float(made.probabilities[0, best]),
            float(made.unknown[0]),
            size,
            onset,
            dict(zip(made.classes, made.probabilities[0].tolist(), strict=True)),
            unit=size_unit(self.faults[name], self.twin),
            limit=_at_limit(self.faults[name], size),
            earlier=not known_start and onset[1] <= begin + 1 / rate,
        )

    def _better(
        self,
        window: tuple[int, int, Alarm],
        faults: tuple[TimedFault, Fault | None],
        penalty: float,
        whole: bool,
    ) -> bool:
        """Whether another fault explains an event better than its cause alone.

        Compared is the evidence in the same samples. The cause lasts or has ended, where it had its
        most probable size and onset. The other fault is a second one in the samples before the
        alarm, or is there in place of the cause. Where the second one begins the states may be
        unknown again, and if there is none also the size of the first one.

        Parameters
        ----------
        window : tuple of int, int and Alarm
            The first sample that counts, the first of those with a second fault, and the alarm.
        faults : tuple of TimedFault and Fault
            The cause and the other one.
        penalty : float
            By which the evidence for two faults must be larger: as for an alarm.
        whole : bool
            Whether these are all samples of the event: only then the cause may be another one.

        """
        (first, begin, alarm), last, rate = window, window[2].sample, self.record.rate
        if begin - first < MIN_WINDOW:
            return whole
        healthy = moved(self.twin, alarm.machine)

        def evidence(begin: int, end: int, fault: Fault | None) -> tuple[float, NDArray]:
            model = FaultEvidence.of(healthy, self._window(begin, end), known_start=False)
            known = fault if isinstance(fault, TimedFault) else None
            found = model.integral(known)
            return model.tolerated(known, found).evidence, found.best

        def lasts(begin: int, end: int, fault: Fault | None) -> Fault | None:
            return _lasting(fault, (end - begin) / rate)

        one, other = faults
        until, (size, onset, _) = evidence(first, begin - 1, lasts(first, begin - 1, one))
        onset, after = onset / rate, (last + 1 - first) / rate
        point = replace(one, onset=onset, end=None)
        if isinstance(point, SizedFault):
            point = replace(point, size=float(size))
        end = replace(point, end=(onset + 1 / rate, after))
        alone = (
            evidence(first, last, lasts(first, last, one))[0],
            until + evidence(first, last, end)[0] - evidence(first, begin - 1, point)[0],
            until + evidence(begin, last, replace(one, onset=0.0, end=None))[0],
        )
        more = [until + evidence(begin, last, lasts(begin, last, other))[0] - penalty]
        if whole:
            more.append(evidence(first, last, lasts(first, last, other))[0])
        return bool(logsumexp(more) > logsumexp(alone))

    def _window(self, first: int, last: int) -> Trajectories:
        return self.record.between(first / self.record.rate, (last + 1) / self.record.rate)


def _at_limit(fault: Fault | None, size: tuple[float, float, float]) -> bool:
    """Whether the interval of a size reaches an end of the range of the fault, other than 0."""
    if not isinstance(fault, SizedFault):
        return False
    ends = np.array(ends_of(fault.size))
    margin = AT_LIMIT * np.ptp(ends)
    reached = np.abs(np.array(size)[1:] - ends) <= margin
    return bool((reached & (np.abs(ends) > margin)).any())


def _lasting(fault: Fault | None, latest: float) -> Fault | None:
    """A fault that begins at any time until `latest` in s, and lasts."""
    return replace(fault, onset=(0.0, latest), end=None) if isinstance(fault, TimedFault) else fault
