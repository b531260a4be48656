"""Scores of retwin on systems that it was not developed on: those of tests/foreign.

    python benchmarks/foreign.py [RUNS [fmu] [duffing] [arm]]

An arm of six joints (MJCF, radians, 25 Hz), a Duffing oscillator with its resonance at 68 Hz
(610 Hz) and an FMU, each with records of a system that differs from its twin. Everything is done
by the command line. Intervals are 95 % bootstrap intervals over trajectories or records.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from record import record

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "foreign"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import duffing
import lag
import six_joints
from fmus import c_fmu
from terminal import retwin

Rows = dict[str, dict[str, float]]


def studied(folder: Path, line: str, runs: int, metrics: Sequence[str]) -> Rows:
    """Scores of the sources of `retwin study LINE`, and the fidelity of their twins."""
    retwin(folder, f"study {line} --runs {runs} --processes 1 --out study")
    found = json.loads((folder / "study" / "results.json").read_text())
    rows = {}
    for name, source in found["sources"].items():
        for metric in metrics:
            values = [each for each in source[metric] if each is not None]
            if values:
                interval = source.get("intervals", {}).get(metric)
                rows[f"{name}: {metric}"] = row(sum(values) / len(values), interval)
    for name, each in (found["fidelity"] or {}).items():
        for metric in ("coverage90", "crps_below/mean_only"):
            figure = each["figures"].get(metric)
            if figure:
                rows[f"{name}, simulations: {metric}"] = row(figure["value"], figure["interval"])
    return rows


def row(value: float, interval: Sequence[float] | None) -> dict[str, float]:
    """A figure with its interval, if it has one."""
    return {"value": value, **dict(zip(("low", "high"), interval or (), strict=False))}


def arm(folder: Path, runs: int) -> Rows:
    """Diagnoses of nine faults, and simulations of healthy test runs."""
    six_joints.write_case(folder)
    six_joints.write_runs(folder / "calibration", {"Healthy": 6}, 1)
    counts = {"Healthy": 9} | dict.fromkeys(six_joints.FAULTS, 3)
    six_joints.write_runs(folder / "test", counts, 100)
    retwin(folder, "twin simulate six.toml --n 400 --fault all --out simulated.npz")
    words = "--calibration calibration --test test --twin-data simulated.npz --per-class 40"
    line = f"six.toml {words} --sources dt,ibg_rg,inversion"
    return studied(folder, line, runs, ("macro_f1", "healthy_recall"))


def oscillator(folder: Path, runs: int) -> Rows:
    """Simulations of eight test records."""
    duffing.write_case(folder, tests=8)
    duffing.write_record(folder / "record.csv", 1)
    line = "duffing.toml --data record.csv --per-class 100"
    return studied(folder, line, runs, ("nrmse", "crps", "coverage90"))


def fmu(folder: Path, runs: int) -> Rows:
    """Simulations of two test records."""
    c_fmu(folder, name="good")
    lag.write_case(folder, "good", "good")
    lag.write_record(folder / "record.csv", 1)
    line = "good.toml --data record.csv --per-class 60"
    return studied(folder, line, runs, ("nrmse", "crps", "coverage90"))


SYSTEMS = {
    "fmu": ("an FMU of a first-order lag, 50 Hz", fmu),
    "duffing": ("a Duffing oscillator, 68 Hz at 610 Hz", oscillator),
    "arm": ("an arm of six joints, 25 Hz", arm),
}


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    for name in sys.argv[2:] or list(SYSTEMS):
        title, scored = SYSTEMS[name]
        with tempfile.TemporaryDirectory() as folder:
            record(f"foreign_{name}", f"{title}, {runs} runs", scored(Path(folder), runs))


if __name__ == "__main__":  # worker processes are spawned
    main()
