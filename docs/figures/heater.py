"""The picture of the README: a heater, its twin as given, and the updated twin with its band.

    python docs/figures/heater.py

It runs the commands of the README, so the picture shows what they make, on a run of the emulated
heater that was not used for the update. Takes half a minute and writes docs/images/heater.png.
"""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from style import BLUE, INK, ORANGE, blank, dress, save

EXAMPLE = Path(__file__).parents[2] / "examples" / "heater"
RUN, BAND = 4, "updated twin, 90 % band"


def main() -> None:
    """Draw it."""
    with tempfile.TemporaryDirectory() as place:
        shutil.copytree(EXAMPLE, place, dirs_exist_ok=True)
        os.chdir(place)
        subprocess.run([sys.executable, "measure.py"], check=True)
        runs = [f"run{number}.csv" for number in range(4)]
        retwin("identify", "heater:twin", *runs, "--out", "identified")
        retwin("fit", "identified/updated.toml", "--real", "identified/logs.npz", "--dynamics",
               "--out", "model")  # fmt: skip
        commands = ("--commands", f"run{RUN}.csv")
        retwin("generate", "model", *commands, "--bands", "--out", "bands.csv")
        nominal, bands = as_given(f"run{RUN}.csv"), columns("bands.csv")
    minutes = bands["time"] / 60
    figure = blank(7.2, 3.0)
    axes = figure.subplots()
    axes.plot(minutes, nominal, color=ORANGE, linewidth=1.5, label="twin as it was given")
    low, high = bands["block_q05"], bands["block_q95"]
    axes.fill_between(minutes, low, high, color=BLUE, alpha=0.4, linewidth=0, label=BAND)
    axes.plot(minutes, bands["block_measured"], color=INK, linewidth=0.8, label="measured")
    dress(axes, x="time, min", y="block, °C")
    axes.legend(frameon=False, fontsize=9, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    save("heater", figure, "Emulated heater, a run that was not used for the update")


def retwin(*words: str) -> None:
    """Run a command."""
    subprocess.run([sys.executable, "-m", "retwin", *words], check=True)


def as_given(file: str) -> np.ndarray:
    """The output of the twin as it was given, for the commands in a file."""
    sys.path.insert(0, ".")
    from heater import twin

    read = columns(file)
    commands = np.stack([read[name] for name in twin.inputs.names], axis=1)
    start = {"start_block": read["block"][0]}
    return twin.parametric().with_values(start).simulate(commands[None], seed=0).observed[0, :, 0]


def columns(file: str) -> dict[str, np.ndarray]:
    """The columns of numbers of a CSV file by their names."""
    with Path(file).open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    names = [name for name in rows[0] if name != "record"]
    return {name: np.array([float(row[name]) for row in rows]) for name in names}


if __name__ == "__main__":
    main()
