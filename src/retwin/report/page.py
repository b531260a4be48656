"""The page: sections put into one self-contained HTML file, and the figures beside it."""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from retwin.report import labels
from retwin.report.assets import asset, environment, plotly_js, script_json
from retwin.report.blocks import Section
from retwin.report.glossary import explained
from retwin.report.lights import RATE
from retwin.report.plotly_specs import figure_specs
from retwin.report.png import png, small
from retwin.report.sections import sections_of
from retwin.report.study import Study, read_study
from retwin.report.summary import picture, summary
from retwin.report.verdict import outcome_of, verdict
from retwin.scores.bootstrap import MIN_RECORDS
from retwin.scores.comparison import MIN_RUNS
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place

FIGURES = (
    "summary",
    "scores",
    "confusion",
    "roc",
    "reliability",
    "simulation",
    "autocorrelation",
    "crosscorrelation",
    "spectra",
    "amplitude",
    "overtime",
    "delta",
    "movement",
    "tde",
    "tpe",
    "noise",
    "z",
    "pit",
    "bands",
    "learning",
)
"""The files `figures/NAME.png`; of a second source `NAME-2.png`."""
PAGES = "https://retwin.readthedocs.io/en/latest/"
"""The documentation."""
DOCS = f"{PAGES}report.html"
"""The documentation of the page, to which each section links."""
NAMED: tuple[Callable[..., str], ...] = (labels.class_name, labels.counted, labels.duration)
NAMED += (labels.in_sentence, labels.mean_and_deviation, labels.number, labels.percent)
NAMED += (labels.percents, labels.reason, labels.sentence, labels.signed, labels.span)
NAMED += (labels.source_in_sentence, labels.source_name, labels.times)
"""Filters of templates under their own names."""
FILTERS = {each.__name__: each for each in NAMED} | {
    "metric": labels.metric_name,
    "outcome": outcome_of,
    "places": lambda values: labels.places(*values),
}
"""What templates apply to values; see `retwin.report.labels`."""


def write_report(folder: str | os.PathLike[str]) -> Path:
    """Make `report.html` and `figures/*.png` from the results of a study.

    Parameters
    ----------
    folder : path
        The folder of the study, to which the report goes as well.

    Returns
    -------
    Path
        The page; it needs no other file and no network.

    Raises
    ------
    InputError
        If results.json is missing, damaged or of another schema, or arrays.npz is damaged or does
        not agree with it.

    """
    study = read_study(folder)
    page, figures = Path(folder) / "report.html", Path(folder) / "figures"
    check_place(page)
    check_place(figures, folder=True)
    sections = sections_of(study)
    front = picture(study)
    shown = [each for section in sections for each in (*section.figures, *section.further)]
    images = {
        figure.name: png(figure, emulated=study.results.emulated)
        for figure in (*([front] if front else []), *shown)
    }
    for name, image in images.items():
        with write_atomically(figures / f"{name}.png") as part:
            part.write_bytes(image)
    for stale in figures.glob("*.png"):  # of an earlier report, whose results had them
        if stale.stem not in images and stale.stem.split("-")[0] in FIGURES:
            stale.unlink()
    with write_atomically(page) as part:
        part.write_text(render(study, sections, images), encoding="utf-8", newline="\n")
    return page


def render(study: Study, sections: Sequence[Section], images: Mapping[str, bytes]) -> str:
    """The page as text; `images` take the place of the figures where scripts do not run."""
    units, templates = study.results.outputs.units, environment()
    templates.filters |= FILTERS | {
        "scored": lambda value, metric: labels.scored(value, metric, units),
        "difference": lambda each: labels.difference(each, units)[0],
        "interval": lambda each: labels.difference(each, units)[1],
    }
    templates.globals |= {
        "results": study.results,
        "word": study.word,
        "healthy_only": "healthy " if study.results.classes else "",
        "min_runs": MIN_RUNS,
        "min_records": MIN_RECORDS,
        "anchors": {section.key for section in sections},
        "images": {name: base64.b64encode(small(data)).decode() for name, data in images.items()},
        "rate": RATE,
        "docs": DOCS,
        "corrections": f"{PAGES}corrections.html",
        "monitor": f"{PAGES}monitor.html",
    }
    bodies = {
        section.key: _dressed(
            templates.get_template(f"{section.key}.html.j2").render(section.values)
        )
        for section in sections
    }
    found = summary(study)
    front = [found["figure"]] if found and found["figure"] else []
    verdicts = verdict(study)
    first = (
        templates.get_template("summary.html.j2").render(summary=found, verdict=verdicts)
        if found
        else ""
    )
    specs = figure_specs([*front, *(figure for each in sections for figure in each.figures)])
    contents = {name: value for each in sections for name, value in each.scripts.items()}
    return templates.get_template("page.html.j2").render(
        sections=sections,
        bodies=bodies,
        verdict=verdicts,
        summary=_dressed(first),
        specs=script_json(specs),
        contents={name: script_json(content) for name, content in contents.items()},
        scripts={name: asset(f"{name}.js") for name in contents},
        plotly=plotly_js() if specs or "explorer" in contents else "",
    )


def _dressed(markup: str) -> Markup:
    """HTML with its terms explained, and no line break between a number and its percent sign."""
    return Markup(re.sub(r"(?<=\d) (?=%)", "\u00a0", explained(markup)))
