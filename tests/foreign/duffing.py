"""A Duffing oscillator at 610 Hz with a resonance at 68 Hz, and records of one that differs.

The user has the function, its case and one table. The recorded oscillator is stiffer at large
displacements, is damped more, and answers a sample late.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

RATE, RESONANCE = 610, 68.0
NOISE = 0.002
ROWS, LENGTH = 8000, 500
"""Rows of the table, of which the second half is for tests, and rows of a test record."""

MODULE = '''"""x'' + 2 d w x' + w^2 (x + b x^3) = w^2 u, by Runge-Kutta steps."""

import numpy as np


def displacement(force, rate, resonance=68.0, damping=0.05, cubic=0.3):
    """Displacements (n, T, 1) in mm for forces (n, T, 1) in N, which are held for a sample."""
    w, steps = 2 * np.pi * resonance, 2
    h = 1 / rate / steps

    def slope(x, v, u):
        return v, w * w * (u - x - cubic * x**3) - 2 * damping * w * v

    x = v = np.zeros(len(force))
    found = np.empty(force.shape)
    for t in range(force.shape[1]):
        found[:, t, 0] = x
        u = force[:, t, 0]
        for _ in range(steps):
            a, b = slope(x, v, u)
            c, d = slope(x + h / 2 * a, v + h / 2 * b, u)
            e, f = slope(x + h / 2 * c, v + h / 2 * d, u)
            g, i = slope(x + h * e, v + h * f, u)
            x, v = x + h / 6 * (a + 2 * c + 2 * e + g), v + h / 6 * (b + 2 * d + 2 * f + i)
    return found
'''

CASE = """
name = "duffing"
twin = "duffing_twin:displacement"
rate = {rate}
correction = "additive"
network = {{ kind = "LSTM", hidden = 32 }}
training = {{ max_epochs = 60, batch_size = 10, learning_rate = 1e-2 }}

[inputs]
force = {{ unit = "N", low = -2, high = 2 }}

[outputs]
x = {{ unit = "mm" }}

[commands]
kind = "MultisineSampler"
duration = 0.5
band = [2, 120]
deviation = [0.2]

[parameters]
damping = {{ unit = "1", low = 0.01, high = 0.3, start = 0.05 }}
cubic = {{ unit = "1/mm^2", low = 0, high = 2, start = 0.3 }}

[density]
kind = "SequenceMixture"
members = 2

[records]
calibration = [
    {{ columns = {{ force = "F", x = "X" }}, rows = [0, 2000], transient = 0.2 }},
    {{ columns = {{ force = "F", x = "X" }}, rows = [2000, 4000], transient = 0.2 }},
]
test = [
{tests}
]
"""


def write_case(folder: Path, *, tests: int = 4) -> None:
    """The files that the user has, with so many test records."""
    (folder / "duffing_twin.py").write_text(MODULE)
    rows = (
        f'    {{ columns = {{ force = "F", x = "X" }}, rows = [{first}, {first + LENGTH}], '
        "transient = 0.2 },"
        for first in range(4000, 4000 + tests * LENGTH, LENGTH)
    )
    text = CASE.format(rate=RATE, tests="\n".join(rows))
    (folder / "duffing.toml").write_text(text)


def write_record(file: Path, seed: int) -> None:
    """One table of force and displacement."""
    space: dict = {}
    exec(MODULE, space)
    rng = np.random.default_rng(seed)
    time, frequencies = np.arange(ROWS) / RATE, rng.uniform(2, 120, 300)
    phases = rng.uniform(0, 2 * np.pi, len(frequencies))
    sines = np.cos(2 * np.pi * np.outer(time, frequencies) + phases)
    force = 0.2 * np.sqrt(2 / len(frequencies)) * sines.sum(axis=1)
    real = {"damping": 0.07, "cubic": 0.6}
    x = space["displacement"](force[None, :, None], RATE, **real)[0, :, 0]
    x = np.concatenate([[0], x[:-1]])
    table = np.stack([time, force, x + NOISE * rng.normal(size=len(x))], axis=1)
    np.savetxt(file, table, delimiter=",", header="t,F,X", comments="", fmt="%.8g")
