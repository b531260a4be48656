"""Python blocks of pages that run when the site is built, with what they print and draw below them.

The files of the pages hold plain blocks, so that they read well elsewhere and the tests run them.
"""

from __future__ import annotations

import re
import tempfile

__all__ = ["executed"]

PYTHON = re.compile(r"^```python\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
SHOW = """
from base64 import b64encode
from pathlib import Path

picture = b64encode(Path("{name}").read_bytes()).decode()
print(f'<img alt="The figure that this code saves" src="data:image/png;base64,{{picture}}">')
"""
"""What shows a file that a block has saved."""
SAVED = re.compile(r'savefig\("([\w-]+\.png)"')


def executed(markdown: str, session: str) -> str:
    """The page with the marks by which markdown-exec runs its blocks, in an empty folder.

    Parameters
    ----------
    markdown : str
        The page.
    session : str
        The name of a session: its blocks share their variables and their folder, on several pages
        too, in the order of the pages.

    """
    if session not in _FOLDERS:
        _FOLDERS[session] = tempfile.TemporaryDirectory(prefix="docs-", ignore_cleanup_errors=True)
    folder = _FOLDERS[session]

    def marked(found: re.Match[str]) -> str:
        code = found[1]
        marks = f'session="{session}" workdir="{folder.name}"'
        if "print(" in code:
            parts = [f'```python exec="on" source="above" result="text" {marks}\n{code}```\n']
        else:  # without a box for what it prints
            parts = [found[0], f'\n```python exec="on" {marks}\n{code}```\n']
        for name in SAVED.findall(code):
            shown = SHOW.format(name=name)
            parts.append(f'\n```python exec="on" html="on" {marks}\n{shown}```\n')
        return "".join(parts)

    return PYTHON.sub(marked, markdown)


_FOLDERS: dict[str, tempfile.TemporaryDirectory[str]] = {}
"""Folders of the sessions, which are removed when the build ends."""
