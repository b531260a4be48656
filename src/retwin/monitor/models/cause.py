"""Causes of alarms: which fault of the system explains what was measured before one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require, whole
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.diagnosis.estimate import Estimate
from retwin.diagnosis.inversion.fault_evidence import FaultEvidence
from retwin.diagnosis.inversion.states import StateInversionDiagnoser
from retwin.monitor.models.watched import Alarm
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import (
    ActuatorGain,
    ParameterDrift,
    ParameterFault,
    ParameterShift,
    SensorBias,
    SensorDrift,
    SensorFreeze,
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
"""A window begins after the newest earlier alarm that leaves it more samples than this."""
OFFSET = 3.0
"""Largest offset of a sensor, in ranges of its output in calibration: a level that leaves its range
would else be taken for a frozen sensor."""
EVENT = 500
"""Samples of an event that are looked at, at most, to tell whether a second fault began in it."""

PARTS = ("value", "low", "high")
"""Of an estimate."""


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

    """

    alarm: Alarm
    name: str
    probability: float
    unknown: float
    size: tuple[float, float, float]
    onset: tuple[float, float, float]
    probabilities: dict[str, float]
    same: bool = False


def cause_title(name: str) -> str:
    """A cause as it is shown: an alarm that the healthy class explains best has no known cause."""
    return "no known fault" if name == HEALTHY else name


def cause_text(name: str, since: str, unknown: float) -> str:
    """A cause with its onset, "" where that is not known, and whether there is more to it."""
    more = ", and more than that" if since and unknown > PROBABLE else ""
    return f"{cause_title(name)}{f' from {since}' if since else ''}{more}"


def cause_data(
    name: str,
    probability: float,
    unknown: float,
    probabilities: Mapping[str, float],
    size: Sequence[float | None] = (None,) * 3,
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
        "onset": list(onset),
        "probabilities": dict(probabilities),
    }


