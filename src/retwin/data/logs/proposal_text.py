"""The text of a proposed mapping.toml, with what is seen of the signals in comments."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib import resources

from jinja2 import Environment, StrictUndefined

from retwin.data.io.assembly import DataCase
from retwin.data.logs.mapping import Mapping
from retwin.data.logs.signals import NO_STAMP, Log
from retwin.data.tables import TIMES
from retwin.serialisation.configs import toml_text


@dataclass(frozen=True)
class Fact:
    """What is seen of a signal.

    Attributes
    ----------
    name, unit : str
        Of the signal; where the log states no unit, that in which its name ends.
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


def _describe(fact: Fact) -> str:
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
    by_unit: Collection[str] = (),
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
    by_unit : collection of str
        Channels whose signal was chosen by its unit alone.

    """
    time = draft.time
    column = time.column or next((n for n, why in log.skipped.items() if why == TIMES), "")
    used = {fact.name for table in chosen.values() for fact in table.values() if fact}
    made = Environment(
        undefined=StrictUndefined, autoescape=False, trim_blocks=True, lstrip_blocks=True
    )
    made.filters |= {"comment": _comment, "seen": _describe, "toml": _value}
    template = resources.files(__package__).joinpath("mapping.toml.j2").read_text("utf-8")
    # Signals that are listed in comments.
    text = made.from_string(template).render(
        log=log,
        draft=draft,
        chosen=chosen,
        case=case,
        units=units_of(case),
        # A mapping may lack the outputs of a twin without a case.
        spare=case is not None and not case.rate,
        time=time.model_dump(exclude_defaults=True) | ({"column": column} if column else {}),
        delay=delay,
        by_unit=by_unit,
        rest=[each for each in facts if each.name not in used],
        skipped=[pair for pair in log.skipped.items() if pair[1] not in (TIMES, NO_STAMP)],
        listed=200,
    )
    # A line that holds a dash is an empty one; others were left by the template.
    lines = filter(None, text.split("\n"))
    return "\n".join("" if line == "-" else line for line in lines) + "\n"


def units_of(case: DataCase | None) -> dict[str, str]:
    """The unit of each channel of a case that has one."""
    some = () if case is None else (case.inputs, case.outputs)
    pairs = [pair for each in some for pair in zip(each.names, each.units, strict=True)]
    return {name: unit for name, unit in pairs if unit not in ("", "1")}


def _value(value: object) -> str:
    return toml_text(value) if isinstance(value, str) else repr(value)
