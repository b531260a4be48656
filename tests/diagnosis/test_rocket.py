from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.diagnosis import RocketDiagnoser
from retwin.testing import check_diagnoser

# Not imported, which takes seconds in every worker.
pytestmark = [
    pytest.mark.slow,  # sktime compiles for most of a minute
    pytest.mark.skipif(
        not (find_spec("numba") and find_spec("sktime")), reason="needs retwin[rocket]"
    ),
]

SMALL = rt.Rocket(504)


def toy(count: int, *, seed: int, noise: float = 0.3) -> rt.Trajectories:
    """Three classes of residuals in noise: none, a slow wave and a fast one."""
    rng = np.random.default_rng(seed)
    kind = np.resize([0, 1, 2], count)
    time = np.arange(500) / 100.0
    wave = np.sin(2 * np.pi * (0.4 * 2 ** kind[:, None] * time + rng.random((count, 1))))
    residual = (kind > 0)[:, None] * wave + noise * rng.normal(size=(count, 500))
    nominal = np.tile(np.clip(time / 2, 0, 1), (count, 1))[:, :, None]
    labels = np.array(["none", "slow", "quick"])[kind]
    return rt.Trajectories(
        nominal, nominal, nominal + residual[:, :, None], rate=100.0, labels=labels
    )


@pytest.fixture(scope="module")
def rocket() -> RocketDiagnoser:
    return rt.fit_diagnoser(toy(240, seed=0), SMALL, seed=0)


def test_learns_classes_that_differ(rocket: RocketDiagnoser) -> None:
    assert rt.evaluate(rocket, toy(90, seed=1)).macro_f1 > 0.95


def test_probabilities_are_calibrated() -> None:
    """Noise often hides the waves, so that the probabilities are well below 1."""
    noisy = rt.fit_diagnoser(toy(600, seed=0, noise=1.5), SMALL, seed=0)
    test = toy(600, seed=1, noise=1.5)
    probabilities = noisy.predict_proba(test)
    correct = np.array(noisy.classes)[probabilities.argmax(axis=1)] == test.labels
    assert 0.5 < correct.mean() < 0.95
    # Two standard errors: 0.04 each, most of it from the 120 that set the temperature.
    assert abs(probabilities.max(axis=1).mean() - correct.mean()) < 0.08


def test_is_a_diagnoser(rocket: RocketDiagnoser) -> None:
    check_diagnoser(rocket, toy(5, seed=2))


def test_what_is_not_finite_has_no_probabilities(rocket: RocketDiagnoser) -> None:
    weights = {**rocket.weights, "mean": torch.full_like(rocket.weights["mean"], np.nan)}
    broken = RocketDiagnoser(
        rocket.features,
        classes=rocket.classes,
        samples=rocket.samples,
        weights=weights,
        figures={},
    )
    assert np.isnan(broken.predict_proba(toy(5, seed=2))).all()


def test_saved_and_loaded_is_the_same(rocket: RocketDiagnoser, tmp_path: Path) -> None:
    test = toy(9, seed=3)
    rocket.save(tmp_path / "rocket")
    back = rt.load_diagnoser(tmp_path / "rocket")
    assert isinstance(back, RocketDiagnoser)
    assert (back.classes, back.features) == (rocket.classes, rocket.features)
    np.testing.assert_array_equal(back.predict_proba(test), rocket.predict_proba(test))
    with pytest.raises(rt.InputError, match="a diagnoser model"):
        rt.NetworkDiagnoser.load(tmp_path / "rocket")


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        rt.fit_diagnoser(toy(60, seed=0), rt.Rocket(84), seed=seed).save(tmp_path / name)
    for file in ("model.json", "weights.safetensors"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    a, c = (tmp_path / name / "weights.safetensors" for name in "ac")
    assert a.read_bytes() != c.read_bytes()


def test_classes_keep_the_order_given() -> None:
    """Two of them, for which a ridge has one row, and one that never occurs."""
    two = toy(120, seed=0)
    two = two[two.labels != "slow"]
    order = ("quick", "never", "none")
    fitted = rt.fit_diagnoser(two, SMALL, seed=0, classes=order)
    assert fitted.classes == order
    probabilities = fitted.predict_proba(two)
    assert (np.array(order)[probabilities.argmax(axis=1)] == two.labels).mean() > 0.95
    assert probabilities[:, 1].max() < 0.1


def test_bad_input_is_refused(rocket: RocketDiagnoser) -> None:
    given = toy(12, seed=0)
    with pytest.raises(rt.InputError, match="label every trajectory"):
        rt.fit_diagnoser(given.replace(labels=None), SMALL, seed=0)
    with pytest.raises(rt.InputError, match="rate: expected at least 9 samples"):
        rt.fit_diagnoser(given, SMALL, seed=0, rate=1.0)
    with pytest.raises(rt.InputError, match="training: expected none for Rocket"):
        rt.fit_diagnoser(given, SMALL, seed=0, training=rt.Training())
    with pytest.raises(rt.InputError, match="kernels: expected a multiple of 84"):
        rt.Rocket(100)
    short = given.replace(
        **{
            name: getattr(given, name)[:, :300]
            for name in ("commands", "nominal", "observed", "mask")
        }
    )
    with pytest.raises(rt.InputError, match=r"trajectories\.steps: .*60 samples"):
        rocket.predict_proba(short)
