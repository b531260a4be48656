"""Test records beside what sources simulate from their commands alone."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Key, Panel, Plot, Section
from retwin.report.plots import axis, caption, short, spec
from retwin.report.results import Results
from retwin.report.words import dash, order, quantity, slot, source_name

__all__ = ["Record", "records", "shown_sources", "simulation"]

SHOWN = 2
"""Records at most that the page draws."""


@dataclass(frozen=True)
class Record:
    """One output of one test record: measured (T,), and of each source its mean and its bands.

    `bands` (5, T) are of the one source that is shown with them, None where none has any.
    """

    name: str
    output: str
    unit: str
    time: NDArray
    observed: NDArray
    means: dict[str, NDArray]
    bands: NDArray | None
    banded: str


def shown_sources(results: Results) -> list[str]:
    """The plain twin and the source that errs least, and between them the one without chance."""
    known = [name for name in order(list(results.sources)) if _mean(results, name) is not None]
    if not known:
        return []
    ranked = sorted(known, key=lambda name: results.sources[name].mean("nrmse"))
    plain = [name for name in ranked[1:] if f"simulation/{name}/bands" not in results.arrays]
    return list(dict.fromkeys([known[0], *plain[:1], _banded(results, ranked)]))


def _banded(results: Results, ranked: Sequence[str]) -> str:
    """Of sources from best to worst the first with bands, else the first."""
    found = [name for name in ranked if f"simulation/{name}/bands" in results.arrays]
    return (found or list(ranked))[0]


def _mean(results: Results, source: str) -> NDArray | None:
    return results.arrays.get(f"simulation/{source}/mean")


def records(results: Results) -> list[Record]:
    """The first test records, each with all of its outputs."""
    sources = shown_sources(results)
    measured = results.arrays.get("simulation/observed")
    if not sources or measured is None:
        return []
    bands = results.arrays.get(f"simulation/{sources[-1]}/bands")
    rate = float(results.arrays["simulation/rate"])
    names = results.arrays["simulation/ids"].tolist()
    units = [*results.outputs.units, *[""] * measured.shape[2]]
    titles = [*results.outputs.names, *(f"output {c + 1}" for c in range(measured.shape[2]))]
    found = []
    for i in range(min(SHOWN, len(measured))):
        for c in range(measured.shape[2]):
            factor, unit = quantity(units[c])
            means = {name: factor * results.arrays[f"simulation/{name}/mean"] for name in sources}
            found.append(
                Record(
                    str(names[i]),
                    titles[c],
                    unit,
                    np.arange(measured.shape[1]) / rate,
                    factor * measured[i, :, c],
                    {name: mean[i, :, c] for name, mean in means.items()},
                    None if bands is None else factor * bands[i, :, :, c],
                    sources[-1],
                )
            )
    return found


def simulation(results: Results) -> Section | None:
    """What was measured, what is simulated, and the error below."""
    found = records(results)
    if not found:
        return None
    sources = shown_sources(results)
    keys = [Key("measured", "ink")]
    keys += [Key(source_name(name), f"c{slot(name)}", dash(name)) for name in sources]
    if found[0].bands is not None:
        text = f"90 % and 50 % of the draws: {source_name(sources[-1])}"
        keys.append(Key(text, f"c{slot(sources[-1])}", "bar"))
    panels = [_panel(each) for each in found]
    text = (
        "Test records, simulated from their commands alone: no measured output is used, at no "
        "sample. Below, the error: the mean of the draws minus what was measured. Where bands are "
        "drawn, nine tenths of the measured line should lie in the light one. First run."
    )
    plot = Plot("simulation", caption(results, text), panels, keys)
    return Section("simulation", "Simulation", [plot])


def _panel(each: Record) -> Panel:
    """Outputs above, errors below, on one axis of time."""
    time = short(each.time)
    data: list[dict[str, Any]] = []
    for name, low, high, alpha in (("90 %", 0, 4, 0.2), ("50 %", 1, 3, 0.35)):
        if each.bands is not None:
            data.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": name,
                    "x": time + time[::-1],
                    "y": short(each.bands[high]) + short(each.bands[low])[::-1],
                    "fill": "toself",
                    "fillcolor": f"@c{slot(each.banded)}/{alpha}",
                    "line": {"width": 0},
                    "hoverinfo": "skip",
                }
            )
    data += [_line(name, time, mean) for name, mean in each.means.items()]
    data.append(_measured(time, each.observed))
    data += [
        {**_line(name, time, mean - each.observed), "yaxis": "y2"}
        for name, mean in each.means.items()
    ]
    unit = f", {each.unit}" if each.unit else ""
    x = axis("time, s", range=[time[0], time[-1]], nticks=8, anchor="y2")
    made = spec(data, x, axis(f"{each.output}{unit}", nticks=6, domain=[0.38, 1]))
    below = axis(f"error{unit}", nticks=5, domain=[0, 0.3], zeroline=True, zerolinecolor="@rule")
    made["layout"]["yaxis2"] = below
    alt = f"{each.output} of record {each.name}, measured and simulated, and the error"
    return Panel(made, alt, f"{each.output} ({each.name})", height=480)


def _line(source: str, time: list[float], values: NDArray) -> dict[str, Any]:
    name = html.escape(source_name(source), quote=False)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": time,
        "y": short(values),
        "line": {"color": f"@c{slot(source)}", "width": 1.6, "dash": dash(source)},
        "hovertemplate": f"{name}<br>%{{y:.3g}} at %{{x:.4g}} s<extra></extra>",
    }


def _measured(time: list[float], values: NDArray) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines",
        "name": "measured",
        "x": time,
        "y": short(values),
        "line": {"color": "@ink", "width": 1.3},
        "hovertemplate": "measured<br>%{y:.3g} at %{x:.4g} s<extra></extra>",
    }
