"""Explanations of terms, where they first occur in a section of the page.

The explanations stand in `templates/glossary.json`.
"""

from __future__ import annotations

import html
import json
import re
from functools import cache
from importlib import resources

from markupsafe import Markup

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
