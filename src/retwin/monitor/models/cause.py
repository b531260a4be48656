"""Causes of alarms: which fault of the system explains what was measured before one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from retwin.checks import require, whole
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.diagnosis.estimate import Estimate
from retwin.diagnosis.state_inversion import StateInversionDiagnoser
from retwin.monitor.models.watched import Alarm
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import (
    ActuatorGain,
    ParameterDrift,
    ParameterShift,
    SensorBias,
    SensorDrift,
    SensorFreeze,
    TimedFault,
)
from retwin.update.dynamics.online import moved
from retwin.update.dynamics.twin import DynamicsTwin

UNEXPLAINED = 0.5
"""Probability from which on it is told that a cause does not explain all."""
BEFORE = 100
"""Samples before an alarm from which its cause is inferred."""
MIN_WINDOW = 10
"""Samples of a window, at least; the one of an earlier alarm is left out where more remain."""

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

    """

    alarm: Alarm
    name: str
    probability: float
    unknown: float
    size: tuple[float, float, float]
    onset: tuple[float, float, float]
    probabilities: dict[str, float]


def cause_title(name: str) -> str:
    """A cause as it is shown: an alarm that the healthy class explains best has no known cause."""
    return "no known fault" if name == HEALTHY else name


def cause_text(name: str, since: str, unknown: float) -> str:
    """A cause with its onset, "" where that is not known, and whether there is more to it."""
    more = ", and more than that" if since and unknown > UNEXPLAINED else ""
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
    to the range that the output has in calibration.

    Parameters
    ----------
    twin : DynamicsTwin
        The twin of the monitor.
    faults : mapping of str to Fault or None, optional
        Known faults, such as `Case.alarm_causes`; those that cannot be inverted are left out.

    Returns
    -------
    dict of str to TimedFault or None
        Classes, with the healthy one; see `find_causes`.

    """
    known = {name: each for name, each in (faults or {}).items() if isinstance(each, TimedFault)}
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
        made[f"{name}: sensor offset"] = SensorBias(output=i, size=(-range_, range_))
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
        alarm before it, if that is later and leaves ten samples.
    known_start : bool
        Whether the record starts as those in calibration do; a stream may start anywhere.

    Raises
    ------
    InputError
        Faults that cannot be inverted (`fit_inversion`), or an alarm of another record.

    """
    whole("before", before, least=MIN_WINDOW)
    ids, found, last = record.ids.tolist(), [], dict[str, int]()
    for alarm in alarms:
        require(
            alarm.trajectory in ids and alarm.sample < record.steps,
            "alarms",
            expected="alarms of this record",
            got=f"one of {alarm.trajectory!r} at sample {alarm.sample}",
            remedy="give the record that was watched",
        )
        first = max(0, alarm.sample - before)
        if alarm.sample - last.get(alarm.trajectory, -1) > MIN_WINDOW:
            first = max(first, last.get(alarm.trajectory, -1) + 1)
        last[alarm.trajectory] = alarm.sample
        begin, end = first / record.rate, (alarm.sample + 1) / record.rate
        window = record[[ids.index(alarm.trajectory)]].between(begin, end)
        latest = (alarm.sample - first) / record.rate
        own = {
            name: replace(each, onset=(0.0, latest), end=None)
            if isinstance(each, TimedFault)
            else each
            for name, each in faults.items()
        }
        made = StateInversionDiagnoser(moved(twin, alarm.machine), own).diagnose(
            window, known_start=known_start and first == 0
        )
        best = int(made.probabilities[0].argmax())

        def interval(estimate: Estimate, best: int = best) -> tuple[float, float, float]:
            value, low, high = (getattr(estimate, part)[0, best] for part in PARTS)
            return float(value), float(low), float(high)

        onset = interval(made.onset)
        found.append(
            Cause(
                alarm,
                made.classes[best],
                float(made.probabilities[0, best]),
                float(made.unknown[0]),
                interval(made.size),
                (begin + onset[0], begin + onset[1], begin + onset[2]),
                dict(zip(made.classes, made.probabilities[0].tolist(), strict=True)),
            )
        )
    return found
