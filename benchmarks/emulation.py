"""Does the emulated arm err as the real one does? Its healthy trajectories beside those of set A.

For delay (TDe), offset (TPE) and plateau noise of every movement: mean, spread and tail of 200
emulated trajectories, and the bootstrap interval of the same figure over the real ones. Movements
that a joint missed, and glitches, are counted apart.

Needs RETWIN_DATA.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from record import record
from scipy.stats import chi2

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, POLL
from retwin.update.corrections import Context

COUNT = 200
DRAWS = 2000
MISSED = 0.02
"""An offset (m) that only a missed movement explains."""
GLITCH = 0.01
"""A deviation (m) of one or two readings from the plateau's median that is no noise."""
FIGURES = {
    "mean": np.mean,
    "spread": np.std,
    "tail": lambda values: np.quantile(values, 0.9),
}


class Exact:
    """The arm's kinematics as the twin that is to be corrected."""

    def predict(self, commands: NDArray) -> NDArray:
        """Outputs for commands, both as everywhere."""
        return KINEMATIC.position(np.asarray(commands, dtype=float)).astype(np.float32)


def movements(trajectories: rt.Trajectories) -> dict[str, NDArray]:
    """Per movement (n, M): TDe in samples, TPE and noise in mm; NaN where missed or not there."""
    segments = rt.Segments.from_commands(trajectories.commands)
    context = Context.of(Exact(), trajectories.commands, segments, rate=trajectories.rate)
    found = rt.DelayOffset().infer(
        context,
        torch.as_tensor(trajectories.observed.copy()),
        torch.as_tensor(trajectories.mask.copy()),
    )
    delay = np.where(found.identified[..., 0].numpy(), found.z[..., 0].numpy(), np.nan)
    offset = found.z[..., 1:].norm(dim=-1).numpy()
    noise = np.full(offset.shape, np.nan)
    glitches = np.zeros(len(trajectories), dtype=int)
    polls = np.arange(0, trajectories.steps, POLL)
    for i, m in np.argwhere(segments.valid):
        # Half a second after the command has settled, whatever the delay, all is still.
        steady = (polls >= segments.settle[i, m] + 30) & (polls < segments.stop[i, m])
        readings = trajectories.observed[i, polls[steady]]
        away = np.linalg.norm(readings - np.median(readings, axis=0), axis=1)
        glitches[i] += int((away > GLITCH).any())
        noise[i, m] = 1e3 * np.sqrt(np.mean(away[away <= GLITCH] ** 2))
    missed = (offset > MISSED) & segments.valid
    # The movement after a missed one catches up: its delay and offset mean something else.
    apart = missed | np.pad(missed, ((0, 0), (1, 0)))[:, :-1] | ~segments.valid
    return {
        "TDe (samples)": np.where(apart, np.nan, delay),
        "TPE (mm)": np.where(apart, np.nan, 1e3 * offset),
        "plateau noise (mm)": np.where(apart, np.nan, noise),
        "missed": missed.sum(axis=1).astype(float),
        "glitches": glitches.astype(float),
    }


def figures(values: NDArray) -> dict[str, float]:
    """The figures of all movements of some trajectories."""
    known = values[np.isfinite(values)]
    return {name: float(figure(known)) for name, figure in FIGURES.items()}


def interval(values: NDArray, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """95 % bootstrap intervals of the figures, resampled by trajectory."""
    draws = [figures(values[rng.integers(len(values), size=len(values))]) for _ in range(DRAWS)]
    return {
        name: tuple(np.quantile([draw[name] for draw in draws], [0.025, 0.975]).tolist())
        for name in FIGURES
    }


def main() -> None:
    folder = os.environ.get("RETWIN_DATA")
    if not folder:
        sys.exit("emulation: set RETWIN_DATA to the folder of the public data")
    case = rt.cases.armpi()
    assert case.emulator is not None
    real = rt.load(Path(folder) / "armpi" / "real_a.mat", case=case).with_label("Healthy")
    onsets = rt.Segments.from_commands(real.commands).start
    commands = case.sampler.sample(COUNT, rng=np.random.default_rng(0), timing=onsets)
    truth, made = movements(real), movements(case.emulator.simulate(commands, seed=0))
    rng = np.random.default_rng(0)
    rows = {}
    for name in ("TDe (samples)", "TPE (mm)", "plateau noise (mm)"):
        here, there, between = figures(truth[name]), figures(made[name]), interval(truth[name], rng)
        for figure in FIGURES:
            low, high = between[figure]
            rows[f"{name}, {figure}"] = {
                "real": here[figure],
                "low": low,
                "high": high,
                "emulated": there[figure],
                "inside": float(low <= there[figure] <= high),
            }
    for name in ("missed", "glitches"):
        count, there = truth[name].sum(), made[name].mean()
        # Counts this small are compared as such: the exact interval of a Poisson rate.
        low = chi2.ppf(0.025, 2 * count) / 2 / len(real) if count else 0.0
        high = chi2.ppf(0.975, 2 * count + 2) / 2 / len(real)
        rows[f"{name} per trajectory"] = {
            "real": count / len(real),
            "low": low,
            "high": high,
            "emulated": there,
            "inside": float(low <= there <= high),
        }
    record("emulation", f"{COUNT} emulated beside {len(real)} real healthy trajectories", rows)


if __name__ == "__main__":
    main()
