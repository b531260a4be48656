"""A mapping that is proposed by what a log holds: rates, units, names, constant signals, pauses."""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from retwin.data.io.assembly import DataCase
from retwin.data.logs.channels import in_order
from retwin.data.logs.cutting import union_of_times
from retwin.data.logs.mapping import ChannelMapping, Cut, Mapping, TimeSettings
from retwin.data.logs.proposal_text import Chosen, Fact, mapping_text, units_of
from retwin.data.logs.reading import log_format, read_log
from retwin.data.logs.signals import NANOSECOND, NO_STAMP, Log, Signal
from retwin.data.logs.units import compatible, unit_in_name
from retwin.data.resampling import BRIDGED
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.sizes import Budget

COMMAND = re.compile(
    r"(^|[^a-z])(cmd|command(s|ed)?|set_?point(s)?|target(s)?|ref(erence)?|desired|demand|goal|"
    r"input(s)?|control|u|soll(wert)?|sp)([^a-z]|\d|$)"
)
"""Words in the names of commands."""
OVERHEAD = re.compile(r"covariance|/rosout|/parameter_events|/tf_static|\.seq$|/diagnostics")
"""Names of what describes the log and not the system."""
STAMPED = (".mcap", "", ".db3", ".bag")
"""Formats whose messages may have header stamps."""
PAUSE, PAUSE_PERIODS = 1.0, 20.0
"""The shortest pause in s, and in sample periods, between two trajectories."""


@dataclass(frozen=True)
class Proposal:
    """A proposed mapping.

    Attributes
    ----------
    log : Log
        What was read of the log.
    text : str
        The mapping.toml.
    mapping : Mapping or None
        The same without the channels for which no signal was found; None if no output is left.
    facts : tuple of Fact
        What is seen of all signals.
    channels : dict of str to str
        The channel of each signal that was chosen.
    open_channels : tuple of str
        Channels of the case for which no signal was found; the user names it in the file.
    by_unit : tuple of str
        Channels of the case whose signal was chosen by its unit alone.

    """

    log: Log
    text: str
    mapping: Mapping | None
    facts: tuple[Fact, ...]
    channels: dict[str, str] = field(default_factory=dict)
    open_channels: tuple[str, ...] = field(default=())
    by_unit: tuple[str, ...] = field(default=())


def propose_mapping(
    path: str | os.PathLike[str],
    *,
    case: DataCase | None = None,
    time: TimeSettings | None = None,
    progress: Progress | None = None,
    max_bytes: int | None = None,
) -> Proposal:
    """A mapping for a log, by what is seen of all its signals.

    Messages with header stamps get the times of these, since a measurement is as old as its stamp
    says and not as its recording.

    Parameters
    ----------
    path : path
        A log of one of the formats in `catalog.LOGS`.
    case : DataCase, optional
        Its channels and sample rate are those of the mapping; with rate 0 that of the log is.
    time : TimeSettings, optional
        Where the times are, if they are not found.
    progress : callable, optional
        Called with the share that is done, from 0 to 1.
    max_bytes : int, optional
        The memory that the signals may take; by default half of what is free.

    Returns
    -------
    Proposal
        The mapping as text, and as `Mapping` where it is complete enough to be tried.

    Raises
    ------
    InputError
        It is no log, damaged or too large, its times are not found, or no signal changes.

    """
    path = Path(path)
    time = time or TimeSettings()
    limit = Budget(path.name, max_bytes).left
    log = read_log(path, clock=time.clock, budget=Budget(path.name, limit))
    if progress is not None:
        progress(0.5)
    proposal = proposed(log, time, case=case)
    mapping = proposal.mapping
    if log_format(path) in STAMPED and time.stamps == "log":
        stamped = time.model_copy(update={"stamps": "header"})
        # Where a signal is still to be named, it may be any that changes.
        names: Collection[str] = (
            mapping.signals
            if mapping is not None and not proposal.open_channels
            else [each.name for each in proposal.facts if _moves(each)]
        )
        other = _read_stamped(path, proposal, names, stamped, Budget(path.name, limit))
        if other is not None:
            made = proposed(log, stamped, case=case, delay=other[1])
            proposal = replace(made, log=other[0])
    return proposal


def _read_stamped(
    path: Path, proposal: Proposal, names: Collection[str], stamped: TimeSettings, budget: Budget
) -> tuple[Log, float] | None:
    """Signals at the stamps of their headers, and the median time in s from there
    to the recording; None if the stamps are of no use.
    """
    try:
        other = read_log(path, wanted=names, clock=stamped.clock, budget=budget)
        for name in names:
            in_order(other.signals[name], path.name)
    except (InputError, KeyError):
        return None
    pairs = [(proposal.log.signals[name], other.signals[name]) for name in names]
    if any(len(one.times) != len(two.times) for one, two in pairs):
        return None
    begin = (proposal.log.begin - other.begin) * NANOSECOND
    unstamped = [topic for topic, why in other.skipped.items() if why == NO_STAMP]
    delays = [
        one.times - two.times + begin
        for one, two in pairs
        if not any(one.name.startswith(topic) for topic in unstamped)
    ]
    found = float(np.median(np.concatenate(delays))) if delays else -1.0
    return (other, found) if 0 <= found < 60.0 else None  # s; else those of another clock


