"""Files that pages contain: style, scripts, and the plot library with its licence beside it."""

from __future__ import annotations

from importlib import resources
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from pydantic_core import from_json, to_json

from retwin.report.style import CHROME, PALETTE, colour_of, symbol


def environment() -> Environment:
    """The templates, with what all pages have in common."""
    made = Environment(
        loader=PackageLoader("retwin.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["one_line"] = lambda text: Markup(" ").join(text.split())
    made.globals |= {
        "colour_of": colour_of,
        "symbol": symbol,
        "colours": {**{f"c{place}": pair for place, pair in enumerate(PALETTE)}, **CHROME},
        "style": asset("page.css"),
        "script": asset("page.js"),
    }
    return made


def script_json(value: Any) -> Markup:
    """JSON for a script element, whatever its texts contain; numbers that it lacks are null."""
    plain = from_json(to_json(value, inf_nan_mode="null"))
    return htmlsafe_json_dumps(plain, ensure_ascii=False, separators=(",", ":"))


def asset(name: str) -> Markup:
    """The text of a file in `templates`."""
    folder = resources.files(__package__).joinpath("templates")
    return Markup(folder.joinpath(name).read_text(encoding="utf-8"))


def plotly_js() -> Markup:
    """The bundle of plotly.js with scatter plots in the plane and in space.

    It is plotly.js-gl3d-dist-min 4.1.1 as npm has it: a third of the bytes of the whole library.
    """
    folder = resources.files(__package__).joinpath("plotly")
    return Markup(folder.joinpath("plotly-gl3d.min.js").read_text(encoding="utf-8"))
