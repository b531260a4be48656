"""What records look like: a table of findings, and a small picture of each record that has some."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from retwin.data.quality.check import Checked
from retwin.data.quality.finding import NAMED, Finding, group_alike
from retwin.data.trajectories import Trajectories
from retwin.report.blocks import Table, tabulate, text_column
from retwin.report.figures.figure import Figure, Key, Line, Mark, Panel, Spans, record_panel

TITLE = "What your records look like"
"""The heading on the terminal and on pages."""
ROWS, PICTURES = 40, 12
"""Rows and pictures that are shown, at most."""
CLEAN = "Nothing was found that speaks against the records."
"""What is said where there is no finding."""
HEADS = ("record", "channel", "time", "finding")
"""The columns of the table."""


@dataclass(frozen=True)
class RecordsPart:
    """What the template `records.html.j2` shows: sentences, a table, and pictures."""

    sentences: Sequence[str]
    table: Table
    figure: Figure | None


def records_part(checked: Checked) -> RecordsPart:
    """The part of a page about records."""
    table = tabulate("Findings", [*map(text_column, HEADS)], finding_rows(checked.findings))
    sentences = checked.sentences + [CLEAN] * (not checked.findings)
    return RecordsPart(sentences, table, records_figure(checked))


def finding_rows(findings: Sequence[Finding]) -> list[tuple[str, str, str, str]]:
    """Record, channel, time and text of findings, and how many more there are.

    Those of one kind in one channel are a row, with the figures of the first; a few with times of
    their own are not.
    """
    rows = []
    for own in group_alike(findings):
        if len(own) == 1 or (own[0].time and len(own) <= NAMED):
            rows += [each.row for each in own]
        else:
            names = ", ".join(dict.fromkeys(each.row[0] for each in own))
            rows.append((names, own[0].channel, "", f"{own[0].kind}: for instance {own[0].text}"))
    more = len(rows) - ROWS
    return [*rows[:ROWS], (f"and {more} more", "", "", "")] if more > 0 else rows


def records_figure(checked: Checked) -> Figure | None:
    """A picture of each channel with findings, measured and nominal; None without any."""
    records = checked.records
    ids = {name: place for place, name in enumerate(records.ids.tolist())}
    places = list(
        dict.fromkeys(
            (ids[each.record], each.channel) for each in checked.findings if each.record in ids
        )
    )
    if not places:
        return None
    panels = [_panel(checked, *place) for place in places[:PICTURES]]
    keys = [Key("measured", "ink"), Key("where it is", "alarm", "bar")]
    if "healthy" in checked.explained or "faulty" in checked.explained:
        keys.insert(1, Key("twin that was given", "c0"))
    return Figure("records", panels, keys)


def _panel(checked: Checked, row: int, channel: str) -> Panel:
    """One output of one record over time; of a record as a whole, the one that moves most."""
    records, record = checked.records, str(checked.records.ids[row])
    length = int(records.lengths[row])
    times = np.arange(length) / records.rate
    marks: list[Mark] = [
        Spans([(each.start, each.end)], "alarm", 0.15)
        for each in checked.findings
        if each.record == record and each.channel == channel and each.end > each.start
    ]
    if channel in records.inputs.names:
        k, unit = records.inputs.names.index(channel), records.inputs.units
        marks.append(Line(times, records.commands[row, :length, k], "measured", "ink"))
        return record_panel(times, channel, unit[k], marks, f"{record}: {channel}", 180)
    k = records.outputs.names.index(channel) if channel else _moving(records, row)
    marks.append(Line(times, records.measured[row, :length, k], "measured", "ink", width=1.4))
    if checked.explained:
        marks.insert(0, Line(times, records.nominal[row, :length, k], "twin", "c0", alpha=0.7))
    name = records.outputs.names[k]
    return record_panel(times, name, records.outputs.units[k], marks, f"{record}: {name}", 180)


def _moving(records: Trajectories, row: int) -> int:
    spread = np.ptp(records.observed, axis=(0, 1))
    own = np.ptp(records.observed[row], axis=0)
    return int(np.argmax(np.divide(own, spread, out=np.zeros_like(own), where=spread > 0)))
