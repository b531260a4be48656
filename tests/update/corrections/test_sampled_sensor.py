"""`SampledSensor`: its settings found again in records that it made, and what a record holds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import retwin as rt
from retwin import catalog
from retwin.serialisation.configs import from_config, to_config

KINDS = catalog.classes(catalog.CORRECTIONS)

pytestmark = pytest.mark.numerical

STEPS, RATE = 600, 100.0
ERRORS = tuple(np.linspace(-0.004, 0.004, 33).tolist())


def paths(n: int = 12) -> Tensor:
    """Smooth outputs that rest now and then, (n, STEPS, 2)."""
    rng = np.random.default_rng(0)
    time = np.arange(STEPS)
    out = np.zeros((n, STEPS, 2))
    for start in (50, 250, 450):
        ramp = np.clip((time - start) / 60, 0, 1)
        out += rng.uniform(-1, 1, (n, 1, 2)) * (3 * ramp**2 - 2 * ramp**3)[:, None]
    return torch.tensor(out)


def everything(outputs: Tensor) -> Tensor:
    return torch.ones(outputs.shape, dtype=torch.bool)


def segments_of(n: int) -> rt.Segments:
    start = np.tile([50.0, 250.0, 450.0], (n, 1))
    stop = np.tile([250.0, 450.0, 600.0], (n, 1))
    return rt.Segments(start, start + 60, stop, np.ones((n, 3), dtype=bool), STEPS)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(("every", "phases"), [(10, (0,)), (7, (3,)), (10, (2, 5)), (4, (1,))])
def test_timing_is_found_again(every: int, phases: tuple[int, ...]) -> None:
    made = rt.SampledSensor(
        every / RATE, tuple(each / RATE for each in phases), noise=(ERRORS, ERRORS)
    )
    record = made.read(paths(), generator(), RATE)
    found = rt.SampledSensor().timed(record, everything(record), RATE)
    assert found.timing(RATE) == (every, phases)


def test_a_record_of_every_sample_has_no_period() -> None:
    path = paths()
    noisy = path + 0.001 * torch.tensor(np.random.default_rng(1).normal(size=path.shape))
    for record in (path, noisy):
        assert rt.SampledSensor().timed(record, everything(record), RATE).period == 1 / RATE


def test_errors_glitches_and_rounding_are_found_again() -> None:
    n = 60
    made = rt.SampledSensor(
        period=0.05, phases=(0.02,), noise=(ERRORS, (0.0, 0.0)), steps=(0.0, 0.05),
        glitch_probability=0.02, glitch_size=(0.5, 0.0),
    )  # fmt: skip
    path = paths(n)
    record = made.read(path, generator(), RATE)
    found = rt.SampledSensor().fitted(record, everything(record), path, segments_of(n), RATE)
    assert found.steps == (0.0, pytest.approx(0.05, rel=1e-6))
    assert found.glitch_probability == pytest.approx(0.02, abs=0.01)
    assert found.glitch_size[0] == pytest.approx(0.5, rel=0.4)
    # Evenly spread between -0.004 and 0.004: quartiles half-way.
    assert found.noise[0][8] == pytest.approx(-0.002, rel=0.15)
    assert found.noise[0][24] == pytest.approx(0.002, rel=0.15)


def test_what_is_given_is_kept() -> None:
    path = paths()
    given = rt.SampledSensor(
        period=0.03, phases=(0.01,), glitch_probability=0.25, noise=(ERRORS, ERRORS)
    )
    found = given.fitted(path, everything(path), path, segments_of(len(path)), RATE)
    kept = (found.period, found.phases, found.glitch_probability, found.noise)
    assert kept == (0.03, (0.01,), 0.25, (ERRORS, ERRORS))


def test_a_record_joins_samples_by_straight_lines() -> None:
    path = torch.arange(23.0)[None, :, None] ** 2
    record = rt.SampledSensor(period=0.05, phases=(0.02,)).read(path, generator(), RATE)
    at = [2, 7, 12, 17, 22]
    expected = np.interp(np.arange(23), at, np.square(at))
    np.testing.assert_allclose(record[0, :, 0], expected, atol=1e-4)
    cut = rt.SampledSensor(period=0.05, phases=(0.02,)).read(path[:, :21], generator(), RATE)
    assert (cut[0, 17:, 0] == 17.0**2).all(), "after its last sample a record stays"


def test_only_samples_of_the_sensor_count() -> None:
    path = paths()
    mask = everything(path)
    mask[0, :100] = False
    read = rt.SampledSensor(period=0.1, phases=(0.04,)).sample_mask(path, mask, RATE)
    time = np.flatnonzero(read[1].all(dim=-1))
    np.testing.assert_array_equal(time, np.arange(4, STEPS, 10))
    assert not read[0, :100].any()
    several = rt.SampledSensor(period=0.1, phases=(0.02, 0.05))
    record = several.read(path, generator(), RATE)
    sampled = several.sample_mask(record, everything(record), RATE)
    first = sampled.all(dim=-1).int().argmax(dim=1)
    assert set(first.tolist()) == {2, 5}


def test_errors_are_those_of_a_sample_and_drawn_from_their_distribution() -> None:
    still = torch.zeros(400, 100, 1, dtype=torch.float64)
    sensor = rt.SampledSensor(period=0.1, phases=(0,), noise=((-1.0, 0.0, 0.0, 0.0, 1.0),))
    record = sensor.read(still, generator(), RATE)
    samples = record[:, ::10].flatten()
    assert (samples == 0).double().mean() == pytest.approx(0.5, abs=0.03)
    assert samples.abs().max() <= 1
    torch.testing.assert_close(record, sensor.read(still, generator(), RATE), rtol=0, atol=0)


def test_gradients_pass_through_rounding() -> None:
    path = paths(2).requires_grad_()
    record = rt.SampledSensor(period=0.1, phases=(0,), steps=(0.1, 0.1)).read(
        path, generator(), RATE
    )
    record.sum().backward()
    assert path.grad is not None
    assert path.grad[:, ::10].abs().sum() > 0


def test_settings_survive_json_and_bad_ones_are_refused() -> None:
    sensor = rt.SampledSensor(
        period=0.05, phases=(0.02,), noise=(ERRORS, ERRORS), glitch_probability=0.1
    )
    assert from_config(to_config(sensor, KINDS), KINDS) == sensor
    for bad in (
        {"period": 0.0},
        {"period": 0.05, "phases": (0.05,)},
        {"phases": (1,)},
        {"steps": (-1.0,)},
        {"noise": ((1.0, 0.0),)},
        {"glitch_probability": 1.5},
    ):
        with pytest.raises(rt.InputError, match="sensor: expected"):
            rt.SampledSensor(**bad)
    with pytest.raises(
        rt.InputError, match=r"sensor.period: expected a whole number of time steps"
    ):
        rt.SampledSensor(period=0.025).read(paths(), generator(), RATE)
    with pytest.raises(rt.InputError, match="timing is known"):
        rt.SampledSensor().sample_mask(paths(), everything(paths()), RATE)
