"""Names, numbers and units as text, the same everywhere on the page and in the figures."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from retwin.catalog import METRICS, SOURCES, metrics_with
from retwin.results.sources import Comparison
from retwin.scores.bootstrap import MIN_RECORDS
from retwin.scores.comparison import MIN_RUNS

MANY = 5
"""Number of sources beyond which figures and tables show a selection."""
MAIN = tuple(name for name, metric in METRICS.items() if metric.headline)
"""The metrics that summarise a study."""
SELECTED = metrics_with("selected", simulated=False)
"""The metrics of diagnoses that are shown of many sources."""
NO_VERDICT = {
    "few runs": f"a verdict needs at least {MIN_RUNS} runs",
    "few records": f"a verdict over records needs at least {MIN_RECORDS} of them",
    "different data": "only one of the two uses labelled trajectories or outputs of the test set",
    None: "these results come from a version whose intervals do not contain the runs; "
    "run `retwin study` with this folder as --out again",
}
"""Why a pair has no verdict, by `retwin.results.sources.Comparison.no_verdict`."""
REAL_DATA = {
    "none": "none",
    "timing": "timing of commands",
    "healthy": "healthy only",
    "unlabelled": "unlabelled, not of the test set",
    "transductive": "TEST OUTPUTS without labels (transductive)",
    "labelled": "labelled, some of each class",
}


def with_role(sources: Iterable[str], role: Literal["plain", "surrogate", "updated"]) -> list[str]:
    """The sources of that role, see `retwin.catalog.SourceEntry`."""
    return [name for name in sources if name in SOURCES and SOURCES[name].role == role]


def source_name(source: str) -> str:
    """The source's title; an unknown source keeps its name."""
    return SOURCES[source].title if source in SOURCES else source


def source_in_sentence(source: str) -> str:
    """The source's title in the middle of a sentence; that of a twin or a model has an article."""
    text = in_sentence(source_name(source))
    if with_role([source], "surrogate"):
        text = text.replace(" only", " alone")  # "the surrogate only finds" would be ambiguous
    entry = SOURCES.get(source)
    return f"the {text}" if entry is not None and (entry.twin or entry.recorded) else text


def metric_name(metric: str) -> str:
    """The metric's title."""
    return METRICS[metric].title


def in_sentence(title: str) -> str:
    """A title in the middle of a sentence."""
    return title if title[:2].isupper() else f"{title[:1].lower()}{title[1:]}"


def sentence(text: str) -> str:
    """A text at the beginning of a sentence."""
    return f"{text[:1].upper()}{text[1:]}"


def order(sources: Iterable[str]) -> list[str]:
    """Sources in the catalog's order, then the unknown ones."""
    known = {name: place for place, name in enumerate(SOURCES)}
    return sorted(sources, key=lambda name: known.get(name, len(known)))


def class_name(name: str) -> str:
    """Short: `Motor_1_Steady_state_error` is `M1 bias`."""
    short = re.sub(r"^([A-Za-z])[a-z]*_(\d+)_", r"\1\2 ", name)
    short = re.sub(r"steady_state_error$", "bias", short, flags=re.IGNORECASE).replace("_", " ")
    return re.sub(r"(?<= )\w+$", lambda word: word.group().lower(), short)


def latent_names(name: str) -> tuple[str, str]:
    """Title of a component of z, and the quantity on its axis."""
    if name.startswith("delay"):
        return f"Delay{name[5:].replace('_', ' ')}", "delay"
    for start, title, what in (("offset_", "Offset", "offset"), ("noise_", "Noise", "noise")):
        if name.startswith(start):
            rest = name[len(start) :].replace("_", " ")
            return f"{title} {rest}", f"{what} {rest}"
    return name.replace("_", " "), name.replace("_", " ")


def learned_name(name: str) -> str:
    """`offset_motor_1` as `Offset, motor 1`; `missed` is the share of missed segments."""
    kind, _, rest = name.partition("_")
    titles = {"missed": "Missed segments", "noise": "Noise at rest"}
    title = titles.get(kind, kind[:1].upper() + kind[1:])
    return f"{title}, {rest.replace('_', ' ')}" if rest else title


def counted(count: int, what: str) -> str:
    """`1 trajectory`, `5 trajectories`, `3 runs`."""
    several = f"{what[:-1]}ies" if what.endswith("y") else f"{what}s"
    return f"{count} {what if count == 1 else several}"


def times(count: int) -> str:
    """`once`, `twice`, `3 times`."""
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def real_data(text: str | None, *, classes: bool = True) -> str:
    """The real data that a source learns from; a study without `classes` has no healthy ones."""
    if text == "healthy" and not classes:
        return "calibration records"
    return "not stated" if text is None else REAL_DATA.get(text, text)


def reason(comparison: Comparison) -> str:
    """Why a comparison has no verdict; "" where it has one."""
    return NO_VERDICT.get(comparison.no_verdict, "")


WIDE, NEAR = 0.01, 0.001
"""The width of an interval beyond which shares so near to 0 and 1 need no more digits."""


def number(value: float | None, digits: int | None = None) -> str:
    """With a true minus and so many `decimals`; a dash for what is not defined."""
    if value is None or not math.isfinite(value):
        return "–"
    digits = decimals(value) if digits is None else digits
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")


def decimals(*values: float) -> int:
    """Three decimals, and more where the largest value would have less than three digits left."""
    return max(3, _digits(values))