def _fact(signal: Signal) -> Fact:
    known = np.isfinite(signal.values)
    values, at = signal.values[known], np.sort(signal.times[known])
    steps = np.diff(at)
    typical = float(np.median(steps)) if len(steps) else 0.0
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    unit, rate = signal.unit or unit_in_name(signal.name), 1 / typical if typical > 0 else 0.0
    longest = float(steps.max(initial=0.0))
    return Fact(signal.name, unit, len(values), rate, longest, low, high, not low < high)


def proposed(
    log: Log, time: TimeSettings, *, case: DataCase | None = None, delay: float | None = None
) -> Proposal:
    """A mapping of the signals of a log to channels.

    With a case, each of its channels gets the signal whose name is most like its own, and whose
    unit fits, else the only one that is left whose unit fits. Without, signals that change are
    commands or outputs by their names.

    Parameters
    ----------
    log : Log
        All signals.
    time : TimeSettings
        The clock with which they were read.
    case : DataCase, optional
        Its channels and sample rate are those of the mapping.
    delay : float, optional
        The median time in s from the header stamps of messages to their recording, if these differ.

    Raises
    ------
    InputError
        No signal changes, or none at times of its own.

    """
    facts = [_fact(each) for each in log.signals.values()]
    moving = [each for each in facts if _moves(each)]
    if not moving:
        for each in facts:
            if not each.constant:
                in_order(log.signals[each.name], log.name)  # its times repeat: says so
        got = f"{len(facts)} that are constant or have one value"
        remedy = "check that it is the right log"
        raise InputError(log.name, expected="signals that change", got=got, remedy=remedy)
    chosen = _by_name(moving) if case is None else _for_case(moving, case)
    by_unit = _add_by_unit(chosen, moving, units_of(case))
    used = [fact for table in chosen.values() for fact in table.values() if fact is not None]
    rate = case.rate if case is not None else 0.0
    # Signals that are not chosen yet may be the faster ones.
    known = used if all(all(table.values()) for table in chosen.values()) else moving
    rate = rate or _plain(float(np.median([each.rate for each in known])))
    cut = cut_at_pauses([log.signals[each.name] for each in used], 1 / rate)
    units = units_of(case)
    tables = {
        name: {
            channel: channel_mapping(log.signals[fact.name], name, rate, cut).model_copy(
                update={
                    "unit": units.get(channel),
                    "from_unit": None if log.signals[fact.name].unit else fact.unit or None,
                }
            )
            for channel, fact in table.items()
            if fact
        }
        for name, table in chosen.items()
    }
    unknown = tuple(c for table in chosen.values() for c, fact in table.items() if fact is None)
    commands, outputs = tables["commands"], tables["outputs"]
    draft = Mapping.model_construct(
        rate=rate, time=time, cut=cut, commands=commands, outputs=outputs
    )
    mapping = draft if draft.outputs else None
    text = mapping_text(log, draft, chosen, facts, case, delay, by_unit)
    channels = {
        fact.name: channel for table in chosen.values() for channel, fact in table.items() if fact
    }
    return Proposal(log, text, mapping, tuple(facts), channels, unknown, by_unit)


def _moves(fact: Fact) -> bool:
    """Whether a signal may be a channel: it changes, and does not describe the log."""
    return not fact.constant and fact.rate > 0 and not OVERHEAD.search(fact.name)


def _round(value: float) -> float:
    return float(f"{float(value):.3g}")


def _plain(rate: float, *, jitter: float = 0.005) -> float:
    """A measured rate without the jitter of its times: 50 for 49.95.

    Parameters
    ----------
    jitter : float, default 0.005
        Relative difference up to which a measured rate stands for one of two digits.

    """
    plain = float(f"{rate:.2g}")
    return plain if abs(plain / rate - 1) < jitter else _round(rate)


def _by_name(moving: Sequence[Fact], *, max_channels: int = 24) -> Chosen:
    """Commands and outputs by the words in their names.

    Parameters
    ----------
    max_channels : int, default 24
        Channels that are proposed without a case; the other signals are listed.

    """
    chosen: Chosen = {"commands": {}, "outputs": {}}
    for fact in moving[:max_channels]:
        table = "commands" if COMMAND.search(fact.name.lower()) else "outputs"
        chosen[table][fact.name.lstrip("/")] = fact
    if not chosen["outputs"]:  # they are what is measured, in any case
        chosen = {"commands": {}, "outputs": chosen["commands"]}
    return chosen


