"""Black-box models of systems whose equations are known, from outputs and commands alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.errors import InputError
from retwin.testing import TWIN_CHECKS, TwinSubject
from retwin.update import (
    BlackBox,
    CorrectedTwin,
    DynamicsTwin,
    OutsideTrainingWarning,
    fit_black_box,
)
from retwin.update.blackbox.narx import forward

pytestmark = pytest.mark.slow

RATE = 10.0
NOISE = 0.01
SETTLED = 40
Step = Callable[[float, float, float, float], float]
"""The output from the last two outputs and commands, the latest first."""


def linear(y: float, before: float, u: float, earlier: float) -> float:
    return 1.5 * y - 0.7 * before + 0.2 * u + 0.1 * earlier


def bilinear(y: float, before: float, u: float, earlier: float) -> float:
    return 0.6 * y + 0.2 * u + 0.3 * y * u - 0.1 * y**2 + 0.1


def saturating(y: float, before: float, u: float, earlier: float) -> float:
    return 0.8 * y + 0.3 * np.tanh(3 * u)


def record(step: Step, seed: int = 0, count: int = 2, samples: int = 300) -> rt.Trajectories:
    """Noisy outputs of a system that begins at rest; the exact ones are nominal."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, (count, samples // 4)), 4, axis=1)
    y = np.zeros((count, samples))
    for i in range(count):
        for k in range(2, samples):
            y[i, k] = step(y[i, k - 1], y[i, k - 2], u[i, k - 1], u[i, k - 2])
    return rt.Trajectories(
        commands=u[..., None],
        nominal=y[..., None],
        observed=(y + NOISE * rng.normal(size=y.shape))[..., None],
        rate=RATE,
        inputs=rt.Channels(("u",), ("V",)),
        outputs=rt.Channels(("y",), ("m",)),
    )


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def error(model: BlackBox, test: rt.Trajectories) -> float:
    """The error of free simulation from commands alone, once the start is forgotten."""
    return rms((model.twin.simulate(test.commands, seed=0).nominal - test.nominal)[:, SETTLED:])


@pytest.fixture(scope="module")
def arx() -> BlackBox:
    return fit_black_box(record(linear), "arx")


@pytest.fixture(scope="module")
def narx() -> BlackBox:
    return fit_black_box(record(bilinear), "narx")


def test_a_linear_system_is_recovered(arx: BlackBox) -> None:
    test = record(linear, seed=1)
    assert arx.figures["order"] == 2
    assert arx.figures["held_out"] == pytest.approx(NOISE, rel=0.15)
    assert error(arx, test) < 0.3 * NOISE
    response = arx.twin.simulate(np.ones((1, 60, 1)), seed=0).nominal[0, -1, 0]
    assert response == pytest.approx(0.3 / 0.2, rel=0.02), "the gain at rest"


@pytest.mark.slow
def test_bands_hold_as_many_samples_as_they_should(arx: BlackBox) -> None:
    test = record(linear, seed=1)
    made = arx.twin.simulate(np.repeat(test.commands[:1], 300, axis=0), seed=0).observed
    low, high = np.quantile(made, [0.05, 0.95], axis=0)
    inside = (low <= test.observed[0]) & (test.observed[0] <= high)
    assert 0.85 < inside.mean() < 0.95


def test_a_polynomial_system_is_recovered(narx: BlackBox) -> None:
    test = record(bilinear, seed=1)
    assert narx.figures["held_out"] == pytest.approx(NOISE, rel=0.15)
    names = [each.name for each in narx.twin.equations.parameters]
    assert {"y: y[k-1] u[k-1]", "y: y[k-1]^2"} <= set(names)
    alone = fit_black_box(record(bilinear), "arx")
    assert error(narx, test) < 0.5 * NOISE < 5 * NOISE < error(alone, test)


@pytest.mark.slow
def test_a_network_learns_a_saturation() -> None:
    calibration, test = record(saturating, count=1), record(saturating, seed=1)
    alone = fit_black_box(calibration, "arx")
    network = fit_black_box(calibration, "neural_ss")
    assert error(network, test) < 0.3 * error(alone, test)


@pytest.mark.slow
def test_an_lstm_learns_a_saturation(tmp_path: Path) -> None:
    calibration, test = record(saturating), record(saturating, seed=1)
    alone, lstm = (fit_black_box(calibration, kind) for kind in ("arx", "lstm"))
    assert isinstance(lstm.twin, CorrectedTwin)
    mean = replace(lstm.twin, random=False).simulate(test.commands, seed=0).observed
    assert rms((mean - test.nominal)[:, SETTLED:]) < 0.8 * error(alone, test)
    lstm.twin.save(tmp_path / "model")
    again = CorrectedTwin.load(tmp_path / "model").simulate(test.commands, seed=0)
    assert np.array_equal(again.observed, lstm.twin.simulate(test.commands, seed=0).observed)
    with pytest.warns(OutsideTrainingWarning):
        lstm.twin.simulate(3 * test.commands, seed=0)
    with pytest.raises(InputError, match="outputs that do not: y"):
        fit_black_box(calibration.replace(observed=np.ones_like(test.observed)), "lstm")


