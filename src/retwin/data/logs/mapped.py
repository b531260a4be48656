"""Trajectories from a log by its mapping."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import runs
from retwin.checks import given, require
from retwin.data.io.assembly import DataCase, Raw, assemble
from retwin.data.logs.channels import Channel, channels_of, in_order, signal_of, table_of
from retwin.data.logs.cutting import Piece, pieces
from retwin.data.logs.mapping import NO_NOMINAL, Mapping, read_mapping
from retwin.data.logs.reading import read_log
from retwin.data.logs.signals import NANOSECONDS, Log
from retwin.data.provenance import Provenance
from retwin.data.resampling import SAME
from retwin.data.row_times import misread_unit
from retwin.data.trajectories import Channels, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.sizes import Budget


def read_mapped(
    path: Path,
    mapping: Mapping | str | os.PathLike[str],
    *,
    case: DataCase | None = None,
    rate: float | None = None,
    progress: Progress | None = None,
    max_bytes: int | None = None,
) -> Trajectories:
    """Trajectories of a log; the arguments are those of `data.io.load`."""
    settings = mapping if isinstance(mapping, Mapping) else read_mapping(mapping)
    budget = Budget(path.name, max_bytes)
    log = read_log(
        path, wanted=settings.signals, clock=settings.time.clock, budget=budget, progress=progress
    )
    return mapped(log, settings, case=case, rate=rate, budget=budget)


def mapped(
    log: Log,
    mapping: Mapping,
    *,
    budget: Budget,
    case: DataCase | None = None,
    rate: float | None = None,
) -> Trajectories:
    """The trajectories in a log.

    A trajectory ends where a command is missing, since commands are known inputs; a missing output
    is masked. The provenance says how each channel was resampled and how much of it is missing.

    Parameters
    ----------
    log : Log
        The signals that the mapping names, at least.
    mapping : Mapping
        The settings.
    budget : Budget
        The memory that the trajectories may take.
    case : DataCase, optional
        Its channels and sample rate are those of the trajectories, and its twin, if it has one,
        simulates the nominal outputs. Without a case these are 0.
    rate : float, optional
        The sample rate in Hz, if the mapping has none.

    Raises
    ------
    InputError
        The mapping does not suit the log or the case, or nothing is left.

    """
    found = parts_of(log, mapping, budget=budget, case=case, rate=rate)
    raws = found.raws(log, mapping.label)
    inputs, outputs = (
        Channels(tuple(each.name for each in some), tuple(each.unit for each in some))
        for some in (found.commands, found.measured)
    )
    source, given = Provenance(log.name, log.sha256), inputs if len(inputs) else None
    made = assemble(raws, source=source, case=None, rate=found.rate, budget=budget, inputs=given)
    notes = found.notes(log)
    twin = getattr(case, "twin", None)
    nominal = made.nominal
    if found.ideal:
        notes.append("nominal outputs from the log")
    elif twin is not None and found.commands:
        nominal = twin.simulate(made.commands, seed=0).nominal
        notes.append("nominal outputs simulated by the twin of the case")
    else:
        notes.append(NO_NOMINAL)
    sampling = tuple(
        each.sampling(found.rate, missing)
        for each, missing in zip(found.every, found.missing(), strict=True)
    )
    source = replace(source, sampling=sampling, notes=tuple(notes))
    return made.replace(nominal=nominal, outputs=outputs, provenance=(source,))


def parts_of(
    log: Log,
    mapping: Mapping,
    *,
    budget: Budget,
    case: DataCase | None = None,
    rate: float | None = None,
) -> Parts:
    """The parts of a log that are trajectories; arguments and errors are those of `mapped`."""
    rate = _rate(mapping, case, rate)
    period = 1 / rate
    inputs, outputs = (case.inputs, case.outputs) if case is not None else (None, None)
    given = mapping.commands or (inputs is not None and not mapping.nominal)
    stated = case is None or bool(case.classes)
    taken = table_of(mapping.commands, inputs if given else None, "commands", stated=stated)
    commands = channels_of(log, taken, "hold", period)
    taken = table_of(mapping.outputs, outputs, "outputs", stated=stated)
    measured = channels_of(log, taken, "linear", period)
    taken = table_of(mapping.nominal, outputs, "nominal") if mapping.nominal else []
    ideal = channels_of(log, taken, "linear", period)
    found = Parts(log.end, rate, commands, measured, ideal)
    trigger = None
    if mapping.cut.by == "trigger" and mapping.cut.signal:
        trigger = in_order(signal_of(log, mapping.cut.signal), log.name)[0]
    every = [each.signal for each in found.every]
    parts = pieces(mapping.cut, every, [each.signal for each in commands], trigger)
    _check_dense(log, found, parts, budget)
    shortest = max(2, round((mapping.cut.min_length or 0.0) * rate))
    for piece in parts:
        found.add(piece, shortest)
    return found


def try_mapping(log: Log, mapping: Mapping | None, *, case: DataCase | None = None) -> Parts | str:
    """The parts of a log that a proposed mapping makes trajectories, or why there are none.

    Parameters
    ----------
    log : Log
        The signals.
    mapping : Mapping or None
        What is proposed.
    case : DataCase, optional
        As for `mapped`; it may have more channels than the mapping, which is tried as it is.

    """
    if mapping is None:
        return "no signal is mapped to an output"
    complete = (
        case is not None
        and set(mapping.commands) == set(case.inputs.names)
        and set(mapping.outputs) == set(case.outputs.names)
    )
    try:
        made = parts_of(log, mapping, budget=Budget(log.name), case=case if complete else None)
    except InputError as error:
        return str(error)
    return made if made.blocks else "no part has all commands and a measurement"


@dataclass
class Parts:
    """Trajectories as they are found, and what was left out."""

    end: float
    rate: float
    commands: list[Channel]
    measured: list[Channel]
    ideal: list[Channel]
    blocks: list[tuple[float, NDArray]] = field(default_factory=list)
    """Start in s, and the samples (T, d) of all channels."""
    split: int = 0
    short: int = 0
    unmeasured: int = 0

    @property
    def every(self) -> list[Channel]:
        """All channels, in the order of the columns of the blocks."""
        return [*self.commands, *self.ideal, *self.measured]

    @property
    def needed(self) -> int:
        """Channels that must be known at every sample, which come first."""
        return len(self.commands) + len(self.ideal)

    def add(self, piece: Piece, shortest: int) -> None:
        """The trajectories in a piece: its parts in which all commands are known."""
        spread = (piece.stop - piece.start) * self.rate
        count = max(0, round(spread)) if piece.open_end else int(spread + SAME) + 1
        grid = piece.start + np.arange(count) / self.rate
        columns = [each.resample(grid, 1 / self.rate, self.end) for each in self.every]
        block = np.stack(columns, axis=1) if count else np.empty((0, len(columns)))
        known = np.isfinite(block)
        needed = known[:, : self.needed]
        used = np.all(needed, axis=1) if self.needed else np.any(known, axis=1)
        parts = runs(used)
        if not self.needed and len(parts):
            parts = parts.reshape(1, -1)[:, [0, -1]]  # missing outputs end no trajectory
        kept = 0
        for first, stop in parts:
            if stop - first < shortest:
                self.short += 1
            elif not known[first:stop, self.needed :].any():
                self.unmeasured += 1
            else:
                kept += 1
                self.blocks.append((float(grid[first]), block[first:stop]))
        self.split += max(0, kept - 1)
        self.short += not len(parts)

    def raws(self, log: Log, label: str) -> list[Raw]:
        """The trajectories, each with its start in s as a name."""
        if not self.blocks:
            empty = [each.name for each in self.every if not np.isfinite(each.signal.values).any()]
            expected = "two samples at least with all commands and a measurement"
            got = f"none, and no value at all of {', '.join(empty)}" if empty else "none"
            remedy = "check max_gap of the commands and [cut] in the mapping; `retwin data map` "
            remedy += "draws them"
            raise InputError(log.name, expected=expected, got=got, remedy=remedy)
        n, stem = len(self.commands), Path(log.name).stem
        width = len(self.measured)
        digits = max(1, math.ceil(math.log10(self.rate)))  # starts differ by two samples at least
        return [
            Raw(
                where=f"{log.name} at {start:g} s",
                label=label,
                nominal=block[:, n : self.needed] if self.ideal else np.zeros((len(block), width)),
                observed=block[:, self.needed :],
                commands=block[:, :n] if n else None,
                id=f"{stem} {start:.{digits}f}".rstrip("0").rstrip(".") + " s",
            )
            for start, block in self.blocks
        ]

    def missing(self) -> list[float]:
        """The share of the samples that are missing, of each channel."""
        total = sum(len(block) for _, block in self.blocks)
        holes = sum(np.isnan(block).sum(axis=0) for _, block in self.blocks)
        return [float(each) / total for each in np.atleast_1d(holes)]

    def notes(self, log: Log) -> list[str]:
        """What was left out, in sentences."""
        seconds = sum(len(block) for _, block in self.blocks) / self.rate
        share = min(1.0, seconds / log.end) if log.end else 1.0
        notes = [f"{share:.1%} of the log's {log.end:g} s are in trajectories"]
        if self.split:
            notes.append(f"{self.split} times a trajectory ends where a command is missing")
        if self.short:
            were = "part was" if self.short == 1 else "parts were"
            notes.append(f"{self.short} {were} too short, or without all commands")
        if self.unmeasured:
            parts = "part" if self.unmeasured == 1 else "parts"
            notes.append(f"{self.unmeasured} {parts} had no measurement")
        return notes

    def changes(self) -> list[str]:
        """What was done to the values and times of channels, each after those to which it was."""
        channels: dict[str, list[str]] = {}
        for each in self.every:
            for note in each.notes:
                channels.setdefault(note, []).append(each.name)
        return [f"{', '.join(own)}: {note}" for note, own in channels.items()]


def _rate(mapping: Mapping, case: DataCase | None, rate: float | None) -> float:
    """The sample rate in Hz: the mapping's, the case's, or the one that is given."""
    found = mapping.rate or (case.rate if case is not None else None) or rate or None
    expected = "the sample rate of the trajectories in Hz"
    remedy = "write rate = … in the mapping, or give the case"
    return float(given("mapping: rate", found, expected, remedy=remedy))


def _check_dense(log: Log, found: Parts, parts: Sequence[Piece], budget: Budget) -> None:
    """Refuse times in another unit, and times between which there are many more samples."""
    rate = found.rate
    samples = sum(each.stop - each.start for each in parts) * rate
    values, span = max(len(each.signal.times) for each in found.every), samples / rate
    remedy = 'check rate, and column and unit of [time], in the mapping; by = "gap" in [cut] '
    remedy += "leaves out pauses"
    # From 100 samples per value on, the times of the log or the sample rate are wrong.
    got, wrong = f"{values} values in {span:g} s", samples > 100 * max(values, 2)
    unit = misread_unit(span / max(values - 1, 1), 1 / rate) if wrong or samples < 1 else ""
    if unit:
        got += f", as if times in {unit} were read as s"
        remedy = f'name the column of the times time_{unit}, or write unit = "{unit}" in [time]'
        if unit not in NANOSECONDS:
            remedy = "write the times in s, or as dates with hours, minutes and seconds"
    expected = f"values about {1 / rate:g} s apart, the sample period"
    require(not (wrong or unit), log.name, expected=expected, got=got, remedy=remedy)
    budget.take(int(samples) * len(found.every) * 8)
