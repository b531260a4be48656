"""Words, numbers and colours: how sources, classes and values are shown everywhere alike."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.catalog import METRICS, SOURCES

__all__ = [
    "CHROME",
    "DASHES",
    "MAIN",
    "MANY",
    "PALETTE",
    "class_name",
    "counted",
    "dash",
    "duration",
    "in_sentence",
    "label",
    "mean_and_spread",
    "number",
    "order",
    "p_value",
    "quantity",
    "real_data",
    "signed",
    "slot",
    "source_name",
    "span",
    "symbol",
]

MANY = 5
"""Sources beyond which pictures and tables show the most telling ones only."""

# Okabe and Ito's colours, (light, dark), readable on the page's two backgrounds.
PALETTE = (
    ("#0068a8", "#62b6ee"),
    ("#d05a00", "#f29350"),
    ("#00875f", "#45c79b"),
    ("#b2508a", "#e29bc4"),
    ("#8a6d00", "#dcc04b"),
    ("#3f9cd0", "#a3d5f5"),
    ("#6b6b6b", "#b9b9b9"),
    ("#8b3a2b", "#d98f80"),
)
DASHES = ("solid", "dash", "dot", "dashdot")
# Everything else that has a colour: name to (light, dark).
CHROME = {
    "ink": ("#1b1f24", "#e7eaee"),
    "muted": ("#5a636e", "#a2abb6"),
    "grid": ("#e4e7eb", "#2d333b"),
    "rule": ("#c9ced6", "#434b56"),
    "paper": ("#ffffff", "#14181d"),
    "wash": ("#f5f6f8", "#1c2127"),
    "observed": ("#868f9a", "#727c89"),
    "go": ("#007a4d", "#3ecf8e"),
    "wait": ("#9a6700", "#e3b341"),
    "stop": ("#b3261e", "#ff8a80"),
    "alarm": ("#8f2d00", "#ffb37a"),
    "alarm_wash": ("#fff1e6", "#3a2312"),
}
REAL_DATA = {
    "none": "none",
    "timing": "timing of commands",
    "healthy": "healthy only",
    "unlabelled": "unlabelled, not of the test set",
    "transductive": "TEST OUTPUTS without labels (transductive)",
    "labelled": "labelled, some of each class",
}


MAIN = tuple(name for name, metric in METRICS.items() if metric.headline)
"""The scores that a study is summarised by."""


def source_name(source: str) -> str:
    """For people; an unknown source keeps its name."""
    return SOURCES[source].title if source in SOURCES else source


def in_sentence(name: str) -> str:
    """A source's or score's name in the middle of a sentence."""
    if name == SOURCES["dt"].title:
        return "the digital twin"
    return name if name[:2].isupper() else f"{name[:1].lower()}{name[1:]}"


def slot(source: str) -> int:
    """Place of the source's colour in `PALETTE`, the same in every report.

    There are more sources than colours that all eyes can tell apart, so `symbol` and `dash` tell
    those of one colour apart.
    """
    return _place(source) % len(PALETTE)


def symbol(source: str) -> str:
    """Of the source's points: a square where its colour has come round again."""
    return "circle" if _place(source) < len(PALETTE) else "square"


def dash(source: str) -> str:
    """Of the source's lines, one of `DASHES`; never that of another one of the same colour."""
    place = _place(source)
    return DASHES[(place + 2 * (place // len(PALETTE))) % len(DASHES)]


def _place(source: str) -> int:
    names = list(SOURCES)
    place = names.index(source) if source in SOURCES else sum(source.encode())
    return place % (2 * len(PALETTE))


def order(sources: Sequence[str]) -> list[str]:
    """Known sources first, from the plain twin to what was learned most; then the others."""
    known = {name: place for place, name in enumerate(SOURCES)}
    return sorted(sources, key=lambda name: known.get(name, len(known)))


def class_name(name: str) -> str:
    """Short: `Motor_1_Steady_state_error` is `M1 bias`."""
    short = re.sub(r"^([A-Za-z])[a-z]*_(\d+)_", r"\1\2 ", name)
    short = re.sub(r"steady_state_error$", "bias", short, flags=re.IGNORECASE).replace("_", " ")
    return re.sub(r"(?<= )\w+$", lambda word: word.group().lower(), short)


def label(key: str) -> str:
    """`surrogate_fit_s` as `Surrogate fit`."""
    words = re.sub(r"_s$", "", key).replace("_", " ").strip()
    return words[:1].upper() + words[1:]


def counted(count: int, what: str) -> str:
    """`1 trajectory`, `5 trajectories`, `3 runs`."""
    several = f"{what[:-1]}ies" if what.endswith("y") else f"{what}s"
    return f"{count} {what if count == 1 else several}"


def real_data(text: str | None) -> str:
    """Which real data a source saw."""
    return "not said" if text is None else REAL_DATA.get(text, text)


def number(value: float | None, digits: int = 3) -> str:
    """Fixed digits with a true minus; a dash for what is not there."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")


def signed(value: float, digits: int = 3) -> str:
    """With its sign, also when positive."""
    text = number(value, digits)
    return f"+{text}" if round(value, digits) > 0 else text


def span(interval: Sequence[float] | None, *, sign: bool = False) -> str:
    """`0.69 to 0.81`."""
    if interval is None:
        return "–"
    show = signed if sign else number
    return f"{show(interval[0])} to {show(interval[1])}"


def mean_and_spread(values: Sequence[float] | NDArray) -> str:
    """Mean ± standard deviation over runs; one run has no spread."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if len(finite) < 2:
        return number(float(finite[0]) if len(finite) else None)
    return f"{number(float(finite.mean()))} ± {number(float(finite.std(ddof=1)))}"


def p_value(p: float | None) -> str:
    """Three digits, or `< 0.001`."""
    return "< 0.001" if p is not None and p < 0.001 else number(p)


def duration(seconds: float | None) -> str:
    """In the unit that suits it."""
    if seconds is None or not math.isfinite(seconds):
        return "–"
    if seconds < 0.1:
        return f"{1000 * seconds:.2g} ms"
    if seconds < 120:
        return f"{seconds:.1f} s"
    if seconds < 7200:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"


def quantity(unit: str) -> tuple[float, str]:
    """Factor and unit to show lengths in millimetres, and counts of a unit in it; others stay.

    `m` is `(1000, "mm")`, and `0.24 deg`, a command's unit, is `(0.24, "deg")`.
    """
    if unit == "m":
        return 1000.0, "mm"
    counts = re.fullmatch(r"(\d*\.?\d+) (.+)", unit)
    return (float(counts[1]), counts[2]) if counts else (1.0, unit)