def possible_causes(
    twin: DynamicsTwin, faults: Mapping[str, Fault | None] | None = None
) -> dict[str, TimedFault | None]:
    """What may cause an alarm: the faults that are known, or else any change of the system.

    Without known faults these are a shift and a drift of each parameter of the twin within its
    bounds, another gain of each command, and an offset, a drift and a freeze of each sensor, by up
    to the range that the output has in calibration, or three of these for an offset.

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
    present = dict(zip(twin.equations.names, twin.values.tolist(), strict=True))
    for each in twin.equations.parameters:
        if each.name.isidentifier():  # those of the discrepancy have names of several words
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
    commands, unseen = twin.domain.mean[None, None, states:], np.zeros((1, 1, len(twin.noise)))
    spread = twin.filter(commands, unseen, unseen.astype(bool), known_start=False)[1][0, 0]
    for i, range_ in enumerate(np.sqrt(12 * np.diagonal(spread)).tolist()):
        name, rate = twin.outputs.names[i], range_ * twin.rate / BEFORE
        made[f"{name}: sensor offset"] = SensorBias(
            output=i, size=(-OFFSET * range_, OFFSET * range_)
        )
        made[f"{name}: sensor drift"] = SensorDrift(output=i, size=(-rate, rate))
        made[f"{name}: sensor frozen"] = SensorFreeze(output=i)
    return made


def find_causes(
    twin: DynamicsTwin,
    record: Trajectories,
    alarms: Sequence[Alarm],
    faults: Mapping[str, Fault | None],
    before: int = BEFORE,
    *,
    known_start: bool = True,
) -> list[Cause]:
    """The causes of alarms, from the samples before each up to it.

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
        Number of samples before an alarm from which its cause is inferred. They begin after the
        newest alarm before it that leaves more than ten samples, if that is later.
    known_start : bool
        Whether the record starts as those in calibration do; a stream may start anywhere.

    Raises
    ------
    InputError
        Faults that cannot be inverted (`fit_inversion`), or an alarm of another record.

    """
    whole("before", before, at_least=MIN_WINDOW)
    ids, found, known = record.ids.tolist(), [], dict[str, list[Alarm]]()
    current = dict[tuple[str, int], str]()
    for alarm in alarms:
        require(
            alarm.trajectory in ids and alarm.sample < record.steps,
            "alarms",
            expected="alarms of this record",
            got=f"one of {alarm.trajectory!r} at sample {alarm.sample}",
            remedy="give the record that was watched",
        )
        event = alarm.trajectory, alarm.event
        until = known.setdefault(alarm.trajectory, [])
        until.append(alarm)
        cause = find_cause(
            twin,
            record[[ids.index(alarm.trajectory)]],
            until,
            faults,
            before,
            current=current.get(event, ""),
            known_start=known_start,
        )
        if not cause.same:
            current[event] = cause.name
        found.append(cause)
    return found


def find_cause(
    twin: DynamicsTwin,
    record: Trajectories,
    alarms: Sequence[Alarm],
    faults: Mapping[str, Fault | None],
    before: int = BEFORE,
    *,
    current: str = "",
    known_start: bool = True,
) -> Cause:
    """The cause of the last of a trajectory's alarms, see `find_causes`.

    A further alarm of an event is of the `same` fault, and of no second one, unless another class
    is probable for what came after an earlier alarm of the event, and both faults together have
    more evidence than the first one alone, which lasts or has ended.

    Parameters
    ----------
    current : str
        The cause that the event has; "" for none.

    """
    alarm = alarms[-1]
    earlier = [each for each in alarms[:-1] if alarm.sample - each.sample > MIN_WINDOW]
    last = earlier[-1].sample if earlier else -1
    first = max(0, alarm.sample - before, last + 1)
    begin, window = first / record.rate, _window(record, first, alarm.sample)
    latest = (alarm.sample - first) / record.rate
    lasting = {name: _lasting(fault, latest) for name, fault in faults.items()}
    made = StateInversionDiagnoser(moved(twin, alarm.machine), lasting).diagnose(
        window, known_start=known_start and first == 0
    )
    best = int(made.probabilities[0].argmax())

    def interval(estimate: Estimate) -> tuple[float, float, float]:
        value, low, high = (getattr(estimate, part)[0, best] for part in PARTS)
        return float(value), float(low), float(high)

    onset = interval(made.onset)
    cause = Cause(
        alarm,
        made.classes[best],
        float(made.probabilities[0, best]),
        float(made.unknown[0]),
        interval(made.size),
        (begin + onset[0], begin + onset[1], begin + onset[2]),
        dict(zip(made.classes, made.probabilities[0].tolist(), strict=True)),
    )
    if alarm.event not in [each.event for each in alarms[:-1]]:
        return cause
    likely = cause.probability * (1 - cause.unknown) > PROBABLE
    same = cause.name in (current, HEALTHY) or not likely
    known, own = faults.get(current), [each for each in earlier if each.event == alarm.event]
    if not same and isinstance(known, TimedFault):
        both = known, faults[cause.name]
        # Without an earlier alarm that leaves a window, the first fault's onset is in this one.
        same = not own or not _second(twin, record, [*own, alarm], both, np.log(len(faults)))
    return replace(cause, same=same)


def _second(
    twin: DynamicsTwin,
    record: Trajectories,
    alarms: Sequence[Alarm],
    faults: tuple[TimedFault, Fault | None],
    penalty: float,
) -> bool:
    """Whether a second fault began after the last alarm but one of an event.

    Compared is the evidence in the same samples. After that alarm the states are unknown again if
    there is a second fault; the first one, if it has ended, had its most probable size and onset.
    """
    opening, previous, last = alarms[0], alarms[-2].sample, alarms[-1].sample
    first = max(0, opening.sample - BEFORE, last - EVENT)
    if previous - first < MIN_WINDOW:
        return True
    healthy = moved(twin, opening.machine)

    def evidence(
        begin: int, end: int, fault: Fault | None, of: DynamicsTwin = healthy
    ) -> tuple[float, NDArray]:
        model = FaultEvidence.of(of, _window(record, begin, end), known_start=False)
        known = fault if isinstance(fault, TimedFault) else None
        found = model.integral(known)
        return model.tolerated(known, found).evidence, found.best

    def lasts(begin: int, end: int, fault: Fault | None) -> Fault | None:
        return _lasting(fault, (end - begin) / record.rate)

    one, other = faults
    until, (size, onset, _) = evidence(first, previous, lasts(first, previous, one))
    onset, after = onset / record.rate, (last + 1 - first) / record.rate
    point = replace(one, onset=onset, end=None)
    if isinstance(point, SizedFault):
        point = replace(point, size=float(size))
    end = replace(point, end=(onset + 1 / record.rate, after))
    ended = until + evidence(first, last, end)[0] - evidence(first, previous, point)[0]
    whole_event = evidence(first, last, lasts(first, last, one))[0]
    begun = lasts(previous + 1, last, other)
    again = evidence(previous + 1, last, begun, moved(twin, alarms[-1].machine))[0]
    return bool(until + again - penalty > np.logaddexp(whole_event, ended))


def _lasting(fault: Fault | None, latest: float) -> Fault | None:
    """A fault that begins at any time until `latest` in s, and lasts."""
    return replace(fault, onset=(0.0, latest), end=None) if isinstance(fault, TimedFault) else fault


def _window(record: Trajectories, first: int, last: int) -> Trajectories:
    return record.between(first / record.rate, (last + 1) / record.rate)
