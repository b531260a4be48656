"""The tutorial as a notebook: its prose and its Python blocks, in their order.

    python docs/scripts/notebook.py tutorial.ipynb

Shell blocks stay text: what they do is not needed by the Python that follows.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

PAGE = Path(__file__).parents[1] / "tutorial.md"
PYTHON = re.compile(r"^```python\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


def notebook(page: Path = PAGE) -> nbformat.NotebookNode:
    """Every Python block of the page as a cell, and what stands between them as text."""
    parts = PYTHON.split(page.read_text("utf-8"))
    cells = []
    for place, part in enumerate(parts):
        if not part.strip():
            continue
        make = new_code_cell if place % 2 else new_markdown_cell
        cells.append(make(part.strip(), id=f"cell-{place}"))  # an id of its own: same bytes
    return new_notebook(
        cells=cells,
        metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}},
    )


if __name__ == "__main__":
    nbformat.write(notebook(), sys.argv[1])
