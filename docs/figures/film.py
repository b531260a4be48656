"""The film of the first page: an emulated arm, its ideal motion, and the corrected twin's band.

    python docs/figures/film.py

It runs the code of docs/tutorial.md up to the updated twin, and takes two minutes. Emulated robot
only. Writes docs/images/arm-film.webp.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence
from style import animation
from tutorial import run

import retwin as rt

FPS, SIZE = 8, (820, 360)
"""Frames per second, and width and height in pixels."""


def main() -> None:
    """Film the held-out trajectory of the tutorial whose residual is largest."""
    names = run("updated.save")
    held_out: rt.Trajectories = names["held_out"]
    place = int(np.argmax(np.abs(held_out.residual).mean(axis=(1, 2))))
    with tempfile.TemporaryDirectory() as folder:
        film = rt.cases.animate(
            held_out,
            names["case"],
            Path(folder, "arm.gif"),
            index=place,
            fps=FPS,
            size=SIZE,
            updated=names["updated"],
        )
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(Image.open(film))]
    animation("arm-film", frames, FPS)


if __name__ == "__main__":
    main()
