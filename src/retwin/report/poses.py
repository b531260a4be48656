"""Poses in space: chains of points that move, nominal and observed, with a slider over time."""

from __future__ import annotations

import html
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Key, Panel, Plot, Section
from retwin.report.plots import FONT, caption
from retwin.report.results import Results
from retwin.report.words import class_name

__all__ = ["poses"]

NOMINAL, OBSERVED = "observed", "c0"
"""Colours of the page; the ghost is grey."""


def poses(results: Results) -> Section | None:
    """How the system stood and moved in a few test trajectories."""
    names = ("pose/nominal", "pose/observed", "pose/ids", "pose/rate")
    if not all(name in results.arrays for name in names) or not results.arrays[names[2]].size:
        return None
    nominal, observed, ids, rate = (results.arrays[name] for name in names)
    labels = dict(zip(results.data.test.ids, results.data.test.labels, strict=False))
    box = _box(np.concatenate([nominal, observed]))
    panels = [
        _panel(name, class_name(labels.get(name, "")), ideal, real, float(rate), box)
        for name, ideal, real in zip(map(str, ids), nominal, observed, strict=True)
    ]
    text = (
        "Poses of some test trajectories: drag to turn, move the slider through time. Lines are "
        "the paths of the tip. Only the outputs are measured: the observed pose is the nearest to "
        "the nominal one that explains them, an inference and not a measurement. Look at how far "
        "the two tips are apart, and when."
    )
    keys = [Key("nominal", NOMINAL), Key("observed", OBSERVED)]
    return Section("poses", "In space", [Plot("poses", caption(results, text), panels, keys)])


def _panel(
    name: str,
    title: str,
    nominal: NDArray,
    observed: NDArray,
    rate: float,
    box: tuple[NDArray, NDArray],
) -> Panel:
    """One trajectory: (T, points, 3) nominal and observed."""
    seconds = np.arange(len(nominal)) / rate
    apart = 1000 * np.linalg.norm(nominal[:, -1] - observed[:, -1], axis=1)
    # Begin where there is something to see, and not in a glitch.
    begin = int(np.argsort(apart)[round(0.9 * (len(apart) - 1))])
    data = [
        _path(nominal[:, -1], NOMINAL),
        _path(observed[:, -1], OBSERVED),
        {**_chain(nominal[begin], NOMINAL, 7, 0.55), "name": "nominal"},
        {**_chain(observed[begin], OBSERVED, 5, 1.0), "name": "observed"},
    ]
    spec = {
        "data": data,
        "layout": _layout(box, seconds, begin),
        "frames": _frames(nominal, observed),
    }
    note = f"{name}: the tips are {apart.mean():.0f} mm apart on average."
    alt = f"{title or name}: poses in space over {seconds[-1]:.0f} s"
    return Panel(spec, alt, title or name, note, height=420)


def _path(points: NDArray, colour: str) -> dict[str, Any]:
    return {
        **_through(points),
        "mode": "lines",
        "line": {"color": f"@{colour}", "width": 2},
        "hoverinfo": "skip",
    }


def _chain(points: NDArray, colour: str, width: int, opacity: float) -> dict[str, Any]:
    return {
        **_through(points),
        "mode": "lines+markers",
        "line": {"color": f"@{colour}", "width": width},
        "marker": {"color": f"@{colour}", "size": 0.8 * width, "line": {"width": 0}},
        "opacity": opacity,
        "hovertemplate": "%{x:.3f}, %{y:.3f}, %{z:.3f} m",
    }


def _through(points: NDArray) -> dict[str, Any]:
    """A trace through points, to the tenth of a millimetre."""
    places = np.round(points.astype(float), 4).T.tolist()
    return {"type": "scatter3d", **dict(zip("xyz", places, strict=True))}


