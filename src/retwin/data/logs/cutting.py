"""What starts and ends a trajectory in a log: a pause, a trigger, or a length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.checks import at_least, at_most, require
from retwin.data.logs.mapping import Cut
from retwin.data.logs.signals import Signal
from retwin.errors import InputError


@dataclass(frozen=True)
class Piece:
    """A part of a log, from `start` to `stop` in s; with `open_end`, `stop` itself is not in it."""

    start: float
    stop: float
    open_end: bool = False


def union_of_times(signals: Sequence[Signal]) -> NDArray:
    """The times in s at which any of the signals has a value, in order."""
    found = [each.times[np.isfinite(each.values)] for each in signals]
    return np.unique(np.concatenate([np.empty(0), *found]))


def pieces(
    cut: Cut, signals: Sequence[Signal], commands: Sequence[Signal], trigger: Signal | None
) -> list[Piece]:
    """The parts of a log that may become trajectories.

    Parameters
    ----------
    cut : Cut
        The settings.
    signals : sequence of Signal
        All signals that are channels, with times in s that increase.
    commands : sequence of Signal
        Those that are commands. But for a trigger, a piece begins when all of them have a value, so
        that its samples are at their times.
    trigger : Signal or None
        The signal that triggers.

    Raises
    ------
    InputError
        There are no values, no crossing of the level, or too many.

    """
    times = union_of_times(signals)
    remedy = "map signals that the log has values of"
    at_least("mapping", times, 1, "value of the signals that it names", remedy=remedy)
    whole = Piece(float(times[0]), float(times[-1]))
    if cut.by == "trigger":
        assert trigger is not None
        found = _cut_at_triggers(cut, trigger, whole.stop)
    elif cut.by == "gap":
        breaks = np.flatnonzero(np.diff(times) > (cut.gap or 0.0))
        starts = times[np.concatenate([[0], breaks + 1])]
        stops = times[np.concatenate([breaks, [len(times) - 1]])]
        found = [Piece(float(a), float(b)) for a, b in zip(starts, stops, strict=True)]
    else:
        found = [whole]
    _check_count(len(found))
    if cut.by != "trigger":
        found = [_begin_with_commands(each, commands) for each in found]
    if cut.by == "length":
        assert cut.length is not None
        (only,) = found
        count = int((only.stop - only.start) / cut.length + 1e-9)
        _check_count(count)
        found = [
            Piece(only.start + k * cut.length, only.start + (k + 1) * cut.length, True)
            for k in range(count)
        ]
        expected = f"a length within the log, {only.stop - only.start:g} s"
        got = f"{cut.length:g} s"
        require(found, "cut.length", expected=expected, got=got, remedy="give a shorter one")
    return found


def _check_count(count: int) -> None:
    remedy = "give a longer gap or length, or another trigger"
    # Trajectories that one log may be cut into: a level in the noise of a signal is crossed often.
    at_most("cut", count, 100_000, "trajectories", remedy=remedy)


def _begin_with_commands(piece: Piece, commands: Sequence[Signal]) -> Piece:
    """The piece from the first time on at which all commands have a value in it."""
    begins = [piece.start]
    for each in commands:
        at = each.times[np.isfinite(each.values)]
        place = int(np.searchsorted(at, piece.start))
        if place < len(at) and at[place] <= piece.stop:
            begins.append(float(at[place]))
    return Piece(max(begins), piece.stop)


def _cut_at_triggers(cut: Cut, trigger: Signal, end: float) -> list[Piece]:
    known = np.isfinite(trigger.values)
    at, values = trigger.times[known], trigger.values[known]
    above = values > cut.level if cut.edge == "rising" else values < cut.level
    crossings = at[1:][above[1:] & ~above[:-1]]
    if not len(crossings):
        low, high = (float(values.min()), float(values.max())) if len(values) else (np.nan, np.nan)
        expected = f"a level that {trigger.name!r} crosses, {cut.edge}"
        got = f"{cut.level:g}, while its values are from {low:g} to {high:g}"
        remedy = "give another level, edge or signal"
        raise InputError("cut.level", expected=expected, got=got, remedy=remedy)
    starts = crossings - cut.before
    nexts = np.append(starts[1:], np.inf)
    # No sample is in two trajectories, of which one might calibrate and the other one test.
    stops = np.minimum(nexts, end if cut.length is None else starts + cut.length)
    return [
        Piece(float(a), float(b), bool(cut.length is not None or b < end))
        for a, b in zip(starts, stops, strict=True)
    ]
