"""The frame of all pages: style, scripts, filters, and the plot library with its licence."""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Iterable
from importlib import resources
from math import isfinite
from types import FunctionType
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from pydantic_core import from_json, to_json

from retwin._version import __version__
from retwin.report import labels
from retwin.report.figures.figure import Figure, Matrices
from retwin.report.figures.plotly_specs import figure_specs
from retwin.report.figures.style import CHROME, PALETTE, colour_of, symbol

LABELS = {name: each for name, each in vars(labels).items() if isinstance(each, FunctionType)}
"""The filters of all templates, under their own names."""


def environment(*, emulated: bool = False) -> Environment:
    """The templates, with what all pages have in common.

    Parameters
    ----------
    emulated : bool
        Whether a page says that its data are emulated.

    """
    made = Environment(
        loader=PackageLoader("retwin.report"),
        autoescape=lambda name: name is None or ".html" in name,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= LABELS
    made.filters["one_line"] = lambda text: Markup(" ").join(text.split())
    made.tests["finite"] = isfinite
    made.globals |= {
        "emulated": emulated,
        "anchors": set(),
        "colour_of": colour_of,
        "symbol": symbol,
        "colours": {**{f"c{place}": pair for place, pair in enumerate(PALETTE)}, **CHROME},
        "style": asset("page.css"),
        "script": asset("page.js"),
        "version": __version__,
    }
    return made


def render_page(
    templates: Environment, name: str, drawn: Iterable[Figure | Matrices], **values: Any
) -> str:
    """A page as text, which needs no other file and no network.

    Parameters
    ----------
    templates : Environment
        What `environment` returned.
    name : str
        The page's template, `NAME.html.j2`.
    drawn : iterable of Figure or Matrices
        The figures of the page.
    values : Any
        The variables of the template; `scripts` are the contents of further scripts by name.

    """
    specs = figure_specs(drawn)
    scripts = {key: script_json(value) for key, value in values.pop("scripts", {}).items()}
    return templates.get_template(f"{name}.html.j2").render(
        values,
        specs=script_json(specs),
        contents=scripts,
        scripts={key: asset(f"{key}.js") for key in scripts},
        plotly=plotly_js() if specs or "explorer" in scripts else "",
    )


def sentences(name: str, **values: Any) -> list[str]:
    """The texts of the template `NAME.txt.j2`, each of which begins with a dash."""
    text = environment().get_template(f"{name}.txt.j2").render(values)
    return [" ".join(each.split()) for each in re.split(r"^- ", text, flags=re.MULTILINE)[1:]]


def script_json(value: Any) -> Markup:
    """JSON for a script element, whatever its texts contain; numbers that it lacks are null."""
    plain = from_json(to_json(value, inf_nan_mode="null"))
    return htmlsafe_json_dumps(plain, ensure_ascii=False, separators=(",", ":"))


def asset(name: str, folder: str = "templates") -> Markup:
    """The text of a file in a folder of the report."""
    return Markup(resources.files(__package__).joinpath(folder, name).read_text(encoding="utf-8"))


def plotly_js() -> str:
    """The bundle of plotly.js with scatter plots in the plane and in space, deflated, in base 64.

    It is plotly.js-gl3d-dist-min 4.1.1 as npm has it: a third of the bytes of the whole library.
    """
    code = asset("plotly-gl3d.min.js", "plotly").encode()
    return base64.b64encode(zlib.compress(code, 9)).decode()
