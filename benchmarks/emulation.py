"""Errors of the emulated arm compared with those of the real one: healthy trajectories of set A.

The figures are mean, standard deviation and 90 % quantile of delay (TDe), offset (TPE) and noise at
rest over all segments of 200 emulated trajectories, and the bootstrap interval of the same figures
over the real ones. Missed segments and glitches are counted separately.

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
from retwin.cases.armpi_fpv.twin import KINEMATIC, RATE, SENSOR_RATE
from retwin.update.corrections import Context

COUNT = 200
DRAWS = 2000
MISSED = 0.02
"""Offset (m) above which a segment counts as missed."""
GLITCH = 0.01
"""Deviation (m) of a sample from the median at rest above which it counts as a glitch."""
FIGURES = {
    "mean": np.mean,
    "standard deviation": np.std,
    "90 % quantile": lambda values: np.quantile(values, 0.9),
}


class Exact:
    """The kinematics of the arm, as the twin that is corrected."""

    def predict(self, commands: NDArray) -> NDArray:
        """Outputs (n, T, 3) for commands (n, T, 4)."""
        return KINEMATIC.position(np.asarray(commands, dtype=float)).astype(np.float32)


def segment_errors(trajectories: rt.Trajectories) -> dict[str, NDArray]:
    """TDe in samples, TPE and noise in mm, each (n, M), NaN where missed; counts (n,)."""
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
    polls = np.arange(0, trajectories.steps, round(RATE / SENSOR_RATE))
    for i, m in np.argwhere(segments.valid):
        # 0.3 s after the command has settled the arm is at rest, whatever the delay.
        steady = (polls >= segments.settle[i, m] + 30) & (polls < segments.stop[i, m])
        samples = trajectories.observed[i, polls[steady]]
        deviation = np.linalg.norm(samples - np.median(samples, axis=0), axis=1)
        glitches[i] += int((deviation > GLITCH).any())
        noise[i, m] = 1e3 * np.sqrt(np.mean(deviation[deviation <= GLITCH] ** 2))
    missed = (offset > MISSED) & segments.valid
    # The segment after a missed one catches up, so that its delay and offset are no errors.
    excluded = missed | np.pad(missed, ((0, 0), (1, 0)))[:, :-1] | ~segments.valid
    return {
        "TDe (samples)": np.where(excluded, np.nan, delay),
        "TPE (mm)": np.where(excluded, np.nan, 1e3 * offset),
        "noise at rest (mm)": np.where(excluded, np.nan, noise),
        "missed": missed.sum(axis=1).astype(float),
        "glitches": glitches.astype(float),
    }


def figures(values: NDArray) -> dict[str, float]:
    """The figures over all segments that are not excluded."""
    finite = values[np.isfinite(values)]
    return {name: float(figure(finite)) for name, figure in FIGURES.items()}


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
    onsets = rt.Segments.from_commands(real.commands).start / real.rate
    commands = case.sampler.sample(COUNT, rng=np.random.default_rng(0), onsets=onsets)
    truth, made = segment_errors(real), segment_errors(case.emulator.simulate(commands, seed=0))
    rng = np.random.default_rng(0)
    rows = {}
    for name in ("TDe (samples)", "TPE (mm)", "noise at rest (mm)"):
        of_real, of_emulated = figures(truth[name]), figures(made[name])
        bounds = interval(truth[name], rng)
        for figure in FIGURES:
            low, high = bounds[figure]
            rows[f"{name}, {figure}"] = {
                "real": of_real[figure],
                "low": low,
                "high": high,
                "emulated": of_emulated[figure],
                "inside": float(low <= of_emulated[figure] <= high),
            }
    for name in ("missed", "glitches"):
        count, mean = truth[name].sum(), made[name].mean()
        # The bootstrap fails for counts this small; this is the exact interval of a Poisson rate.
        low = chi2.ppf(0.025, 2 * count) / 2 / len(real) if count else 0.0
        high = chi2.ppf(0.975, 2 * count + 2) / 2 / len(real)
        rows[f"{name} per trajectory"] = {
            "real": count / len(real),
            "low": low,
            "high": high,
            "emulated": mean,
            "inside": float(low <= mean <= high),
        }
    record("emulation", f"{COUNT} emulated and {len(real)} real healthy trajectories", rows)


if __name__ == "__main__":
    main()
