"""The sections of our docstrings as Markdown, for the API reference.

A section is a word underlined, and goes on to the next empty line. It has one entry for each line
that is not indented, `name, name: text`; what is indented belongs to the entry before.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

SECTION = re.compile(r"^(\w+)\n-{3,}\n((?:.+\n?)+)", re.MULTILINE)
ENTRY = re.compile(r"^(?=\S)", re.MULTILINE)
NAMES = re.compile(r"^([\w.*]+(?:, [\w.*]+)*): ")


class Sections(Extension):
    """Rewrites every docstring as it is read."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Called by griffe for each object of the package."""
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)


def markdown(docstring: str) -> str:
    """The docstring with its sections as bold words and lists."""
    return SECTION.sub(_section, docstring)


def _section(found: re.Match[str]) -> str:
    entries = [" ".join(entry.split()) for entry in ENTRY.split(found[2]) if entry.strip()]
    if all(NAMES.match(entry) for entry in entries):
        entries = ["- " + NAMES.sub(_names, entry) for entry in entries]
    return f"**{found[1]}**\n\n" + "\n".join(entries) + "\n\n"


def _names(found: re.Match[str]) -> str:
    return ", ".join(f"`{name}`" for name in found[1].split(", ")) + ": "
