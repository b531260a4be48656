"""The picture of docs/report.md: the summary of a study's page, with numbered marks.

    python docs/figures/report_page.py demo/emulated

Takes the folder of a study, here that of `retwin demo` without real data, writes its page again,
and photographs it in Chromium (or the browser that RETWIN_BROWSER names). Writes
docs/images/report-page.png.
"""

from __future__ import annotations

import io
import os
import shutil
import sys
from pathlib import Path

from playwright.sync_api import Page, sync_playwright
from style import ORANGE, write

from retwin.report import write_report

MARKED = (
    "Use",
    "Answer",
    "of the original.",
    "Missing",
    "“Yes” and “no” need",
    "in a typical healthy run",
    "What was learned",
)
"""What is marked, from 1 on, by the text with which it begins or that it holds."""
SIZE = {"width": 1300, "height": 1850}
MARK = """(element, [number, colour]) => {
  const box = element.getBoundingClientRect(), mark = document.createElement("div");
  mark.textContent = number;
  mark.style = `position:absolute; left:${box.left + scrollX - 38}px; top:${box.top + scrollY}px;
    width:26px; height:26px; border-radius:50%; background:${colour}; color:white; z-index:9999;
    font:bold 15px/26px sans-serif; text-align:center`;
  document.body.append(mark);
}"""


def marked(page: Page) -> bytes:
    """The page's first screen with its marks, as PNG."""
    for number, text in enumerate(MARKED, 1):
        found = page.get_by_text(text).first
        found.wait_for()
        found.evaluate(MARK, [number, ORANGE])
    return page.screenshot()


def main(study: Path) -> None:
    """Write the page, and photograph it."""
    made = write_report(study)
    browser = shutil.which(os.environ.get("RETWIN_BROWSER") or "chromium")
    with sync_playwright() as play:
        started = play.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = started.new_page(viewport=SIZE, color_scheme="light")
        page.goto(made.resolve().as_uri())
        page.wait_for_load_state("networkidle")
        page.wait_for_timeout(3000)
        picture = marked(page)
        started.close()
    write("report-page", io.BytesIO(picture))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
