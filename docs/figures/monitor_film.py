"""The film of the live monitor's page: from a quiet start to the first alarm and its cause.

    python docs/figures/monitor_film.py

Needs Chromium (or the browser that RETWIN_BROWSER names), takes two minutes, and writes
docs/images/monitor-film.webp. The machines are emulated and run 60 times as fast as real ones.
"""

from __future__ import annotations

import io
import tempfile
import time
from pathlib import Path
from urllib.parse import quote

from monitor_page import ASSET, PATIENCE, opened
from PIL import Image
from style import animation

EVERY = 1.0
"""Seconds between two frames."""
BEFORE, AFTER = 24, 8
"""Frames that are kept before and after the alarm."""
FPS = 4
WIDTH = 820
"""Pixels."""


def filmed(folder: Path) -> list[Image.Image]:
    """Frames around the first alarm."""
    frames: list[Image.Image] = []
    with opened(folder, height=760) as (page, address):
        page.goto(f"{address}#/asset/{quote(ASSET)}")
        page.wait_for_timeout(2000)
        last, end = None, time.monotonic() + PATIENCE / 1000
        while time.monotonic() < end and (last is None or len(frames) < last):
            frames.append(shrunk(page.screenshot()))
            if last is None and page.get_by_text("Cause: lid").count():
                last = len(frames) + AFTER
            page.wait_for_timeout(1000 * EVERY)
    return frames[-BEFORE - AFTER :]


def shrunk(picture: bytes) -> Image.Image:
    """A picture of the film's width."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    return image.resize(
        (WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS
    )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        made = filmed(Path(temporary))
    animation("monitor-film", made, FPS)
