"""The four commands of README.md, from a log and an FMU to a calibrated FMU with bands."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import fmpy
import numpy as np
import pytest
from numpy.typing import NDArray
from test_readme import ROOT, shown
from typer.testing import CliRunner

from retwin.cli import app

DRIVE = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Drive(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.voltage = self.speed = self.current = 0.0
        self.resistance, self.inertia = 2.0, 0.02
        free = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.tunable}
        self.register_variable(Real("voltage", causality=Fmi2Causality.input, start=0.0))
        self.register_variable(Real("resistance", start=2.0, **free))
        self.register_variable(Real("inertia", start=0.02, **free))
        self.register_variable(Real("speed", causality=Fmi2Causality.output))
        self.register_variable(Real("current", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        count = max(1, round(step_size / 0.001))
        for _ in range(count):
            lost = self.voltage - self.resistance * self.current - 0.4 * self.speed
            torque = 0.4 * self.current - 0.05 * self.speed
            self.current += step_size / count * lost / 0.3
            self.speed += step_size / count * torque / self.inertia
        return True
"""
NOISE = {"speed": 0.2, "current": 0.06}
"""Standard deviations in rad/s and A."""


def machine(voltage: NDArray) -> dict[str, NDArray]:
    """Speed and current (T,) at 1 kHz: other parameters, and dry friction that the FMU lacks."""
    current = speed = 0.0
    made = np.empty((len(voltage), 2))
    for k, u in enumerate(voltage):
        made[k] = speed, current
        lost = u - 2.6 * current - 0.4 * speed
        torque = 0.4 * current - 0.03 * speed - 0.15 * np.tanh(speed / 0.3)
        current, speed = current + 0.001 * lost / 0.3, speed + 0.001 * torque / 0.035
    return {"speed": made[:, 0], "current": made[:, 1]}


def record(path: Path, rng: np.random.Generator, runs: int = 6) -> None:
    """A log of several runs: clocks that jitter, three rates, rpm and mA."""
    from mcap.writer import Writer

    begin, messages = 1_700_000_000.0, []
    for _ in range(runs):
        levels = rng.uniform(-12, 12, size=12)
        made = machine(np.repeat(levels, 1000))
        for time in np.arange(0, 11.9, 0.05):
            messages.append((begin + time, "/motor/cmd", "data", levels[int(time + 1e-9)]))
        for topic, field, name, step, scale in (
            ("/encoder", "rpm", "speed", 0.02, 30 / np.pi),
            ("/power", "milliamps", "current", 0.01, 1000.0),
        ):
            for time in np.arange(0, 11.9, step):
                at = abs(time + rng.normal(0, 0.001))
                value = np.interp(at, np.arange(12000) / 1000, made[name])
                value += NOISE[name] * rng.normal()
                messages.append((begin + at, topic, field, scale * value))
        begin += rng.uniform(16, 20)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "test")
        topics = {}
        for time, topic, field, value in sorted(messages):
            if topic not in topics:
                schema = writer.register_schema(topic, "jsonschema", b"{}")
                topics[topic] = writer.register_channel(topic, "json", schema)
            stamp = round(time * 1e9)
            text = json.dumps({field: float(value)}).encode()
            writer.add_message(topics[topic], stamp, text, stamp)
        writer.finish()


def retwin(line: str) -> None:
    result = CliRunner().invoke(app, shlex.split(line, comments=True), catch_exceptions=False)
    assert result.exit_code == 0, f"retwin {line}: {result.output}"


def lines() -> list[str]:
    """The four commands of the page on identification."""
    whole = [line for line, each in shown(ROOT / "docs" / "identify.md") if each]
    begin = next(i for i, line in enumerate(whole) if line.startswith("data map"))
    return whole[begin : begin + 4]


def test_the_page_has_the_four_commands() -> None:
    verbs = ("data map", "identify", "fit", "export fmu")
    assert all(line.startswith(verb) for line, verb in zip(lines(), verbs, strict=True))
    assert "--dynamics" in lines()[2]


@pytest.mark.long
def test_four_commands_lead_from_a_log_and_an_fmu_to_a_calibrated_fmu_with_bands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    record(tmp_path / "run.mcap", rng)
    Path("drive.py").write_text(DRIVE, encoding="utf-8")
    build = [sys.executable, "-m", "pythonfmu", "build", "-f", "drive.py", "-d", "."]
    subprocess.run(build, check=True, capture_output=True)
    Path("Drive.fmu").rename("drive.fmu")
    map_log, identify, fit, export = lines()
    retwin(map_log)
    mapping = Path("mapping.toml").read_text("utf-8")
    assert "rate = 50.0" in mapping
    assert 'signal = "/motor/cmd.data"' in mapping, "the only command"
    for signal, unit, wanted in (
        ("/encoder.rpm", "rpm", "rad/s"),
        ("/power.milliamps", "mA", "A"),
    ):
        own = f'signal = "{signal}"\nfrom_unit = "{unit}"\nunit = "{wanted}" '
        mapping = mapping.replace('signal = "" ', own, 1)
    Path("mapping.toml").write_text(mapping, encoding="utf-8")
    for line in (identify, fit, export):
        retwin(line)
    made = json.loads(Path("identified/identification.json").read_text("utf-8"))
    before = {name: each["validation"]["after"] for name, each in made["outputs"].items()}
    levels = rng.uniform(-12, 12, size=12)
    real = machine(np.repeat(levels, 1000))
    command = np.zeros(600, dtype=[("time", float), ("voltage", float)])
    command["time"], command["voltage"] = np.arange(600) / 50, np.repeat(levels, 50)
    found = fmpy.simulate_fmu("twin.fmu", stop_time=11.9, output_interval=0.02, input=command)
    for name, noise in NOISE.items():
        at = np.interp(found["time"], np.arange(12000) / 1000, real[name])
        at += noise * rng.normal(size=at.shape)
        error = float(np.sqrt(np.mean((found[f"{name}.mean"] - at) ** 2)))
        assert error < 0.75 * before[name], "what no value of the parameters explains is learned"
        inside = (found[f"{name}.q05"] <= at) & (at <= found[f"{name}.q95"])
        assert 0.75 < inside.mean() < 0.99
