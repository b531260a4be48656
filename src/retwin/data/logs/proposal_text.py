"""The text of a proposed mapping.toml, with what is seen of the signals in comments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from retwin.data.io.assembly import DataCase
from retwin.data.logs.mapping import Mapping
from retwin.data.logs.signals import NO_STAMP, Log
from retwin.data.tables import TIMES
from retwin.serialisation.configs import toml_text

MAX_LISTED = 200
"""Signals that are listed in comments."""
SCHEMA = "https://retwin.readthedocs.io/mapping.schema.json"


@dataclass(frozen=True)
class Fact:
    """What is seen of a signal.

    Attributes
    ----------
    name, unit : str
        Of the signal.
    count : int
        Its values.
    rate : float
        Their median rate in Hz, 0 if there are less than two.
    longest : float
        The longest interval between two of them, in s.
    low, high : float
        Their range.
    constant : bool
        Whether all are equal, or there are none.

    """

    name: str
    unit: str
    count: int
    rate: float
    longest: float
    low: float
    high: float
    constant: bool


Chosen = dict[str, dict[str, "Fact | None"]]
"""By table of the mapping, and by channel: its signal, or None where it is to be named."""


def _comment(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)


def _seen(fact: Fact) -> str:
    unit = f" {fact.unit}" if fact.unit else ""
    return _comment(
        f"{fact.count} values, {fact.rate:.4g} Hz, {fact.low:.4g} to {fact.high:.4g}{unit}, "
        f"longest interval {fact.longest:.3g} s"
    )


def mapping_text(
    log: Log,
    draft: Mapping,
    chosen: Chosen,
    facts: Sequence[Fact],
    case: DataCase | None = None,
    delay: float | None = None,
) -> str:
    """The mapping.toml, with what is seen of the log in comments.

    Parameters
    ----------
    log : Log
        Its name, and what of it is not read.
    draft : Mapping
        What is proposed, without the channels that have no signal.
    chosen : dict
        The signals of all channels.
    facts : sequence of Fact
        What is seen of all signals.
    case : DataCase, optional
        Its units are those of the channels.
    delay : float, optional
        The median time in s from the header stamps of messages to their recording, if known.

    """
    cut, time = draft.cut, draft.time
    lines = [f"#:schema {SCHEMA}", f"# Proposed for {_comment(log.name)}; check it.", ""]
    lines += [
        f"rate = {draft.rate!r} # Hz",
        'label = "" # class of all trajectories, such as "Healthy"',
    ]
    lines += ["", "[time]"]
    column = time.column or next((n for n, why in log.skipped.items() if why == TIMES), "")
    given = {**time.model_dump(exclude_defaults=True), **({"column": column} if column else {})}
    lines += [f"{key} = {_value(value)}" for key, value in given.items()]
    if delay is not None:
        lines.append(f"# messages were recorded {delay:.3g} s after their header stamps (median)")
    lines += ["", "[cut]", f"by = {toml_text(cut.by)} # none, gap, trigger or length"]
    lines += [f"gap = {cut.gap!r} # s"] if cut.gap else []
    for table in chosen:
        for name, fact in chosen[table].items():
            lines += ["", f"[{table}.{toml_text(name)}]"]
            if fact is None:
                # The outputs that a mapping lacks are not compared by identify.
                more = ", or delete this table" if _spare(case, table) else ""
                lines += [f'signal = "" # none that changes has such a name: see below{more}']
                lines += _units_wanted(name, "", case)
                continue
            own = getattr(draft, table)[name]
            lines += [f"# {_seen(fact)}", f"signal = {toml_text(fact.name)}"]
            lines += _units_wanted(name, fact.unit, case)
            lines += [
                f"resample = {toml_text(own.resample or '')}",
                f"max_gap = {own.max_gap!r} # s",
            ]
    used = {fact.name for table in chosen.values() for fact in table.values() if fact}
    rest = [each for each in facts if each.name not in used]
    if rest or log.skipped:
        lines += ["", "# Not mapped:"]
    for each in rest[:MAX_LISTED]:
        what = f"constant, {each.low:g}" if each.constant and each.count else _seen(each)
        lines.append(f"#   {_comment(toml_text(each.name))}: {what}")
    others = [(n, why) for n, why in log.skipped.items() if why not in (TIMES, NO_STAMP)]
    lines += [f"#   {_comment(toml_text(n))}: {_comment(why)}" for n, why in others[:MAX_LISTED]]
    left = max(0, len(rest) - MAX_LISTED) + max(0, len(others) - MAX_LISTED)
    lines += [f"#   and {left} more"] if left else []
    return "\n".join(lines) + "\n"


def units_of(case: DataCase | None) -> dict[str, str]:
    """The unit of each channel of a case that has one."""
    some = () if case is None else (case.inputs, case.outputs)
    pairs = [pair for each in some for pair in zip(each.names, each.units, strict=True)]
    return {name: unit for name, unit in pairs if unit not in ("", "1")}


def _spare(case: DataCase | None, table: str) -> bool:
    """Whether a mapping may lack channels of a table: the outputs of a twin without a case."""
    return table == "outputs" and case is not None and not case.rate


def _units_wanted(channel: str, stated: str, case: DataCase | None) -> list[str]:
    """The unit of a channel, and a comment that asks for what neither log nor case states."""
    if case is None:
        return [] if stated else ['# unit = "…" # the log states none']
    unit = units_of(case).get(channel)
    if unit is None:
        lack = "the twin states none" if stated else "neither the log nor the twin states one"
        return [f'# from_unit = "…" # {lack}: no conversion without', '# unit = "…" # both']
    asked = [f'# from_unit = "…" # the log states none: taken as {_comment(unit)}']
    # Written out, since the unit of a case is not known to a command without it.
    return ([] if stated else asked) + [f"unit = {toml_text(unit)}"]


def _value(value: object) -> str:
    return toml_text(value) if isinstance(value, str) else repr(value)
