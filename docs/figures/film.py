"""The film of the first page: an emulated arm, its ideal motion, and the corrected twin's band.

    python docs/figures/film.py

It runs the code of docs/tutorial.md up to the updated twin, and takes two minutes. Emulated robot
only. Writes docs/images/arm-film.webp.
"""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageSequence
from style import BLUE, INK, MUTED, animation, blank, dress
from tutorial import gaps, run

import retwin as rt

FPS, SIZE = 8, 360
"""Frames per second, and pixels of the side of the arm's picture and the height of the film."""
OUTPUT = 0
"""The output that is drawn beside the arm."""


def main() -> None:
    """Film the held-out trajectory of the tutorial whose residual is largest."""
    names = run("updated.save")
    held_out: rt.Trajectories = names["held_out"]
    place = int(np.argmax(np.abs(held_out.residual).mean(axis=(1, 2))))
    one, case = held_out[place : place + 1], names["case"]
    with tempfile.TemporaryDirectory() as folder:
        file = rt.cases.animate(one, case, Path(folder, "arm.gif"), fps=FPS, size=(SIZE, SIZE))
        arm = [frame.convert("RGB") for frame in ImageSequence.Iterator(Image.open(file))]
    chart, left, right = band(names["updated"], one, case)
    animation(
        "arm-film",
        [beside(each, chart, left, right, i / len(arm)) for i, each in enumerate(arm)],
        FPS,
    )


def band(
    updated: rt.CorrectedTwin, one: rt.Trajectories, case: Any
) -> tuple[Image.Image, float, float]:
    """The whole chart, and the pixels at which its time begins and ends."""
    observed, draws = gaps(updated, one)
    time = np.arange(len(observed)) / case.rate
    low, high = np.quantile(draws[..., OUTPUT], [0.05, 0.95], axis=0)
    figure = blank(4.6, SIZE / 100)
    axes = figure.subplots()
    axes.axhline(0, color=MUTED, linewidth=1.2, linestyle=":", label="original twin")
    axes.fill_between(
        time, low, high, color=BLUE, alpha=0.3, linewidth=0, label="updated twin, 90 %"
    )
    axes.plot(time, observed[:, OUTPUT], color=INK, linewidth=1.4, label="robot (emulated)")
    dress(axes, "time, s", f"deviation from ideal in {case.outputs.names[OUTPUT]}, mm")
    axes.set_xlim(time[0], time[-1])
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=7.5, columnspacing=1)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    box = axes.get_window_extent()
    scale = 100 / figure.dpi
    return Image.open(file).convert("RGB"), box.x0 * scale, box.x1 * scale


def beside(
    arm: Image.Image, chart: Image.Image, left: float, right: float, share: float
) -> Image.Image:
    """The arm, and the chart up to that share of its time."""
    shown = chart.copy()
    now = round(left + share * (right - left))
    veil = Image.new("RGB", (round(right) - now + 1, shown.height), "white")
    region = shown.crop((now, 0, now + veil.width, shown.height))
    top, bottom = round(0.12 * shown.height), round(0.86 * shown.height)
    shown.paste(Image.blend(region, veil, 0.88).crop((0, top, veil.width, bottom)), (now, top))
    ImageDraw.Draw(shown).line([(now, top), (now, bottom)], fill=MUTED, width=1)
    whole = Image.new("RGB", (arm.width + shown.width, SIZE), "white")
    whole.paste(arm, (0, 0))
    whole.paste(shown, (arm.width, 0))
    return whole


if __name__ == "__main__":
    main()
