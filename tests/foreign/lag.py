"""A first-order lag as an FMU, sound and with troubles, and a record of a slower, weaker one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

RATE, TAU = 50, 0.1

CASE = """
name = "lag"
rate = {rate}
inputs = [{inputs}]
outputs = ["x"{more}]
correction = "additive"
network = {{ kind = "LSTM", hidden = 16 }}
training = {{ max_epochs = 20, batch_size = 8, learning_rate = 1e-2 }}

[twin]
name = "{fmu}.fmu"
timeout = 5

[commands]
kind = "HoldSampler"
duration = 4
hold_durations = [0.2, 1]
{limits}
{rest}
"""

REST = """
[density]
kind = "SequenceMixture"
members = 2

[records]
calibration = { columns = { u = "u", x = "x" }, rows = [0, 1000], transient = 1 }
test = [
    { columns = { u = "u", x = "x" }, rows = [1000, 1500], transient = 1 },
    { columns = { u = "u", x = "x" }, rows = [1500, 2000], transient = 1 },
]
"""


def write_case(
    folder: Path,
    fmu: str,
    name: str,
    *,
    inputs: tuple[str, ...] = ("u",),
    more: tuple[str, ...] = (),
    limits: str = "",
) -> Path:
    """The case of an FMU; its records are those of `write_record`."""
    file = folder / f"{name}.toml"
    words = {
        "rate": RATE,
        "fmu": fmu,
        "inputs": ", ".join(f'"{each}"' for each in inputs),
        "more": "".join(f', "{each}"' for each in more),
        "limits": limits,
        "rest": "" if more or len(inputs) > 1 else REST,
    }
    file.write_text(CASE.format(**words))
    return file


def followed(u: NDArray, tau: float = TAU, gain: float = 1.0) -> NDArray:
    """The exact response (n, T) to inputs (n, T) that are held for a sample."""
    x, share = np.zeros_like(u), np.exp(-1 / RATE / tau)
    for t in range(1, u.shape[1]):
        x[:, t] = gain * u[:, t - 1] + (x[:, t - 1] - gain * u[:, t - 1]) * share
    return x


def write_record(file: Path, seed: int) -> None:
    """One table: the recorded system is slower and weaker, has an offset, and drifts."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-10, 10, 100), 20)
    x = followed(u[None], tau=0.16, gain=0.9)[0] + 0.4 + 0.05 * rng.normal(size=len(u))
    table = np.stack([u, x], axis=1)
    np.savetxt(file, table, delimiter=",", header="u,x", comments="", fmt="%.8g")


def write_commands(folder: Path, troubles: list[int]) -> None:
    """A folder of runs with one input that makes trouble from a sample on; 0 is none."""
    (folder / "Healthy").mkdir(parents=True)
    for i, trouble in enumerate(troubles):
        table = np.zeros((100, 4))
        table[:, 0] = np.sin(np.arange(100) / 10)
        table[50:, 1] = trouble
        np.savetxt(folder / "Healthy" / f"run-{i}.csv", table, delimiter=",", fmt="%.7g")
