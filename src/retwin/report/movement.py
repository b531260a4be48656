"""A trajectory taken apart: its movements, how late they are and how far off (figure 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Key, Panel, Plot
from retwin.report.plots import axis, caption, short, spec
from retwin.report.results import Results
from retwin.report.words import number, quantity

__all__ = ["Movement", "movement", "movement_plot"]

HEALTHY = "Healthy"


@dataclass(frozen=True)
class Movement:
    """One output of one trajectory over time (P,), and one of its movements.

    Attributes
    ----------
    nominal, observed: (P,) in `unit`, the latter NaN where nothing was measured.
    times: (M, 2), onset and end of the motion of every movement, in s.
    window: onset and end of the movement that is looked at; its steady part begins at `settle`.
    half: when the nominal and when the observed output are half way between where they rest, and
        where they are then; NaN for never.
    offset: mean observed minus nominal output of the steady part: TPE in this output.

    """

    trajectory: str
    output: str
    unit: str
    time: NDArray
    nominal: NDArray
    observed: NDArray
    times: NDArray
    window: tuple[float, float]
    settle: float
    half: tuple[tuple[float, float], tuple[float, float]]
    offset: float

    @property
    def delay(self) -> float:
        """How much later the observed output is half way: TDe, in s."""
        return self.half[1][0] - self.half[0][0]

    @property
    def words(self) -> tuple[str, str]:
        """What is read off both pictures: TDe, and TPE with its unit."""
        late = "TDe –" if math.isnan(self.delay) else f"TDe {number(1000 * self.delay, 0)} ms"
        return late, f"TPE {number(self.offset, 1)} {self.unit}".rstrip()


def movement(results: Results) -> Movement | None:
    """Of the healthy test trajectory that errs neither most nor least, its plainest movement.

    That is the one which stays furthest off beside its own reach, of those that move an output at
    least half as far as any does.
    """
    if results.portrait is None or "portrait/bands" not in results.arrays:
        return None
    nominal, observed, times = (
        results.arrays[f"portrait/{name}"] for name in ("nominal", "observed", "times")
    )
    labels = np.array(results.data.test.labels)
    error = np.sqrt(np.nanmean(np.square(observed - nominal), axis=(1, 2)))
    known = np.isfinite(observed).all(axis=(1, 2)) & np.isfinite(times).any(axis=(1, 2))
    usable = np.flatnonzero(known & (labels == HEALTHY if HEALTHY in labels else True))
    if not len(usable):
        return None
    place = usable[np.argsort(error[usable], kind="stable")[(len(usable) - 1) // 2]]
    rate = float(results.arrays["portrait/rate"])
    return _plainest(results, int(place), nominal[place], observed[place], times[place], rate)


def _plainest(
    results: Results, place: int, nominal: NDArray, observed: NDArray, times: NDArray, rate: float
) -> Movement | None:
    """The movement to be seen best of nominal and observed (P, d), times (M, 3)."""
    both = nominal, observed
    time = np.arange(len(nominal)) / rate
    times = times[np.isfinite(times).all(axis=1)]
    steady = [(time >= settle) & (time < end) for _, settle, end in times]
    whole = [m for m in range(1, len(times)) if steady[m].sum() > 1 and steady[m - 1].sum() > 1]
    if not whole:
        return None
    before, after = (
        np.array([[values[steady[m - back]].mean(axis=0) for m in whole] for values in both])
        for back in (1, 0)
    )
    steps, offsets = after[0] - before[0], after[1] - after[0]
    inside = [(time >= times[m, 0]) & (time <= times[m, 2]) for m in whole]
    reach = np.array([np.ptp(nominal[part], axis=0) for part in inside])
    wide = (np.abs(steps) >= 0.5 * np.abs(steps).max(axis=0)) & (reach > 0)
    plain = np.where(wide, np.abs(offsets) / np.where(reach > 0, reach, 1), -1)
    row, output = np.unravel_index(np.argmax(plain), plain.shape)
    onset, settle, end = times[whole[row]]
    factor, unit = quantity(results.outputs.units[output])
    ideal, real = (factor * values[:, output] for values in both)
    window = inside[row]
    levels = factor * (before + after)[:, row, output] / 2
    late = [
        _passage(time[window], values[window], level)
        for values, level in zip((ideal, real), levels, strict=True)
    ]
    return Movement(
        trajectory=results.data.test.ids[place],
        output=results.outputs.names[output],
        unit=unit,
        time=time,
        nominal=ideal,
        observed=real,
        times=times[:, :2],
        window=(float(onset), float(end)),
        settle=float(settle),
        half=((late[0], float(levels[0])), (late[1], float(levels[1]))),
        offset=factor * float(offsets[row, output]),
    )


def _passage(time: NDArray, values: NDArray, level: float) -> float:
    """When the values first pass the level, between samples along a straight line; NaN if never."""
    above = values >= level
    passed = np.flatnonzero(above[1:] != above[:-1])
    if not len(passed):
        return math.nan
    i = passed[0]
    share = (level - values[i]) / (values[i + 1] - values[i])
    return float(time[i] + share * (time[i + 1] - time[i]))


def movement_plot(results: Results, found: Movement) -> Plot:
    """The whole trajectory, one movement larger with TDe, and the gap in it with TPE."""
    keys = [Key("measured", "ink"), Key("nominal", "muted", "dot"), Key("in motion", "grid", "bar")]
    late, off = found.words
    text = (
        f"Output {found.output} of trajectory {found.trajectory}, the healthy one of middling "
        "error: all of it, one movement larger, and measured minus nominal output there. TDe is "
        "how much later the measured output is half way, TPE how far off it stays at rest, here "
        "in one output of several."
    )
    if results.published:
        text += " The paper’s figure 2."
    unit = f", {found.unit}" if found.unit else ""
    name = f"{found.output}{unit}"
    both = {"nominal": found.nominal, "measured": found.observed}
    whole = _picture(found, both, (found.time[0], found.time[-1]), name)
    larger = _picture(found, both, found.window, name)
    gap = {"measured": found.observed - found.nominal}
    rest = _picture(found, gap, found.window, f"{found.output} minus nominal{unit}")
    (begin, start), (end, stop) = found.half
    if math.isfinite(found.delay):
        _mark(larger, "TDe", (begin, start, end, stop), (64, 24))
    _mark(rest, "TPE", (found.settle, found.offset, found.window[1], found.offset), (0, -40))
    panels = [
        Panel(whole, f"{found.output} over the whole trajectory", "All movements"),
        Panel(larger, f"{found.output} over one movement, {late}", f"One movement: {late}"),
        Panel(rest, f"Gap over the same movement, {off}", f"The gap in it: {off}"),
    ]
    return Plot("movement", caption(results, text), panels, keys)


def _picture(
    found: Movement, lines: dict[str, NDArray], window: tuple[float, float], name: str
) -> dict[str, Any]:
    """Lines over a window of time, and where there is motion in it."""
    styles = {
        "nominal": {"color": "@muted", "width": 1.6, "dash": "dot"},
        "measured": {"color": "@ink", "width": 1.8},
    }
    inside = (found.time >= window[0]) & (found.time <= window[1])
    data = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": which,
            "x": short(found.time[inside]),
            "y": short(values[inside]),
            "line": styles[which],
            "hovertemplate": f"{which} %{{y:.4g}} at %{{x:.2f}} s<extra></extra>",
        }
        for which, values in lines.items()
    ]
    x = axis("time, s", range=[float(end) for end in window], nticks=6)
    made = spec(data, x, axis(name, nticks=6))
    made["layout"]["shapes"] = [
        {
            "type": "rect",
            "yref": "paper",
            "x0": max(start, float(window[0])),
            "x1": min(settle, float(window[1])),
            "y0": 0,
            "y1": 1,
            "fillcolor": "@grid",
            "line": {"width": 0},
            "layer": "below",
        }
        for start, settle in found.times.tolist()
        if settle > window[0] and start < window[1]
    ]
    return made


def _mark(
    picture: dict[str, Any],
    name: str,
    ends: tuple[float, float, float, float],
    beside: tuple[float, float],
) -> None:
    """A thick line from one end (x, y) to the other, and its name so many pixels beside it."""
    corners = dict(zip(("x0", "y0", "x1", "y1"), ends, strict=True))
    picture["layout"]["shapes"].append(
        {"type": "line", **corners, "line": {"color": "@c1", "width": 4}}
    )
    picture["layout"]["annotations"] = [
        {
            "text": f"<b>{name}</b>",
            "x": (ends[0] + ends[2]) / 2,
            "y": (ends[1] + ends[3]) / 2,
            "ax": beside[0],
            "ay": beside[1],
            "font": {"color": "@ink", "size": 14},
            "arrowcolor": "@ink",
            "arrowhead": 2,
            "arrowwidth": 1,
            "standoff": 5,
        }
    ]
