"""Conversion of units, by pint."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import needs_extra, require
from retwin.errors import InputError, brief

SAFE = re.compile(r"[\w°µμΩ%²³⁰¹⁴-⁹⁻·*/^ ().+-]*")
POWER_OF_NUMBER = re.compile(r"[\d)]\s*(\*\*|\^)")
"""Powers of numbers and of brackets, whose evaluation may never end; units need none."""
NONE = frozenset({"", "1", "-", "none", "unitless", "dimensionless"})
"""Units of what has no unit."""
SPELT = {
    "%": "percent",
    "pct": "percent",
    "%RH": "percent",
    "% RH": "percent",
    "C": "degC",
    "℃": "degC",
    "F": "degF",
    "°": "deg",
    "1/min": "rpm",
    "U/min": "rpm",
    "min-1": "rpm",
    "min^-1": "rpm",
    "RPM": "rpm",
    "kph": "km/h",
    "lpm": "liter/min",
    "gpm": "gallon/min",
    "BAR": "bar",
    "PSI": "psi",
    "Ohm": "ohm",
}
"""Spellings in logs, and those of pint. C is a temperature there, no charge."""
RULES = tuple(
    (re.compile(pattern), spelt)
    for pattern, spelt in (
        (r"(?<=[^\W\d_])²", "2"),
        (r"(?<=[^\W\d_])³", "3"),
        (r"(?i)(?<!\w)(?:deg(?:rees?)?[ ._]?|° ?)c(?!\w)", "degC"),
        (r"(?i)(?<!\w)(?:deg(?:rees?)?[ ._]?|° ?)f(?!\w)", "degF"),
        (r"(?<!\w)([hkmM]?(?:bar|Pa)|psi) ?(?:\(g\)|g)(?!\w)", r"\1g"),
        (r"(?<!\w)([hkmM]?(?:bar|Pa)|psi) ?(?:\(a\)|\(?abs\)?|(?<! )a)(?!\w)", r"\1"),
        (r"(?<![^\W\d_])([µucdkm]?m|in|ft|s|min|h|K)(-?[1-4])(?!\w)", r"\1^\2"),
    )
)
"""Patterns of spellings within a unit, as in `W/(m2 °C)` and `bar(g)`, and how pint spells them."""
DEFINITIONS = (
    "newton_meter = newton * meter = Nm",
    "reactive_volt_ampere = volt * ampere = var = VAr",
    "normal_cubic_meter = [normal_volume] = Nm3",
    "normal_liter = 0.001 * normal_cubic_meter = Nl = NL",
    "standard_cubic_meter = [standard_volume] = Sm3",
    "gauge_pascal = [gauge_pressure] = Pag",
    "gauge_bar = 1e5 * gauge_pascal = barg",
    "gauge_psi = 6894.757293168361 * gauge_pascal = psig",
)
"""Units that pint lacks. A normal volume stands for an amount of gas and a gauge pressure is one
above that of the air, so that neither is converted to a volume or a pressure."""

ENDING = re.compile(
    r"_((?:um|mm|cm|km|m?rad|deg[CF]?|rpm|k?Hz|[um]s|Nm|kN|[hkM]?Pa|m?bar|m[VA]|kWh?|kg|percent|pct)"
    r"(?:_(?:s|s2|h|min))?|[mlg]_(?:s|s2|h|min)|mps|kmh)$"
)
"""How names of signals end that state a unit, as `position_mm` and `speed_m_s`.

A single letter is none: `phase_A` and `torque_m` are no currents and lengths.
"""
SHORT = {"mps": "m/s", "kmh": "km/h", "Nm": "N m", "pct": "%"}


def unit_in_name(name: str) -> str:
    """The unit with which the name of a signal ends, after an underscore; "" if with none."""
    found = ENDING.search(name)
    if found is None:
        return ""
    unit, _, per = found[1].partition("_")
    return SHORT.get(unit, unit) + (f"/{per.replace('s2', 's^2')}" if per else "")


def same_unit(first: str, second: str) -> bool:
    """Whether two units are the same text, or both stand for no unit."""
    return first == second or (first.lower() in NONE and second.lower() in NONE)


def compatible(first: str, second: str) -> bool:
    """Whether values can be converted from one unit to the other; False for unknown units."""
    try:
        one, other = _unit(first), _unit(second)
        same = _angular(one) == _angular(other)
        return same_unit(first, second) or (same and bool(one.is_compatible_with(other)))
    except Exception:  # of pint, whose parser raises many kinds
        return False


def converted(values: NDArray, source: str, target: str, where: str) -> NDArray:
    """Values (n,) in a unit as those in another one.

    Raises
    ------
    InputError
        A unit is not known, or they measure different quantities. The message names `where`.

    """
    if same_unit(source, target):
        return values
    remedy = (
        "set from_unit = … or a factor, scale = …, of its channel in a mapping file, which retwin "
        "data map proposes and --mapping reads"
    )
    try:
        first, second = _unit(source), _unit(target)
        if _angular(first) != _angular(second):
            raise ValueError("one is an angle, the other one is not: is a turn 1 or 2π?")
        ends = _registry().Quantity(np.array([0.0, 1.0, 2.0]), first).to(second).magnitude
    except InputError:
        raise
    except Exception as error:
        expected = f"a unit that is converted to {target!r}"
        got = f"{source!r} ({type(error).__name__}: {brief(error)})"
        raise InputError(where, expected=expected, got=got, remedy=remedy) from None
    offset, slope = float(ends[0]), float(ends[1] - ends[0])
    # Every unit of pint that is no logarithm is a line; the others are refused.
    line = np.isclose(ends[2], offset + 2 * slope, rtol=1e-9, atol=1e-300)
    expected = f"a unit that is converted to {target!r}, and no logarithm"
    got = repr(source)
    require(
        np.isfinite(ends).all() and slope and line, where, expected=expected, got=got, remedy=remedy
    )
    return offset + slope * values


def _unit(text: str) -> Any:
    text = SPELT.get(text.strip(), text.strip())
    for pattern, spelt in RULES:
        text = pattern.sub(spelt, text)
    # Characters of a unit at most.
    if len(text) > 40 or not SAFE.fullmatch(text) or POWER_OF_NUMBER.search(text):
        raise ValueError("what is no unit")
    return _registry().Unit("" if text.lower() in NONE else text)


def _angular(unit: Any) -> bool:
    """Whether a unit counts angles: pint takes 1 rad for 1, so that 1 rpm would be 0.1 Hz."""
    return "radian" in str(_registry().Quantity(1.0, unit).to_root_units().units)


@cache
def _registry() -> Any:
    pint = needs_extra("pint", "logs", "converts units")
    made = pint.UnitRegistry(autoconvert_offset_to_baseunit=True, on_redefinition="ignore")
    for each in DEFINITIONS:
        made.define(each)
    return made