def _frames(nominal: NDArray, observed: NDArray) -> list[dict[str, Any]]:
    """What moves, at every moment; the slider calls them by their place."""
    return [
        {"name": str(i), "data": [_through(n), _through(o)], "traces": [2, 3]}
        for i, (n, o) in enumerate(zip(nominal, observed, strict=True))
    ]


def _box(points: NDArray) -> tuple[NDArray, NDArray]:
    """Lowest and highest corner (3,) of a box around all points, with some air."""
    low, high = points.min(axis=(0, 1, 2)), points.max(axis=(0, 1, 2))
    air = 0.06 * (high - low).max()
    return low - air * np.array([1, 1, 0]), high + air


def _layout(box: tuple[NDArray, NDArray], seconds: NDArray, begin: int) -> dict[str, Any]:
    low, high = box
    scene: dict[str, Any] = {
        f"{axis}axis": {
            "range": [round(float(low[i]), 4), round(float(high[i]), 4)],
            "title": {"text": html.escape(f"{axis}, m"), "font": {"size": 11}},
            "tickfont": {"size": 10},
            "nticks": 5,
            "color": "@muted",
            "gridcolor": "@grid",
            "linecolor": "@rule",
            "zeroline": False,
            "showspikes": False,
            "showbackground": False,
        }
        for i, axis in enumerate("xyz")
    }
    # Plotly's own equal scaling goes by the data, which would differ from panel to panel.
    share = (high - low) / (high - low).max()
    scene["aspectmode"] = "manual"
    scene["aspectratio"] = {axis: round(float(share[i]), 4) for i, axis in enumerate("xyz")}
    scene["camera"] = {"eye": {"x": 1.44, "y": -1.57, "z": 0.58}, "center": {"z": -0.14}}
    return {
        "scene": scene,
        "font": {"family": FONT, "size": 13, "color": "@muted"},
        "paper_bgcolor": "rgba(0,0,0,0)",
        # Room for the tick labels of the leftmost axis.
        "margin": {"l": 24, "r": 8, "t": 0, "b": 0},
        "showlegend": False,
        "uirevision": "kept",
        "hoverlabel": {"font": {"family": FONT, "size": 13}},
        "sliders": [_slider(seconds, begin)],
        "updatemenus": [_buttons(float(seconds[1] - seconds[0]))],
    }


def _slider(seconds: NDArray, begin: int) -> dict[str, Any]:
    now = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}}
    now["transition"] = {"duration": 0}
    return {
        "active": begin,
        "steps": [
            {"label": f"{second:.1f}", "method": "animate", "args": [[str(i)], now]}
            for i, second in enumerate(seconds)
        ],
        "currentvalue": {"suffix": " s", "xanchor": "right", "font": {"size": 13, "color": "@ink"}},
        "x": 0.24,
        "len": 0.76,
        "pad": {"t": 0, "b": 8, "l": 8, "r": 8},
        "bgcolor": "@grid",
        "bordercolor": "@rule",
        "activebgcolor": "@c0",
        "ticklen": 0,
        "minorticklen": 0,
        "tickcolor": "@rule",
        "font": {"size": 1, "color": "rgba(0,0,0,0)"},
    }


def _buttons(step: float) -> dict[str, Any]:
    """Play, with `step` s between moments, and pause."""
    timing = {"frame": {"duration": 1000 * step, "redraw": True}, "transition": {"duration": 0}}
    go = {**timing, "mode": "immediate", "fromcurrent": True}
    stop = {"mode": "immediate", "frame": {"duration": 0, "redraw": False}}
    return {
        "type": "buttons",
        "direction": "right",
        "showactive": False,
        "buttons": [
            {"label": "▶", "method": "animate", "args": [None, go]},
            {"label": "❚❚", "method": "animate", "args": [[None], stop]},
        ],
        "x": 0,
        "y": 0,
        "xanchor": "left",
        "yanchor": "top",
        "pad": {"t": 14, "l": 0},
        "bgcolor": "@wash",
        "bordercolor": "@rule",
        "font": {"color": "@ink"},
    }
