"""A mapping of the signals of a log to the channels of a twin that have their names."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from retwin.checks import finite, one_of, require
from retwin.data.logs.mapping import ChannelMapping, Cut, TimeSettings
from retwin.data.logs.mapping import Mapping as LogMapping
from retwin.data.logs.proposal import channel_mapping, cut_at_pauses, shortest_pause
from retwin.data.logs.signals import UNWANTED, Log, named_unit
from retwin.data.resampling import is_sparse, longest_bridge
from retwin.data.tables import EVEN, TIMES
from retwin.data.trajectories import Channels
from retwin.errors import InputError
from retwin.serialisation.configs import key
from retwin.twins.twin import Twin

LISTED = 12
"""Signals that a message lists, at most."""


@dataclass(frozen=True)
class Columns:
    """Which columns, or channels, of a log are the channels of a twin.

    Parameters
    ----------
    names : mapping of str to str
        Column, or signal, by channel of the twin; a channel that is not named has one of its name.
    time : TimeSettings
        Where the times of a table are; by default they are found by the name of their column.
    transient : float
        Duration in s at the begin of each trajectory whose outputs are not used, while the real
        system still moves from a state that the twin does not start in.
    mapping : path, optional
        A mapping.toml, as for `rt.load`, for logs whose signals have times of their own; then
        columns and times are those that it names.

    Raises
    ------
    InputError
        A transient that is no finite number of at least 0.

    """

    names: Mapping[str, str] = field(default_factory=dict)
    time: TimeSettings = TimeSettings()  # noqa: RUF009 - frozen
    transient: float = 0.0
    mapping: str | Path | None = None

    def __post_init__(self) -> None:
        finite("transient", self.transient, at_least=0.0, unit="s", remedy="leave it out")

    def of_channels(self, *channels: Channels) -> Columns:
        """Those of some channels."""
        every = {name for each in channels for name in each.names}
        return replace(self, names={k: name for k, name in self.names.items() if k in every})


def time_column(text: str, argument: str) -> TimeSettings:
    """The column of the times from "NAME" or "NAME=UNIT"; "" for one that is found by its name.

    Raises InputError, about `argument`, for a unit other than s, ms, us, ns and iso.
    """
    name, _, unit = text.partition("=")
    one_of(argument, unit, ("", "s", "ms", "us", "ns", "iso"), remedy="write for instance stamp=ms")
    return TimeSettings(column=name, unit=unit)  # type: ignore[arg-type]


@dataclass(frozen=True)
class LogSettings:
    """How logs name channels: the column of each, that of the times, and what is not used of them.

    Attributes
    ----------
    columns : dict of str to str
        Column by channel, where it has another name.
    time : str
        Column of the times, with its unit as "stamp=ms"; "" for one that is found by its name.
    transient : float
        See `Columns`.
    mapping : str
        A mapping.toml beside the case, in place of these.

    """

    columns: dict[str, str] = field(default_factory=dict)
    time: str = ""
    transient: float = 0.0
    mapping: str = ""

    @classmethod
    def of(cls, columns: Columns) -> LogSettings:
        """Those that name these columns; a mapping by its absolute path."""
        time, mapping = columns.time, columns.mapping
        return cls(
            dict(columns.names),
            f"{time.column}={time.unit}" if time.unit else time.column,
            columns.transient,
            Path(mapping).resolve().as_posix() if mapping else "",
        )

    def of_folder(self, folder: Path, place: str) -> Columns:
        """These of a case in a folder; InputError, about `place`, for a unit that is none."""
        time = time_column(self.time, key(place, "time"))
        mapping = folder / self.mapping if self.mapping else None
        return Columns(self.columns, time, self.transient, mapping)


def signals_of(log: Log, channels: Iterable[str], named: Mapping[str, str]) -> dict[str, str]:
    """The signal of each channel that has one.

    That is the signal of its name, or the only one whose name ends so after a dot or a slash, as
    `/encoder.speed` does. No name is taken that is merely alike: `retwin data map` proposes these,
    and a user checks them.

    Parameters
    ----------
    log : Log
        All its signals.
    channels : iterable of str
        Names of channels.
    named : mapping of str to str
        Signals that the user names, by channel.

    Raises
    ------
    InputError
        Several signals end like a channel, or there is none of a name that the user gives.

    """
    found = {}
    for channel in channels:
        wanted = named.get(channel, channel)
        plain = named_unit(wanted)[0]
        exact = next((each for each in (wanted, plain) if each in log.signals), None)
        ending = [each for each in log.signals if each.endswith((f"/{plain}", f".{plain}"))]
        if exact is None and channel in named and not ending:
            check_there(log.name, wanted, log.signals)
        fits = exact is not None or len(ending) < 2
        expected = f"one signal for {channel}"
        remedy = f"give --column {channel}=NAME"
        require(fits, log.name, expected=expected, got=", ".join(ending[:LISTED]), remedy=remedy)
        if exact is not None or ending:
            found[channel] = exact or ending[0]
    return found


def check_there(name: str, column: str, there: Iterable[str]) -> None:
    """Refuse a column that a log lacks."""
    expected = f"a column {column!r}"
    remedy = "name the columns as the header of the file does"
    require(column in there, name, expected=expected, got=f"columns {_list(there)}", remedy=remedy)


def _list(names: Iterable[str]) -> str:
    every = list(names)
    more = f", … ({len(every)} in all)" if len(every) > LISTED else ""
    return ", ".join(every[:LISTED]) + more


def _find_channels(
    log: Log, twin: Twin, named: Mapping[str, str], *, table: bool
) -> dict[str, str]:
    """The signal of each channel; refuses logs without a command or all outputs, or such times."""
    names = (*twin.inputs.names, *twin.outputs.names)
    taken = [name for name, why in log.skipped.items() if why == TIMES]
    both = [each for each in names if named.get(each, each) in taken]
    require(
        not both,
        log.name,
        expected="a column with the times of the rows that is no channel of the twin",
        got=f"the channel {both[0]}, whose values increase" if both else "",
        remedy="give --time COLUMN, or --rate HZ if each row is a sample at that rate",
    )
    found = signals_of(log, names, named)
    text = {name for name, why in log.skipped.items() if why not in (TIMES, UNWANTED)}
    unread = [each for each in names if named.get(each, each) in text]
    require(
        not unread,
        log.name,
        expected=f"numbers in columns {', '.join(unread)}",
        got=log.skipped[named.get(unread[0], unread[0])] if unread else "",
        remedy="check that it is the right column, and how it writes numbers",
    )
    what, all_of = ("column", "columns") if table else ("signal", "signals")
    wanted, lacking = f"an output of the twin, {', '.join(twin.outputs.names)}", ""
    if missing := [each for each in twin.inputs.names if each not in found]:
        wanted = f"every command, {', '.join(twin.inputs.names)}"
        lacking = f"; none for {', '.join(missing)}"
    require(
        not missing and any(each in found for each in twin.outputs.names),
        log.name,
        expected=f"a {what} for {wanted}",
        got=f"{all_of} {_list(log.signals)}{lacking}",
        remedy=f"name it: retwin identify --column {(*missing, *twin.outputs.names)[0]}=NAME, or "
        "[logs] of the case; or give a mapping: retwin data map LOG --case TWIN --out mapping.toml",
    )
    return found


def mapping_by_names(log: Log, twin: Twin, named: Mapping[str, str], *, table: bool) -> LogMapping:
    """The mapping of the signals that have the names of a twin's channels, at its rate.

    A pause separates trajectories, as in the mapping that `retwin data map` proposes. Commands are
    held until they are sent again; in a table, where an empty cell is refused, over rows that are
    left out, up to the shortest pause.

    Parameters
    ----------
    log : Log
        All its signals.
    twin : Twin
        Whose channels they are.
    named : mapping of str to str
        Signals that the user names, by channel.
    table : bool
        Whether it is a table of text.

    Raises
    ------
    InputError
        A log that lacks a command, or all outputs, or whose times are a channel.

    """
    found = _find_channels(log, twin, named, table=table)
    signals = [log.signals[each] for each in found.values()]
    cut = cut_at_pauses(signals, 1 / twin.rate) if signals else Cut()

    def channels(own: Channels, kind: str) -> dict[str, ChannelMapping]:
        made = {}
        for name, unit in zip(own.names, own.units, strict=True):
            if name not in found:
                continue
            signal = log.signals[found[name]]
            proposed = channel_mapping(signal, kind, twin.rate, cut)
            changes: dict[str, Any] = {"unit": unit if unit != "1" else None}
            if table:
                changes |= {"resample": None, "max_gap": None}
            if table and kind == "outputs" and is_sparse(signal.times, 1 / twin.rate):
                changes["resample"] = "none"
            if table and kind == "commands":
                held = min(proposed.max_gap or math.inf, shortest_pause(1 / twin.rate))
                changes["max_gap"] = max(held, longest_bridge(signal.times, 1 / twin.rate))
            made[name] = proposed.model_copy(update=changes)
        return made

    commands, outputs = channels(twin.inputs, "commands"), channels(twin.outputs, "outputs")
    made = LogMapping(rate=twin.rate, cut=cut, commands=commands, outputs=outputs)
    _refuse_missing(log, made)
    return made


def _refuse_missing(log: Log, mapping: LogMapping) -> None:
    """Refuse a table in which a command is missing before the last one.

    A trajectory would end there, in the middle of a record. Other logs have commands when they are
    sent, and values that are no numbers are rare in them.
    """
    for name, each in mapping.commands.items():
        (signal,) = (log.signals[own] for own in each.signals)
        known = np.flatnonzero(np.isfinite(signal.values))
        last = int(known[-1]) + 1 if len(known) else 0
        holes = np.flatnonzero(~np.isfinite(signal.values[:last]))
        if len(holes) or last < 2:
            at = f", none at {signal.times[holes[0]]:g} s" if len(holes) else ""
            expected = f"a number for every command until the log ends, two at least; for {name}"
            got = f"{len(known)} of {last}{at}"
            remedy = "fill in the missing commands, which are known inputs, or give the rows "
            remedy += "before and after them as two logs"
            raise InputError(log.name, expected=expected, got=got, remedy=remedy)


def has_times(log: Log, time: TimeSettings) -> bool:
    """Whether the values of a log have times, and not just an order."""
    return bool(time.rate) or EVEN not in log.skipped.values()


def resampling_of(log: Log, mapping: LogMapping, rate: float, *, rounded: float = 0.001) -> str:
    """How the values of a log come to the sample rate.

    Parameters
    ----------
    rounded : float, default 0.001
        Relative difference of rates that count as equal.

    """
    place = next((name for name, why in log.skipped.items() if why == TIMES), "")
    where = f"times in column {place}, " if place else ""
    own, held = [], 0.0
    commands = {each for channel in mapping.commands.values() for each in channel.signals}
    for name in mapping.signals:
        at = log.signals[name].times
        steps = np.diff(at)
        if name in commands and place and len(steps):
            usual = longest_bridge(at, 1 / rate)
            bridged = steps[(steps > usual) & (steps <= max(usual, shortest_pause(1 / rate)))]
            held = max(held, float(bridged.max(initial=0.0)))
        if len(steps) and not np.allclose((at - at[0]) * rate, np.arange(len(at)), atol=1e-3):
            own.append(1 / float(np.median(steps)) if np.median(steps) > 0 else 0.0)
    if not own:
        return f"{where}a row per sample at {rate:g} Hz"
    low, high = min(own), max(own)
    shown = f"{low:.4g}" if high < (1 + rounded) * low else f"{low:.4g} to {high:.4g}"
    rows = f", commands are held where rows are left out, for {held:.2g} s at most" if held else ""
    if any(each.resample == "none" for each in mapping.outputs.values()):
        rows = f", outputs are left open between these{rows}"
    return f"{where}values at {shown} Hz (median) are brought to {rate:g} Hz{rows}"
