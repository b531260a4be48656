"""`Finding`: something about a record that a user must know before it is used."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

NAMED = 4
"""Records that a sentence names, at most."""


@dataclass(frozen=True)
class Finding:
    """Something about a record that a user must know before it is used.

    Attributes
    ----------
    record : str
        The id of the record; "" for all of them.
    channel : str
        The command or the output; "" for the record as a whole.
    kind : str
        What it is, in a word or two.
    text : str
        The same with its figures, without record and channel.
    start, end : float
        When, in s from the begin of the record; both 0 where it is about all of it.
    severity : {"remark", "unusable"}
        Whether the record is used all the same.

    """

    record: str
    channel: str
    kind: str
    text: str
    start: float = 0.0
    end: float = 0.0
    severity: Literal["remark", "unusable"] = "remark"

    @property
    def time(self) -> str:
        """The time span in words, "" for the whole record."""
        return f"{self.start:.4g} to {self.end:.4g} s" if self.end > self.start else ""

    @property
    def row(self) -> tuple[str, str, str, str]:
        """Record, channel, time and text, for a table."""
        text = f"{self.kind}: {self.text}"
        return self.record or "all", self.channel, self.time, text


def group_alike(findings: Iterable[Finding]) -> list[list[Finding]]:
    """The findings of each kind in each channel, in the order of their first."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for each in findings:
        groups.setdefault((each.kind, each.channel), []).append(each)
    return list(groups.values())


def summarise(findings: Iterable[Finding]) -> list[str]:
    """A sentence for each kind of finding in each channel, with the records that have it."""
    made = []
    for own in group_alike(findings):
        kind, channel = own[0].kind, own[0].channel
        records = list(dict.fromkeys(each.record for each in own if each.record))
        more = f" and {len(records) - NAMED} more" if len(records) > NAMED else ""
        where = f" in {', '.join(records[:NAMED])}{more}" if records else ""
        time = f", {own[0].time}" if own[0].time and len(own) == 1 else ""
        such = "" if len(own) == 1 else "for instance "
        made.append(f"{channel or 'record'}{where}{time}, {kind}: {such}{own[0].text}")
    return made
