"""The picture of docs/monitor.md: the page of the live monitor, while its demonstration runs.

    python docs/figures/monitor_page.py

Needs Chromium (or the browser that RETWIN_BROWSER names), takes a minute, and writes
docs/images/monitor-page.png: the machine whose lid is open, at its first alarm. The machines are
emulated, and the page says so.
"""

from __future__ import annotations

import io
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from playwright.sync_api import Page, sync_playwright
from style import write

from retwin.monitor.demo import demonstration
from retwin.monitor.server import create_app, listening, serving

PATIENCE = 120_000  # ms
ASSET = "incubator 2"
AFTER = 3000  # ms after the alarm, so that three minutes of the open lid are seen


@contextmanager
def opened(folder: Path, *, height: int = 1000) -> Iterator[tuple[Page, str]]:
    """A browser's page of that height in pixels, and the address of the demonstration."""
    browser = shutil.which(os.environ.get("RETWIN_BROWSER") or "chromium")
    with (
        listening("127.0.0.1", 0) as bound,
        demonstration(folder) as (live, gate, explanations),
        serving(
            create_app(
                live,
                gate,
                token=secrets.token_urlsafe(),
                explanations=explanations,
                emulated=True,
            ),
            bound,
        ),
        sync_playwright() as play,
    ):
        started = play.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        size = {"width": 1100, "height": height}
        page = started.new_page(viewport=size, color_scheme="light")
        yield page, f"http://127.0.0.1:{bound.getsockname()[1]}/"
        started.close()


def photographed(folder: Path) -> bytes:
    """The page at the first alarm, as PNG."""
    with opened(folder) as (page, address):
        page.goto(f"{address}#/asset/{quote(ASSET)}")
        page.get_by_text("Cause: lid").wait_for(timeout=PATIENCE)
        page.wait_for_timeout(AFTER)
        return page.screenshot()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        picture = photographed(Path(temporary))
    write("monitor-page", io.BytesIO(picture))
