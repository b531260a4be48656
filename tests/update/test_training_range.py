"""A warning, once per call, where a surrogate is used for commands that it was not trained on."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.evaluation.fidelity.overlay import predictive_overlay
from retwin.nets.training import Training
from retwin.twins import NoisyTwin, RampSampler
from retwin.update import OutsideTrainingWarning

CHANNELS = rt.Channels(("u", "v"), ("deg", "1")), rt.Channels(("x", "y"), ("m", "m"))
TWIN = rt.FunctionTwin(lambda u: np.sin(u / 60), *CHANNELS, rate=20.0)
SAMPLER = RampSampler((-80.0, -80.0), (80.0, 80.0), rate=20.0, duration=12.0, segments=4)
BRIEF = rt.Mixture(components=1, hidden=(4,), training=Training(max_epochs=3))


def commands(count: int, scale: float = 1.0) -> np.ndarray:
    drawn = SAMPLER.sample(count, rng=np.random.default_rng(6))
    return scale * drawn * (80.0 / np.abs(drawn[..., 0]).max())


@pytest.fixture(scope="module")
def surrogate() -> rt.Surrogate:
    drawn = SAMPLER.sample(100, rng=np.random.default_rng(0))
    training = Training(max_epochs=40, batch_size=256, learning_rate=5e-3)
    return rt.fit_surrogate(TWIN.simulate(drawn, seed=0), rt.MLP((32,)), seed=0, training=training)


def measured(scale: float = 1.0) -> rt.Trajectories:
    """Six trajectories, in each of which the commands are executed with other errors."""
    offset = np.random.default_rng(1).normal(0, 10, size=(6, 1, 2))
    sent = commands(6, scale)
    made = TWIN.simulate(sent + offset, seed=0)
    return made.replace(commands=sent, nominal=TWIN.simulate(sent, seed=0).nominal)


@pytest.fixture(scope="module")
def updated(surrogate: rt.Surrogate) -> rt.CorrectedTwin:
    residual = rt.fit_residual(surrogate, measured(), rt.CommandSpace(), BRIEF, seed=0)
    return rt.CorrectedTwin(surrogate, residual)


USES: dict[str, Callable[[rt.CorrectedTwin, float], object]] = {
    "predict": lambda twin, scale: twin.surrogate.predict(commands(3, scale)),
    "simulate": lambda twin, scale: twin.surrogate.simulate(commands(300, scale), seed=0),
    "corrected": lambda twin, scale: twin.simulate(commands(300, scale), seed=0),
    "infer": lambda twin, scale: rt.infer_discrepancy(
        twin.surrogate, measured(scale), rt.DelayOffset()
    ),
    "fit": lambda twin, scale: rt.fit_residual(
        twin.surrogate, measured(scale), rt.CommandSpace(), BRIEF, seed=0
    ),
    "invert": lambda twin, scale: rt.fit_inversion(
        twin.surrogate, twin.residual, measured(scale), FAULTS
    ),
    "overlay": lambda twin, scale: predictive_overlay(
        twin, measured(scale), draws=3, seed=0, rate=20.0
    ),
}
FAULTS = {"Healthy": None, "Bias": rt.ActuatorBias(0, size=(10.0, 20.0))}


@pytest.mark.slow
@pytest.mark.parametrize("use", USES)
def test_commands_beyond_the_training_warn_once_per_call(
    use: str, updated: rt.CorrectedTwin
) -> None:
    USES[use](updated, 1.0)  # warnings are errors
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        USES[use](updated, 106 / 80)
    outside = [each for each in given if issubclass(each.category, OutsideTrainingWarning)]
    assert len(outside) == 1
    text = str(outside[0].message)
    assert re.search(r"u is -?10[56].* \(training: -\d", text)
    assert "in deg)" in text
    assert "fit_surrogate" in text


# Bands hold too little where the surrogate extrapolates, which is said besides.
@pytest.mark.filterwarnings("ignore:correction. bands of 90 %")
@pytest.mark.slow
def test_what_was_outside_stands_in_the_results(
    updated: rt.CorrectedTwin, surrogate: rt.Surrogate
) -> None:
    far = measured(106 / 80)
    with pytest.warns(OutsideTrainingWarning):
        residual = rt.fit_residual(surrogate, far, rt.CommandSpace(), BRIEF, seed=0)
    assert re.search("outside the surrogate's training: u is -?106", residual.fitted.reason)
    diagnoser = rt.fit_inversion(surrogate, updated.residual, measured(), FAULTS)
    mixed = rt.Trajectories.concatenate([measured()[1:3], far[:1]])
    with pytest.warns(OutsideTrainingWarning):
        found = diagnoser.diagnose(mixed)
    np.testing.assert_array_equal(found.outside, [False, False, True])


def test_a_range_is_saved_and_one_that_does_not_fit_is_refused(
    surrogate: rt.Surrogate, tmp_path: Path
) -> None:
    surrogate.save(tmp_path / "m")
    assert rt.Surrogate.load(tmp_path / "m").trained == surrogate.trained
    file = tmp_path / "m" / "model.json"
    about = json.loads(file.read_text())
    about["trained"]["low"] = [0.0]
    file.write_text(json.dumps(about))
    with pytest.raises(rt.InputError, match="one per input channel, 1, got 2"):
        rt.Surrogate.load(tmp_path / "m")


def test_faster_commands_and_an_exact_twin(surrogate: rt.Surrogate) -> None:
    with pytest.warns(OutsideTrainingWarning, match="changes by"):
        surrogate.predict(commands(3)[:, ::3])
    rt.infer_discrepancy(TWIN, measured(2.0), rt.DelayOffset())


def test_a_surrogate_within_another_twin_checks_its_commands(surrogate: rt.Surrogate) -> None:
    noisy = NoisyTwin(surrogate, np.array([0.001, 0.001]))
    with pytest.warns(OutsideTrainingWarning, match="of the surrogate: u is"):
        rt.measure_fidelity(noisy, measured(106 / 80), draws=20, seed=0)
