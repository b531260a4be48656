"""Files that pages contain: style, scripts, and the plot library with its licence beside it."""

from __future__ import annotations

from importlib import resources

from markupsafe import Markup


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