def _for_case(moving: Sequence[Fact], case: DataCase, *, alike: float = 0.72) -> Chosen:
    """For each channel of the case the signal that is most like it, each signal once.

    Parameters
    ----------
    alike : float, default 0.72
        Least score of a name that is taken for a channel's.

    """
    channels = [
        (table, name, unit)
        for table, some in (("commands", case.inputs), ("outputs", case.outputs))
        for name, unit in zip(some.names, some.units, strict=True)
    ]
    scores = [
        (_alike(name, unit, fact, command=table == "commands"), table, name, fact)
        for table, name, unit in channels
        for fact in moving
    ]
    chosen: Chosen = {"commands": {}, "outputs": {}}
    for table, name, _ in channels:
        chosen[table][name] = None
    taken: set[str] = set()
    for score, table, name, fact in sorted(scores, key=lambda each: -each[0]):
        if score >= alike and chosen[table][name] is None and fact.name not in taken:
            chosen[table][name] = fact
            taken.add(fact.name)
    # Where one command is left and one signal that is named like a command, they are a pair.
    left = [name for name, fact in chosen["commands"].items() if fact is None]
    units = units_of(case)
    marked = [
        each for each in moving if each.name not in taken and COMMAND.search(each.name.lower())
    ]
    if len(left) == len(marked) == 1 and _may_be(marked[0].unit, units.get(left[0], "")):
        chosen["commands"][left[0]] = marked[0]
    return chosen


def _add_by_unit(chosen: Chosen, moving: Sequence[Fact], units: dict[str, str]) -> tuple[str, ...]:
    """Choose the signal of each channel without one whose unit is that of one signal alone.

    A signal that is named like a command is no output, and none that several channels may have is
    chosen. Returns the channels.
    """
    taken = {fact.name for table in chosen.values() for fact in table.values() if fact}
    fitting = {
        (table, channel): [
            each
            for each in moving
            if each.name not in taken
            and each.unit
            and compatible(each.unit, units[channel])
            and (table == "commands" or not COMMAND.search(each.name.lower()))
        ]
        for table, channels in chosen.items()
        for channel, fact in channels.items()
        if fact is None and channel in units
    }
    named = [fact.name for some in fitting.values() for fact in some]
    alone = [at for at, own in fitting.items() if len(own) == 1 == named.count(own[0].name)]
    for table, channel in alone:
        chosen[table][channel] = fitting[table, channel][0]
    return tuple(channel for _, channel in alone)


def _may_be(unit: str, wanted: str) -> bool:
    """Whether values in a unit, perhaps unknown, can be those of a channel."""
    return not unit or not wanted or compatible(unit, wanted)


def _alike(name: str, unit: str, fact: Fact, *, command: bool) -> float:
    """How much the name of a signal is like that of a channel; 1 is the same."""
    wanted = re.sub(r"[^a-z0-9]", "", name.lower())
    parts = re.findall(r"[a-z0-9]+", fact.name.lower())
    endings = {"".join(parts[place:]) for place in range(len(parts))} | set(parts)
    if not wanted or not parts:
        return 0.0
    if wanted in endings:
        score = 1.0
    else:
        score = 0.95 * max(difflib.SequenceMatcher(None, wanted, e).ratio() for e in endings)
    marked = COMMAND.search(fact.name.lower()) is not None
    score += 0.1 if marked == command else -0.1
    if fact.unit and unit not in ("", "1"):
        score += 0.1 if compatible(fact.unit, unit) else -0.3
    return score


def shortest_pause(period: float) -> float:
    """The longest interval in s without a value that is no pause, at a sample period in s."""
    return max(PAUSE, PAUSE_PERIODS * period)


def cut_at_pauses(signals: Sequence[Signal], period: float) -> Cut:
    """A cut at the pauses of a log, if there are any."""
    steps = np.diff(union_of_times(signals))
    least = shortest_pause(period)
    longer = steps[steps > least]
    # A slow log has no pauses: its intervals are all alike.
    if not len(longer) or len(longer) > 0.05 * len(steps):
        return Cut()
    return Cut(by="gap", gap=_round(max(least, float(longer.min()) / 2)))


def channel_mapping(signal: Signal, table: str, rate: float, cut: Cut) -> ChannelMapping:
    """How a signal becomes a channel of a table of the mapping, at a rate in Hz."""
    own = _fact(signal).rate
    longest = BRIDGED * max(1 / rate, 1 / own if own else 0.0)
    # A command that is sent when it changes holds until the next one.
    if table == "commands":
        steps = np.diff(np.sort(signal.times[np.isfinite(signal.values)]))
        longest = max(longest, float(steps[steps <= (cut.gap or math.inf)].max(initial=0.0)))
    exponent = math.floor(math.log10(longest)) - 2
    return ChannelMapping(
        signal=signal.name,
        resample="hold" if table == "commands" else "linear",
        max_gap=_round(math.ceil(longest / 10**exponent - 1e-6) * 10**exponent),
    )
