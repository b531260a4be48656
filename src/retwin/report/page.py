"""The page: sections put into one self-contained HTML file, and the figures beside it."""

from __future__ import annotations

import base64
import json
import math
import os
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from retwin.report.blocks import Calculator, Explorer, Plot, Section
from retwin.report.claims import claims
from retwin.report.figures import FIGURES, draw_figures
from retwin.report.results import Results, read_results
from retwin.report.sections import SECTIONS
from retwin.report.verdict import verdict
from retwin.report.words import CHROME, PALETTE, counted, slot, symbol
from retwin.serialisation.files import write_atomically

__all__ = ["render", "write_report"]

EMULATED = "EMULATED data: no real measurements"


def write_report(folder: str | os.PathLike[str]) -> Path:
    """Make `report.html` and `figures/*.png` from `results.json` and `arrays.npz` of a study.

    Parameters
    ----------
    folder: that of the study, which the report goes to as well.

    Returns
    -------
    The page; it needs no other file and no network.

    Raises
    ------
    InputError: results.json is missing, damaged or of another schema, or arrays.npz is damaged.

    """
    results = read_results(folder)
    images = draw_figures(results)
    figures = Path(folder) / "figures"
    for name, image in images.items():
        with write_atomically(figures / f"{name}.png") as part:
            part.write_bytes(image)
    for stale in figures.glob("*.png"):  # from an earlier report whose results had it
        if stale.stem not in images and stale.stem.split("-")[0] in FIGURES:
            stale.unlink()
    page = Path(folder) / "report.html"
    with write_atomically(page) as part:
        part.write_text(render(results, images), encoding="utf-8", newline="\n")
    return page


def render(results: Results, images: dict[str, bytes]) -> str:
    """The page as text; `images` stand in for the plots where scripts do not run."""
    made = [section for make in SECTIONS if (section := make(results)) is not None]
    specs = _specs(made)
    blocks = [block for section in made for block in section.blocks]
    contents = {
        block.kind: Markup(_script_json(block.content))
        for block in blocks
        if isinstance(block, Explorer | Calculator)
    }
    environment = Environment(
        loader=FunctionLoader(_asset),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"slot": slot, "symbol": symbol}
    return environment.get_template("page.html.j2").render(
        title=results.title or results.case,
        anchors={section.key for section in made},
        subtitle=_subtitle(results),
        emulated=EMULATED if results.emulated else "",
        verdict=verdict(results),
        claims=claims(results),
        sections=made,
        colours={
            **{f"c{place}": pair for place, pair in enumerate(PALETTE)},
            **CHROME,
        },
        style=Markup(_asset("page.css")),
        script=Markup(_asset("page.js")),
        specs=Markup(_script_json(specs)),
        contents=contents,
        scripts={kind: Markup(_asset(f"{kind}.js")) for kind in contents},
        plotly=Markup(get_plotlyjs()) if specs or "explorer" in contents else "",
        images={name: base64.b64encode(data).decode() for name, data in images.items()},
    )


def _asset(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _specs(sections: Sequence[Section]) -> dict[str, Any]:
    """Plotly's data by the id of the element that shows them."""
    return {
        f"plot-{block.name}-{place}": {**panel.spec, "height": panel.height, "narrow": panel.narrow}
        for section in sections
        for block in section.blocks
        if isinstance(block, Plot)
        for place, panel in enumerate(block.panels)
    }


def _script_json(value: Any) -> str:
    """JSON that may stand inside a script element whatever its strings hold."""
    text = json.dumps(_finite(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _finite(value: Any) -> Any:
    """The same with null for numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _subtitle(results: Results) -> list[str]:
    """What was updated with which data, and how it was scored."""
    data, lines = results.data, []
    twin, calibration, test = data.twin, data.calibration, data.test
    word = "emulated" if results.emulated else "real"
    if twin.n:
        source = f" ({twin.name})" if twin.name else ""
        lines.append(f"A twin known by {counted(twin.n, 'trajectory')}{source}")
        if calibration.n:
            used = calibration.n if calibration.used is None else len(calibration.used)
            source = f" ({calibration.name})" if calibration.name else ""
            of = "" if used == calibration.n else f"{used} of "
            lines[-1] += (
                f", updated with {of}{counted(calibration.n, f'{word} trajectory')}{source}"
            )
        lines[-1] += "."
    if test.n or test.labels:
        source = f" ({test.name})" if test.name else ""
        size = test.n or len(test.labels)
        how = [f"Scored on {counted(size, f'{word} trajectory')}{source}"]
        how.append(counted(results.runs, "run"))
        if results.classifier:
            how.append(f"classifier {results.classifier.upper()}")
        if results.preset:
            how.append(f"preset {results.preset}")
        lines.append("; ".join(how) + ".")
    if data.protocol:
        lines.append(f"{data.protocol[0].upper()}{data.protocol[1:].rstrip('.')}.")
    return lines
