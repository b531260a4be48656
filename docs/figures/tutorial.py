"""The picture of docs/tutorial.md: the gap of a trajectory within the updated twin's bands.

    python docs/figures/tutorial.py

It runs the page's own code up to the updated twin, so the picture shows what the page makes.
Emulated robot only. Takes less than a minute and writes docs/images/tutorial-band.png.
"""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from style import BLUE, INK, MUTED, blank, dress, save

import retwin as rt

PAGE = Path(__file__).parents[1] / "tutorial.md"
DRAWS, MM = 200, 1000.0


def main() -> None:
    """Draw it."""
    names = run("updated.save")
    observed, draws = gaps(names["updated"], names["held_out"][2:3])
    outputs = names["case"].outputs.names
    time = np.arange(len(observed)) / names["case"].rate
    figure = blank(7.2, 3.6)
    for place, axes in enumerate(figure.subplots(2, 1, sharex=True, sharey=True)):
        for share, alpha in ((0.9, 0.2), (0.5, 0.35)):
            low, high = np.quantile(draws[..., place], [(1 - share) / 2, (1 + share) / 2], axis=0)
            label = f"{100 * share:.0f} % of draws"
            axes.fill_between(time, low, high, color=BLUE, alpha=alpha, linewidth=0, label=label)
        axes.axhline(0, color=MUTED, linewidth=1, linestyle=":", label="nominal")
        axes.plot(time, observed[:, place], color=INK, linewidth=1.2, label="measured")
        dress(axes, "time, s" if place else "", f"gap in {outputs[place]}, mm")
        axes.set_xlim(time[0], time[-1])
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    save("tutorial-band", figure, "Emulated robot, no real measurements")


def run(last: str) -> dict[str, Any]:
    """The names that the page's blocks make, up to the one that holds `last`."""
    names: dict[str, Any] = {}
    back = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for code in re.findall(
                r"^```python[^\n]*\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S
            ):
                exec(compile(code, str(PAGE), "exec"), names)
                if last in code:
                    break
        finally:
            os.chdir(back)
    return names


def gaps(updated: rt.CorrectedTwin, one: rt.Trajectories) -> tuple[NDArray, NDArray]:
    """Measured (T, d_y) and drawn (draws, T, d_y) minus nominal, in mm, of one trajectory."""
    made = updated.simulate(np.repeat(one.commands, DRAWS, axis=0), seed=0)
    return MM * one.residual[0], MM * (made.observed - one.nominal)


if __name__ == "__main__":
    main()
