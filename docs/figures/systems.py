"""Pictures of the pages on models, logs, dynamics, tanks and scale, made by the code of the pages.

    python docs/figures/systems.py

Takes a minute, and writes docs/images/mujoco.png, logs.png, dynamics.png, state-surrogate.png,
tanks.png and scaling.png. All measurements are emulated.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from style import BLUE, GREEN, INK, MUTED, ORANGE, blank, dress, note, save, title

import retwin as rt
from retwin.cases.cascaded_tanks.twin import OVERFLOWING_TANKS

DOCS = Path(__file__).parents[1]
PYTHON = re.compile(r"^```python\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


def main() -> None:
    """Draw all of them."""
    mujoco()
    logs()
    dynamics()
    state_surrogate()
    tanks()
    scaling()


def run(page: str, blocks: int, *files: Path) -> dict[str, Any]:
    """What the first Python blocks of a page make, in a folder with these files."""
    codes = PYTHON.findall((DOCS / page).read_text("utf-8"))[:blocks]
    names: dict[str, Any] = {"__name__": "shown"}
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        for file in files:
            shutil.copy(file, folder)
        os.chdir(folder)
        try:
            for code in codes:
                exec(compile(code, page, "exec"), names)
        finally:
            os.chdir(here)
    return names


def legend(figure: Any, axes: Any, columns: int) -> None:
    """The lines of a panel, below all."""
    handles, labels = axes.get_legend_handles_labels()
    place = "outside lower center"
    figure.legend(handles, labels, loc=place, ncols=columns, frameon=False, fontsize=9)


def mujoco() -> None:
    """The hook of the crane swings after its cart is pushed."""
    made = run("mujoco.md", 1, DOCS.parent / "tests" / "testing" / "crane.xml")["made"]
    time = np.arange(made.steps) / made.rate
    figure = blank(7.6, 3.0)
    above, below = figure.subplots(2, 1, sharex=True)
    above.step(time, made.commands[0, :, 0], color=INK, where="post", linewidth=1.2)
    dress(above, "", f"force, {made.inputs.units[0]}")
    below.plot(time, made.observed[0, :, 0], color=BLUE, linewidth=1.6)
    dress(below, "time, s", "hook_x, m")
    save("mujoco", figure, "A pendulum on a cart, simulated by MuJoCo")


def logs() -> None:
    """What became of the log of the page: two trajectories, and missing samples."""
    bench = run("logs.md", 1)["bench"]
    figure = blank(7.6, 3.0)
    panels = figure.subplots(2, 2, sharex="col", sharey="row")
    for place, (above, below) in enumerate(panels.T):
        count = int(bench.lengths[place])
        time = np.arange(count) / bench.rate
        above.step(time, bench.commands[place, :count, 0], color=INK, linewidth=1.2, where="post")
        seen = bench.mask[place, :count, 0]
        level = np.where(seen, bench.observed[place, :count, 0], np.nan)
        below.plot(time, level, color=BLUE, linewidth=1.6)
        missing = np.flatnonzero(~seen)
        if len(missing) > 1:
            span = missing[[0, -1]] / bench.rate
            below.axvspan(*span, color=ORANGE, alpha=0.25, linewidth=0)
            note(below, "orange: missing, masked", low=True)
        title(above, f"trajectory {place + 1}")
        dress(above, "", "pump, V" if place == 0 else "")
        dress(below, "time since its begin, s", "level, cm" if place == 0 else "")
    save("logs", figure, "The log of this page: the logger paused for 15 s in between")


def dynamics() -> None:
    """What was learned, and a free simulation before and after."""
    names = run("dynamics.md", 1)
    fitted, unseen = names["fitted"], names["real"][3:]
    curve = fitted.twin.curve("velocity", "position")
    figure = blank(7.6, 3.0)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    left.fill_between(curve.values, *curve.band(), color=BLUE, alpha=0.25, linewidth=0)
    left.plot(curve.values, curve.discrepancy, color=BLUE, linewidth=1.6)
    left.plot(curve.values, -120 * curve.values**3, color=INK, linewidth=1, linestyle="--")
    title(left, "learned; dashed: the truth")
    dress(left, "position, m", "missing acceleration, m/s²")
    time = np.arange(unseen.steps) / unseen.rate
    for label, twin, colour in (
        ("original twin", names["oscillator"], MUTED),
        ("corrected dynamics", fitted.twin, BLUE),
    ):
        nominal = twin.simulate(unseen.commands, seed=0).nominal[0, :, 0]
        right.plot(time, nominal, color=colour, linewidth=1.6, label=label)
    right.plot(
        time,
        unseen.observed[0, :, 0],
        color=ORANGE,
        linewidth=1,
        linestyle=":",
        label="measured, held out",
    )
    right.set_xlim(4, 10)
    dress(right, "time, s", "position, m")
    legend(figure, right, 3)
    save("dynamics", figure, "An emulated oscillator whose spring hardens")


def state_surrogate() -> None:
    """A simulation that was not learned from, and the error of it."""
    names = run("state_surrogate.md", 1)
    learned = names["learned"]
    given = names["positions"].sample(1, rng=np.random.default_rng(9))
    box = names["black_box"].simulate(given, seed=0).nominal[0, :, 0]
    equations = learned.twin.simulate(given, seed=0).nominal[0, :, 0]
    time = np.arange(len(box)) / learned.twin.rate
    figure = blank(7.6, 3.2)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    above.plot(time, box, color=MUTED, linewidth=3, label="black box")
    above.plot(time, equations, color=BLUE, linewidth=1.2, label="learned equations")
    dress(above, "", "level, m")
    below.plot(time, 1000 * (equations - box), color=ORANGE, linewidth=1)
    dress(below, "time, s", "error, mm")
    legend(figure, above, 2)
    save("state-surrogate", figure, "A simulated tank, on commands that were not learned from")


def tanks() -> None:
    """Both twins of the tanks under the same voltage."""
    case = rt.cases.tanks()
    given = case.sampler.sample(1, rng=np.random.default_rng(0))[:, :400]
    time = np.arange(given.shape[1]) / case.rate / 60
    figure = blank(7.6, 3.2)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    above.plot(time, given[0, :, 0], color=INK, linewidth=1.2)
    dress(above, "", "pump, V")
    for label, twin, colour in (
        ("simple twin", case.twin, MUTED),
        ("with overflow", OVERFLOWING_TANKS, GREEN),
    ):
        level = twin.simulate(given, seed=0).nominal[0, :, 0]
        below.plot(time, level, color=colour, linewidth=1.6, label=label)
    dress(below, "time, min", "lower level, V")
    legend(figure, below, 2)
    save("tanks", figure, "Both twins of the tanks, simulated; the difference is what overflows")


def scaling() -> None:
    """The rates of the page's first table."""
    text = (DOCS / "scaling.md").read_text("utf-8")
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| ")]
    heads = [head.strip() for head in rows[0]]
    figure = blank(7.6, 2.4)
    axes = figure.subplots()
    for place, row in enumerate(rows[1:3]):
        rates = [float(value.replace(" ", "")) for value in row[1:4]]
        height = np.arange(3) + 0.36 * place
        colour = (BLUE, ORANGE)[place]
        axes.barh(height, rates, height=0.34, color=colour, label=row[0].strip())
    axes.set_yticks(np.arange(3) + 0.18, heads[1:4], fontsize=9)
    axes.invert_yaxis()
    axes.set_xscale("log")
    dress(axes, "trajectories per second of one core", "")
    legend(figure, axes, 2)
    save("scaling", figure, "Generation takes most of the time")


if __name__ == "__main__":
    main()
