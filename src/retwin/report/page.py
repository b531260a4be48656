"""The page: sections put into one self-contained HTML file, and the figures beside it.

Terms are explained where they first occur in a section, by `templates/glossary.json`.
"""

from __future__ import annotations

import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from markupsafe import Markup

from retwin.report import labels
from retwin.report.assets import environment, render_page
from retwin.report.blocks import Section
from retwin.report.figures.figure import Figure, Matrices
from retwin.report.sections import sections_of
from retwin.report.study import Study, read_study
from retwin.report.summary import picture, summary
from retwin.report.verdict import headline, outcome_of, verdict
from retwin.scores.bootstrap import MIN_RECORDS
from retwin.scores.comparison import MIN_RUNS
from retwin.scores.uses import RATE
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place

UNTOUCHED = ("abbr", "button", "code", "h1", "h2", "h3", "option", "pre", "script", "select", "svg")
"""Elements whose text is left as it is."""


@cache
def _terms() -> dict[str, str]:
    folder = resources.files(__package__).joinpath("templates")
    return json.loads(folder.joinpath("glossary.json").read_text(encoding="utf-8"))


@cache
def _pattern() -> re.Pattern[str]:
    longest = sorted(_terms(), key=len, reverse=True)
    either = "|".join(
        f"[{term[0].upper()}{term[0].lower()}]{re.escape(term[1:])}" for term in longest
    )
    return re.compile(rf"(?<![\w-])({either})(?![\w-])")


def explained(markup: str) -> Markup:
    """HTML in which the first occurrence of each known term has its explanation.

    Parameters
    ----------
    markup : str
        The HTML of a section, well-formed and without comments.

    """
    seen: set[str] = set()
    lower = {term.lower(): term for term in _terms()}

    def wrapped(found: re.Match[str]) -> str:
        term = lower[found[0].lower()]
        if term in seen:
            return found[0]
        seen.add(term)
        return f'<abbr title="{html.escape(_terms()[term])}">{found[0]}</abbr>'

    parts, inside = [], 0
    for part in re.split(r"(<[^>]+>)", markup):
        if part.startswith("<"):
            name = re.match(r"</?(\w+)", part)
            if name and name[1] in UNTOUCHED and not part.endswith("/>"):
                inside += -1 if part.startswith("</") else 1
            parts.append(part)
        else:
            parts.append(part if inside else _pattern().sub(wrapped, part))
    return Markup("".join(parts))


FIGURES = (
    "summary",
    "scores",
    "records",
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
ANSWER = re.compile(r'<p class="verdict">(.*?)</p>', re.DOTALL)
"""The first sentence of a section, which stands beside its title, also while it is closed."""


def write_report(folder: str | os.PathLike[str], *, figures: bool = False) -> Path:
    """Make `report.html` from the results of a study, and `figures/*.png` if they are asked for.

    Parameters
    ----------
    folder : path
        The folder of the study, to which the report goes as well.
    figures : bool
        Whether the figures of the page are also written as files. Those of an earlier report are
        removed otherwise, since they may show other results.

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
    page, pictures = Path(folder) / "report.html", Path(folder) / "figures"
    check_place(page)
    check_place(pictures, folder=True)
    sections = sections_of(study)
    written: set[str] = set()
    if figures:
        from retwin.report.figures.png import png  # imports matplotlib, which takes a second

        front = picture(study)
        drawn: list[Figure | Matrices] = [front] if front else []
        drawn += [each for section in sections for each in (*section.figures, *section.further)]
        for figure in drawn:
            written.add(figure.name)
            with write_atomically(pictures / f"{figure.name}.png") as part:
                part.write_bytes(png(figure, emulated=study.results.emulated))
    for stale in pictures.glob("*.png"):
        if stale.stem not in written and stale.stem.split("-")[0] in FIGURES:
            stale.unlink()
    with write_atomically(page) as part:
        part.write_text(render(study, sections), encoding="utf-8", newline="\n")
    return page


def render(study: Study, sections: Sequence[Section]) -> str:
    """The page as text."""
    units = study.results.outputs.units
    templates = environment(emulated=study.results.emulated)
    templates.filters |= {
        "outcome_of": outcome_of,
        "scored": lambda value, metric: labels.scored(value, metric, units),
        "difference": lambda each: labels.difference(each, units)[0],
        "interval": lambda each: labels.difference(each, units)[1],
    }
    found = summary(study)
    pair = headline(study.results)
    front = [found["figure"]] if found and found["figure"] else []
    templates.globals |= {
        "results": study.results,
        "word": study.word,
        "healthy_only": "healthy " if study.results.classes else "",
        "min_runs": MIN_RUNS,
        "min_records": MIN_RECORDS,
        "anchors": {section.key for section in sections},
        "rate": RATE,
        "docs": DOCS,
        "verdict": verdict(study),
        "own": pair[0] if pair else next(reversed(study.results.sources)),
        "plain": pair[1] if pair else "",
    }

    def fill(name: str, values: Mapping[str, Any]) -> Markup:
        """A part with its terms explained, and no line break before a percent sign."""
        text = templates.get_template(f"{name}.html.j2").render(values)
        return Markup(re.sub(r"(?<=\d) (?=%)", "\u00a0", explained(text)))

    bodies = {section.key: fill(section.key, section.values) for section in sections}
    answers = {key: ANSWER.search(body) for key, body in bodies.items()}
    return render_page(
        templates,
        "page",
        [*front, *(figure for each in sections for figure in each.figures)],
        sections=sections,
        bodies={key: Markup(ANSWER.sub("", body, count=1)) for key, body in bodies.items()},
        answers={key: Markup(found[1]) for key, found in answers.items() if found},
        summary=fill("summary", {"summary": found}) if found else "",
        scripts={name: value for each in sections for name, value in each.scripts.items()},
    )