def places(values: Iterable[float]) -> int:
    """Decimals that leave three significant digits of the largest value, nine decimals at most."""
    return max(0, min(9, _digits(values)))


def _digits(values: Iterable[float]) -> int:
    """Decimals of the third significant digit of the largest value; three of 0."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    return 2 - math.floor(math.log10(largest)) if largest else 3


def significant(value: float, like: float | None = None) -> str:
    """A number with four digits, or with as many decimals as two digits of `like` have."""
    if not math.isfinite(value):
        return "–"
    digits = 1 - math.floor(math.log10(like)) if like and 0 < like < math.inf else 9
    form = ".4g" if digits > 8 or abs(value) >= 1e6 else f".{max(digits, 0)}f"
    return f"{value:{form}}".replace("-", "−")


def distinct(values: Iterable[float]) -> int:
    """Decimals that tell the values apart, from 3 to 9."""
    known = {value for value in values if math.isfinite(value)}
    enough = (d for d in range(3, 9) if len({f"{value:.{d}f}" for value in known}) == len(known))
    return next(enough, 9)


def percent(share: float | None, digits: int = 0) -> str:
    """A share in percent; 100 % and 0 % only where it is exactly so."""
    if share is None or not math.isfinite(share):
        return "–"
    text = number(100 * share, digits)
    if (share != 1 and text == number(100, digits)) or (share != 0 and text == number(0, digits)):
        return percent(share, digits + 1) if digits < 3 else text + " %"
    return f"{text} %"


def percents(interval: Sequence[float] | None) -> str:
    """`58 to 91 %`; the ends of a wide one are rounded outwards within 0.1 % of 0 and 100 %."""
    if interval is None:
        return "–"
    low, high = interval
    if high - low > WIDE:
        low, high = (0.0 if 0 < low < NEAR else low), (1.0 if 1 - NEAR < high < 1 else high)
    return f"{percent(low).removesuffix(' %')} to {percent(high)}"


def signed(value: float, digits: int | None = None) -> str:
    """With its sign, also when positive."""
    digits = decimals(value) if digits is None else digits
    text = number(value, digits)
    return f"+{text}" if round(value, digits) > 0 else text


def span(interval: Sequence[float] | None, digits: int | None = None, *, sign: bool = False) -> str:
    """`0.69 to 0.81`."""
    if interval is None:
        return "–"
    digits = decimals(*interval) if digits is None else digits
    show = signed if sign else number
    return f"{show(interval[0], digits)} to {show(interval[1], digits)}"


def mean_and_deviation(values: Sequence[float] | NDArray) -> str:
    """Mean ± standard deviation over runs; the value alone of one run."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if len(finite) < 2:
        return number(float(finite[0]), decimals(finite[0])) if len(finite) else number(None)
    mean, digits = float(finite.mean()), decimals(finite.mean())
    return f"{number(mean, digits)} ± {number(float(finite.std(ddof=1)), digits)}"


def p_value(p: float | None) -> str:
    """Three digits, or `< 0.001`."""
    return "< 0.001" if p is not None and p < 0.001 else number(p, 3)


def duration(seconds: float | None) -> str:
    """Seconds in the unit that suits them."""
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
    """Factor and unit in which values are shown.

    Lengths are in millimetres, `m` is `(1000, "mm")`, and counts of a unit are in that unit,
    `0.24 deg` is `(0.24, "deg")`.
    """
    if unit == "m":
        return 1000.0, "mm"
    counts = re.fullmatch(r"(\d*\.?\d+) (.+)", unit)
    return (float(counts[1]), counts[2]) if counts else (1.0, unit)


def quantities(units: Sequence[str], count: int) -> list[tuple[float, str]]:
    """The factor and the unit of each of so many channels, whose last ones may state no unit."""
    return [quantity(unit) for unit in [*units, *[""] * count][:count]]


def metric_quantity(metric: str, units: Sequence[str]) -> tuple[float, str]:
    """Factor and unit in which a score is shown, of a study whose outputs have these units.

    Scores in the unit of the outputs exist only where all outputs have the same.
    """
    known = METRICS.get(metric)
    return quantity(units[0]) if known and known.unit == "output" and units else (1.0, "")


def scored(value: float, metric: str, units: Sequence[str]) -> str:
    """`0.892`, or `4.90 mm` of a score that has a unit."""
    factor, unit = metric_quantity(metric, units)
    return behind(number(factor * value), unit)


def difference(each: Comparison, units: Sequence[str]) -> tuple[str, str]:
    """The difference of a comparison and its interval, with the unit that they have."""
    factor, unit = metric_quantity(each.metric, units)
    ends = None if each.interval is None else [factor * end for end in each.interval]
    shown = decimals(factor * each.mean_diff, *(ends or ()))
    interval = span(ends, shown, sign=True)
    return (
        behind(signed(factor * each.mean_diff, shown), unit),
        interval if ends is None else behind(interval, unit),
    )


def shown_unit(unit: str) -> str:
    """The unit; "" for that of a plain number."""
    return "" if unit == "1" else unit


def behind(text: str, unit: str) -> str:
    """The text with the unit behind it."""
    return f"{text} {shown_unit(unit)}".rstrip()


def with_unit(title: str, unit: str) -> str:
    """`CRPS x, mm`; the title alone where there is no unit."""
    return f"{title}, {unit}" if unit else title
