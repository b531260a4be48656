"""Signals of a log as channels: times in order, units converted, on the grid of the samples."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require, same_names
from retwin.data.logs.mapping import ChannelMapping
from retwin.data.logs.signals import MAX_SIGNALS, NO_STAMP, UNWANTED, Log, Signal, inside
from retwin.data.logs.units import converted, same_unit
from retwin.data.measured import stand_in
from retwin.data.provenance import Sampling
from retwin.data.resampling import Resampling, longest_bridge, resample
from retwin.data.trajectories import Channels
from retwin.errors import InputError

HOUR = 3600.0
"""By how much clocks are set back at the end of summer time, in s."""
EVEN = 0.1
"""Share of intervals that differ, and relative difference from the median, of even rows."""


@dataclass(frozen=True, eq=False)
class Channel:
    """A channel of the trajectories, and its signal with times in order and values in its unit.

    Attributes
    ----------
    name, unit : str
        Of the channel.
    signal : Signal
        Its values, in that unit.
    how : {"hold", "linear", "none"}
        How it comes to the sample rate.
    longest : float
        The longest interval that is bridged, in s.
    notes : tuple of str
        What was done to it.

    """

    name: str
    unit: str
    signal: Signal
    how: Resampling
    longest: float
    notes: tuple[str, ...]

    def resample(self, grid: NDArray, period: float, end: float) -> NDArray:
        """Its values (N,) on a grid of times, NaN where they are missing."""
        known, last = (self.signal.times, self.signal.values), end if self.how == "hold" else None
        return resample(*known, grid, period, self.how, longest=self.longest, end=last)

    def sampling(self, rate: float, missing: float, *, decimated: float = 1.5) -> Sampling:
        """What its provenance says, with the share of its samples that are missing.

        Parameters
        ----------
        decimated : float, default 1.5
            Ratio of the rates from which linear resampling leaves out values.

        """
        at = self.signal.times[np.isfinite(self.signal.values)]
        steps = np.diff(at)
        own = 1 / float(np.median(steps)) if len(steps) else 0.0
        notes = list(self.notes)
        if self.how != "hold" and own > decimated * rate:
            notes.append("samples left out, not filtered")
        bridged, longest = self.longest * (self.how != "none"), float(steps.max(initial=0.0))
        about = (own, missing, bridged, longest, "; ".join(notes))
        return Sampling(self.name, self.signal.name, self.how, *about)


def table_of(
    table: Mapping[str, ChannelMapping], wanted: Channels | None, name: str, *, stated: bool = True
) -> list[tuple[str, ChannelMapping, str | None]]:
    """The channels of a table of the mapping in their order, with the unit that the case has.

    Without `stated`, a unit of "1" is one that nobody has stated.

    Raises
    ------
    InputError
        They are not those of the case.

    """
    if wanted is None:
        return [(each, own, None) for each, own in table.items()]
    remedy = f"write a table [{name}.NAME] for each of them"
    same_names(f"mapping: {name}", table, wanted.names, "the channels of the case,", remedy=remedy)
    return [
        (each, table[each], unit if stated or unit != "1" else None)
        for each, unit in zip(wanted.names, wanted.units, strict=True)
    ]


def channels_of(
    log: Log,
    tables: Sequence[tuple[str, ChannelMapping, str | None]],
    default: Resampling,
    period: float,
) -> list[Channel]:
    """The channels of some tables, each with its signal.

    Raises
    ------
    InputError
        The log lacks a signal, its times are out of order, or its unit is not converted.

    """
    return [_channel(log, name, own, unit, default, period) for name, own, unit in tables]


def _channel(
    log: Log, name: str, own: ChannelMapping, unit: str | None, default: Resampling, period: float
) -> Channel:
    found = [signal_of(log, each) for each in own.signals]
    signal, notes = in_order(mean_of(found, log.name), log.name)
    if signal.unreadable:
        one = signal.unreadable == 1
        notes.append(
            "1 value is no number" if one else f"{signal.unreadable} values are no numbers"
        )
    notes += [signal.note] * bool(signal.note)
    coded = stand_in(signal.values)
    if coded:
        notes.append(
            f"{_values(coded[1])} of {coded[0]:g}, far from all others: leave the cells empty, or "
            "write NaN, if they stand for missing ones"
        )
    topics = [topic for topic, why in log.skipped.items() if why == NO_STAMP]
    if any(inside(signal.name, each) for each in topics):
        notes.append("no header stamps, time of recording")
    values, target, done = in_unit(
        signal.values, own, signal.unit, unit, f"{log.name}, {signal.name}"
    )
    notes += done
    if own.clock_offset:
        notes.append(f"clock {own.clock_offset:+g} s")
    made = replace(signal, times=signal.times + own.clock_offset, values=values, unit=target)
    known = made.times[np.isfinite(made.values)]
    longest = own.max_gap or longest_bridge(known, period)
    return Channel(name, target, made, own.resample or default, longest, tuple(notes))


def in_unit(
    values: NDArray, own: ChannelMapping, stated: str, unit: str | None, where: str
) -> tuple[NDArray, str, list[str]]:
    """Values (n,) of a signal as those of its channel, their unit, and what was done to them.

    Parameters
    ----------
    values : NDArray
        Values of the signal.
    own : ChannelMapping
        The channel in the mapping.
    stated : str
        The unit that the log states, "" for none.
    unit : str or None
        The unit that the case has.
    where : str
        Log and signal, for messages.

    Raises
    ------
    InputError
        A unit is not known, or is not converted to the other.

    """
    notes = []
    if own.scale != 1 or own.shift != 0:
        values = values * own.scale + own.shift
        notes.append(f"times {own.scale:g} plus {own.shift:g}")
        source = own.from_unit or own.unit or unit or "1"
    else:
        source = own.from_unit or stated or own.unit or unit or "1"
        if not (own.from_unit or stated or own.unit) and unit and unit != "1":
            notes.append(f"no unit in the log, taken as {unit}")
    target = unit or own.unit or source
    if not same_unit(source, target):
        values = converted(values, source, target, where)
        notes.append(f"{source} to {target}")
    return np.where(np.isfinite(values), values, np.nan), target, notes


def mean_of(found: Sequence[Signal], place: str) -> Signal:
    """The mean of signals with the same times and unit, which is missing where one is."""
    first = found[0]
    for other in found[1:]:
        fits = np.array_equal(first.times, other.times) and same_unit(first.unit, other.unit)
        expected = f"the times and the unit of {first.name!r}, with which it is averaged"
        remedy = "map one of them alone"
        require(fits, f"{place}, {other.name}", expected=expected, got="others", remedy=remedy)
    return replace(
        first,
        name=", ".join(each.name for each in found),
        values=np.mean([each.values for each in found], axis=0),
        unreadable=sum(each.unreadable for each in found),
    )


def signal_of(log: Log, name: str) -> Signal:
    """The signal of that name; InputError, with those that are alike, if the log has none."""
    found = log.signals.get(name)
    if found is not None and len(found.times):
        return found
    there = [*log.signals, *(other for other, why in log.skipped.items() if why == UNWANTED)]
    alike = difflib.get_close_matches(name, there[:MAX_SIGNALS], n=3, cutoff=0.3)
    others = ", ".join(alike or there[:3]) or "none"
    expected = f"the signal {name!r} of the mapping"
    got = f"it without values ({log.skipped[name]})" if name in log.skipped else others
    remedy = "name it as the log does; `retwin data map` lists all signals"
    raise InputError(log.name, expected=expected, got=got, remedy=remedy)


def in_order(signal: Signal, where: str, *, disorder: float = 10.0) -> tuple[Signal, list[str]]:
    """The signal with times that increase, and notes of what was done for that.

    Where times are not in order, only values that are there count: in a table of several topics,
    rows with the same time each hold a value of one of them.

    Parameters
    ----------
    disorder : float, default 10.0
        Longest step back in time, in median intervals, that is a matter of order: messages of
        several processes overtake each other. A longer one is a clock that was set.

    Raises
    ------
    InputError
        A step back in time is no matter of order, or most values have the time of another.

    """
    if (np.diff(signal.times) > 0).all():
        return signal, []
    known = np.isfinite(signal.values)
    times, values = signal.times[known], signal.values[known]
    steps = np.diff(times)
    if (steps > 0).all():
        return replace(signal, times=times, values=values), []
    place, typical = f"{where}, {signal.name}", float(np.median(np.abs(steps)))
    same = int((steps == 0).sum())
    got = f"{same} of {len(times)} at the time of the one before"
    remedy = "name a column of finer times in [time] of a mapping, or give rate = … in its "
    remedy += "place for even rows"
    require(typical > 0, place, expected="values at times of their own", got=got, remedy=remedy)
    worst = int(np.argmin(steps))
    even = np.mean(np.abs(np.delete(steps, worst) - typical) <= EVEN * typical) > 1 - EVEN
    repeated = abs(HOUR + steps[worst] - typical) <= EVEN * typical and even
    steady = (abs(HOUR + steps[worst]) > 1.5 * typical or steps[worst] >= -typical) and not repeated
    got = f"one hour twice, at {times[worst]:g} s, as at the end of summer time"
    remedy = "record UTC, or add its offset to each time (+02:00), or split the log there"
    require(steady, place, expected="times of a clock that nobody sets", got=got, remedy=remedy)
    expected = "times that increase"
    got = f"a step back of {-steps[worst]:g} s at {times[worst]:g} s"
    remedy = "split the log there, or give other times in [time] of a mapping: rate = … in "
    remedy += 'place of column for even rows, stamps = "log" for messages'
    require(-steps[worst] <= disorder * typical, place, expected=expected, got=got, remedy=remedy)
    early = np.maximum.accumulate(times) - times
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    last = np.append(np.diff(times) > 0, True)  # of values with the same time the last one counts
    notes = []
    if (steps < 0).any():
        notes.append(
            f"{_values(int((early > 0).sum()))} put in order, up to {early.max():g} s "
            "earlier than one before"
        )
    if not last.all():
        notes.append(f"{_values(int((~last).sum()))} with the time of another left out")
    return replace(signal, times=times[last], values=values[last]), notes


def _values(count: int) -> str:
    return f"{count} {'value' if count == 1 else 'values'}"
