"""Training commands from the user's own record: a Duffing oscillator of 68 Hz, at 610 Hz."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.twins import MultisineSampler, RampSampler, sampler_from
from retwin.twins.commands.range import CommandRange

RATE, RESONANCE = 610.0, 68.0
MODULE = """
import numpy as np

OMEGA = 2 * np.pi * 68.0


def duffing(commands, rate, parts=6):
    # Driven by V; damping 0.05, a cubic spring, symplectic steps within a sample.
    x, v = np.zeros((2, len(commands)))
    out, step = np.empty(commands.shape), 1 / (parts * rate)
    for t in range(commands.shape[1]):
        for _ in range(parts):
            pull = commands[:, t, 0] - x - 0.3 * x**3
            v = v + step * (OMEGA**2 * pull - 2 * 0.05 * OMEGA * v)
            x = x + step * v
        out[:, t, 0] = x
    return out
"""
CASE = """
name = "duffing"
twin = "duffing_module:duffing"
rate = 610
inputs = {{ force = {{ unit = "V", low = -5, high = 5 }} }}
outputs = {{ x = {{ unit = "V" }} }}
commands = {{ {} }}
correction = "delay_offset"
network = "mlp"
training = {{ max_epochs = 1 }}
density = {{ kind = "Mixture", training = {{ max_epochs = 2 }} }}
"""
SLOW = 'kind = "MultisineSampler", duration = 1.0, band = [1, 12]'


def real_commands() -> np.ndarray:
    """A record as of the Silverbox: multisines to 150 Hz."""
    sampler = MultisineSampler((-1.5,), (1.5,), RATE, 1.0, (1.0, 150.0), deviation=(0.3,))
    return sampler.sample(4, rng=np.random.default_rng(0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tmp_path = tmp_path_factory.mktemp("duffing")
    (tmp_path / "duffing_module.py").write_text(MODULE)
    (tmp_path / "case.toml").write_text(CASE.format(SLOW))
    (tmp_path / "own.toml").write_text(CASE.format('file = "real.npz"'))
    made = rt.cases.get(str(tmp_path / "case.toml")).twin.simulate(real_commands(), seed=0)
    # Training of one epoch suffices beside a discrepancy of this size.
    rt.save(made.replace(observed=made.observed + 3), tmp_path / "real.npz")
    return tmp_path


def power_near_resonance(outputs: np.ndarray) -> float:
    """Root mean square of what outputs have within 10 Hz of the resonance."""
    spectrum = np.abs(np.fft.rfft(outputs[..., 0], axis=1)) ** 2
    frequency = np.fft.rfftfreq(outputs.shape[1], 1 / RATE)
    near = np.abs(frequency - RESONANCE) < 10
    return float(np.sqrt(spectrum[:, near].mean()) / outputs.shape[1])


def test_the_commands_of_a_case_are_like_those_of_its_record(folder: Path) -> None:
    case = rt.cases.get(str(folder / "own.toml"))
    real = rt.load(folder / "real.npz")
    drawn = case.sampler.sample(40, rng=np.random.default_rng(1))
    assert CommandRange.of(drawn, RATE).outside(real.commands, RATE, real.inputs) == ""
    made = case.twin.simulate(drawn, seed=0)
    assert power_near_resonance(made.nominal) == pytest.approx(
        power_near_resonance(real.nominal), rel=0.5
    )
    slow = rt.cases.get(str(folder / "case.toml"))
    drawn = slow.sampler.sample(40, rng=np.random.default_rng(1))
    missing = CommandRange.of(drawn, RATE).outside(real.commands, RATE, real.inputs)
    assert "of its power above 13 Hz" in missing


@pytest.mark.slow
def test_fit_adds_commands_that_the_sampler_lacks(folder: Path, call: Callable) -> None:
    real, out = folder / "real.npz", folder / "model"
    words = ("--real", real, "--simulations", 20, "--calibrate-on", "all", "--out", out)
    code, _, err = call("fit", folder / "case.toml", *words)
    assert code == 0, err
    assert "does not draw the real commands: force" in err
    assert "20 simulations of commands like these were added" in " ".join(err.split())
    assert "outside the training range" not in err
    trained = rt.CorrectedTwin.load(out).surrogate.trained
    assert trained.band[0] > RESONANCE
    code, _, err = call("fit", folder / "own.toml", *words)
    assert code == 0, err
    assert "does not draw" not in err


def test_a_case_without_commands_names_the_record(folder: Path, call: Callable) -> None:
    file = folder / "none.toml"
    file.write_text(CASE.format("").replace("commands = {  }", ""))
    code, _, err = call("fit", file, "--real", folder / "real.npz", "--out", folder / "m")
    assert code == 2
    assert 'write file = "RECORD"' in " ".join(err.split())


def test_ramps_of_a_record_are_ramps(case: rt.Case) -> None:
    real = case.sampler.sample(20, rng=np.random.default_rng(0))
    found = sampler_from(real, case.rate)
    assert isinstance(found, RampSampler)
    assert found.segments == rt.Segments.from_commands(real).max_count
    drawn = found.sample(200, rng=np.random.default_rng(1))
    assert CommandRange.of(drawn, case.rate).outside(real, case.rate, case.inputs) == ""
    limits = rt.twins.Limits((300.0,) * 4, (700.0,) * 4)
    inside = sampler_from(real, case.rate, limits=limits)
    assert min(inside.low) >= 300
    assert max(inside.high) <= 700


def test_a_constant_channel_and_a_long_record() -> None:
    real = np.concatenate([real_commands().reshape(1, -1, 1)] * 2, axis=2)
    real[..., 1] = 3.0
    found = sampler_from(real, RATE)
    assert isinstance(found, MultisineSampler)
    assert found.duration == pytest.approx(2048 / RATE)
    assert found.sample(3, rng=np.random.default_rng(0)).shape == (3, 2048, 2)
