"""Colours, symbols and dashes of the page and of the figures."""

from __future__ import annotations

from retwin.catalog import SOURCES

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
"""Okabe and Ito's colours (light, dark) at a contrast of 3 or more with the page's background."""
SYMBOLS = ("circle", "square", "diamond")
"""Symbols of points, by plotly's names."""
DASHES = ("solid", "dash", "dot", "dashdot")
"""Line styles, by plotly's names."""
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
"""All other colours (light, dark) by name."""


def colour_index(source: str) -> int:
    """Index in `PALETTE` of the source's colour, the same in every report.

    There are more sources than distinguishable colours, so `symbol` and `dash` distinguish those
    of one colour.
    """
    return _place(source) % len(PALETTE)


def colour_of(source: str) -> str:
    """The name of the source's colour, as marks and the page's style sheet take it."""
    return f"c{colour_index(source)}"


def symbol(source: str) -> str:
    """The symbol of the source's points, another one in each cycle of the palette."""
    return SYMBOLS[_place(source) // len(PALETTE)]


def dash(source: str) -> str:
    """The style of the source's lines, which differs from that of others of the same colour."""
    place = _place(source)
    return DASHES[(place + place // len(PALETTE)) % len(DASHES)]


def hexadecimal(colour: str) -> str:
    """The light colour of that name, as #rrggbb."""
    return CHROME[colour][0] if colour in CHROME else PALETTE[int(colour[1:])][0]


def _place(source: str) -> int:
    names = list(SOURCES)
    place = names.index(source) if source in SOURCES else sum(source.encode())
    return place % (len(SYMBOLS) * len(PALETTE))