@pytest.mark.slow
def test_the_seed_determines_a_network() -> None:
    few = record(saturating, count=1, samples=100)
    made = [fit_black_box(few, "neural_ss", seed=seed).twin.values for seed in (0, 0, 1)]
    assert np.array_equal(made[0], made[1])
    assert not np.array_equal(made[0], made[2])


def test_samples_that_are_masked_are_not_used(arx: BlackBox) -> None:
    whole = record(linear)
    mask = whole.mask.copy()
    mask[:, 100:180] = False
    damaged = whole.replace(observed=np.where(mask, whole.observed, 1e6), mask=mask)
    found = fit_black_box(damaged, "arx")
    assert found.figures["order"] == 2
    assert error(found, record(linear, seed=1)) < 0.5 * NOISE
    sparse = np.arange(whole.steps)[None, :, None] % 2 == 0
    with pytest.raises(InputError, match="consecutive samples"):
        fit_black_box(whole.replace(mask=whole.mask & sparse), "narx")


def test_records_of_several_lengths_and_starts_are_fitted() -> None:
    long, short = record(linear, count=1), record(linear, seed=2, count=1, samples=200)
    begun = short.between(3.0)  # not at rest at its first sample
    both = rt.Trajectories.concatenate([long, begun])
    found = fit_black_box(both, "arx")
    assert found.figures["rms"] == pytest.approx(NOISE, rel=0.1)
    after = found.twin.started(begun.between(0, 5)).simulate(begun.commands, seed=0)
    assert rms(after.nominal - begun.nominal) < NOISE


@pytest.mark.slow
def test_two_outputs_and_two_commands() -> None:
    first, second = record(linear, count=1), record(bilinear, seed=3, count=1)
    parts = {
        name: np.concatenate([getattr(each, name) for each in (first, second)], axis=2)
        for name in ("commands", "nominal", "observed", "mask")
    }
    channels = {name: rt.Channels.numbered(name[0], 2) for name in ("inputs", "outputs")}
    both = first.replace(**parts, **channels)
    found = fit_black_box(both, "arx")
    made = found.twin.simulate(both.commands, seed=0).nominal
    errors = np.sqrt(np.mean((made - both.nominal)[:, SETTLED:] ** 2, axis=(0, 1)))
    assert errors[0] < NOISE < errors[1], "the second system is not linear"


def test_a_simulation_beyond_the_records_is_bounded_and_warns(narx: BlackBox) -> None:
    commands = np.full((1, 200, 1), 40.0)
    with pytest.warns(OutsideTrainingWarning):
        made = narx.twin.simulate(commands, seed=0)
    height = np.ptp(record(bilinear).observed)
    assert np.abs(made.nominal).max() < 5 * height


def test_what_cannot_be_learned_from_is_refused() -> None:
    def growing(y: float, before: float, u: float, earlier: float) -> float:
        return 8 * y + u

    good = record(linear)
    with pytest.raises(InputError, match="diverges"):
        fit_black_box(record(growing, samples=20), "arx")
    with pytest.raises(InputError, match="outputs that do not: y"):
        fit_black_box(good.replace(observed=np.ones_like(good.observed)), "arx")
    with pytest.raises(InputError, match="no commands"):
        fit_black_box(good.replace(commands=good.commands[..., :0], inputs=None), "arx")
    with pytest.raises(InputError, match="consecutive"):
        fit_black_box(good.between(0, 1.5)[:1], "neural_ss")
    with pytest.raises(InputError, match="kind"):
        fit_black_box(good, "arma")
    with pytest.raises(InputError, match="seed"):
        fit_black_box(good, "arx", seed=-1)


@pytest.mark.filterwarnings("ignore::retwin.update.OutsideTrainingWarning")
@pytest.mark.parametrize("check", TWIN_CHECKS, ids=lambda each: each.__name__)
def test_a_model_is_a_twin(narx: BlackBox, check: Callable, tmp_path: Path) -> None:
    narx.twin.save(tmp_path / "model")
    loaded = DynamicsTwin.load(tmp_path / "model")
    commands = record(bilinear, seed=1).commands
    assert np.array_equal(
        loaded.simulate(commands, seed=3).observed, narx.twin.simulate(commands, seed=3).observed
    )
    check(TwinSubject(loaded, commands))


def test_terms_are_chosen_in_the_order_of_what_they_explain() -> None:
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(500, 30))
    columns[:, 7] = columns[:, 3] + columns[:, 5]  # a combination of two that are chosen
    target = 3 * columns[:, 5] + 2 * columns[:, 3] + columns[:, 11] + rng.normal(size=500)
    first, *chosen = forward(columns, target, 20, [0])
    assert (first, chosen[0]) == (0, 7)
    assert 11 in chosen[:3]
    assert len({3, 5} & set(chosen)) == 1, "the third is a combination of the other two"
    assert len(chosen) < 6
    assert len(forward(columns, target, 2, [0])) == 2
