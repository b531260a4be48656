"""Write CSV files as a logger would, of an emulated heater that its twin does not match.

    python measure.py [FOLDER]

The emulated heater also radiates, its resistor warms up before its block does, and its sensor has
noise and steps of 0.1 degC. In `run6.csv` the heater loses half of its power after 600 s.
"""

import csv
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SECONDS, STEPS = 1200, 10
RUNS, BROKEN = 7, 6


def measure(run: int) -> NDArray:
    """The rows of a run: time in s, heater in W, temperatures of air and block in degC."""
    rng = np.random.default_rng(run)
    heater = rng.uniform(0.0, 30.0, SECONDS // 60).repeat(60)
    ambient = 20.0 + rng.uniform(-2.0, 2.0) + rng.normal(0.0, 0.01, SECONDS).cumsum()
    resistor = block = ambient[0]
    rows = []
    for time in range(SECONDS):
        measured = (block + rng.normal(0.0, 0.1)).round(1)
        rows.append((time, heater[time], ambient[time], measured))
        power = heater[time] / (2 if run == BROKEN and time >= SECONDS / 2 else 1)
        for _ in range(STEPS):
            warmer = block - ambient[time]
            radiated = 2e-9 * ((block + 273.15) ** 4 - (ambient[time] + 273.15) ** 4)
            into_block = 2.0 * (resistor - block)
            resistor += (power - into_block) / 5.0 / STEPS
            block += (into_block - 0.25 * warmer - radiated) / 45.0 / STEPS
    return np.array(rows).round(3)


folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
for run in range(RUNS):
    with (folder / f"run{run}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("time", "heater", "ambient", "block"))
        writer.writerows(measure(run).tolist())
