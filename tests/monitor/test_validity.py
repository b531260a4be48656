"""The test of a monitor's assumption in quiet times."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.monitor import Detector, Location, Scale, Slack, Validity

FEW = ((Location(1.0), Location(-1.0)), (Scale(2.0), Scale(0.5)))


def ever_void(test: Validity, scores: NDArray, alarms: NDArray | bool = False) -> NDArray:
    alarms = np.broadcast_to(alarms, scores.shape)
    state, _ = test.run(test.start(len(scores)), alarms, scores)
    return test.void(state)


def test_a_valid_promise_is_declared_void_with_a_probability_below_alpha() -> None:
    rng = np.random.default_rng(0)
    test = Validity(Detector(alternatives=FEW), 500.0, alpha=0.2, block=20)
    scores = rng.normal(size=(200, 1000))
    # Detector and test together: alarms are those of the detector, which is then reset.
    detector = test.detector
    state, tested = detector.start(200), test.start(200)
    count = 0
    for t in range(1000):
        state, evidence = detector.step(state, scores[:, t])
        alarm = evidence >= test.arl
        count += alarm.sum()
        tested, _ = test.step(tested, alarm, scores[:, t])
        state = detector.reset(state, alarm)
    assert 20 < count < 200 * 1000 / 500
    assert test.void(tested).mean() <= 0.2 + 2 * np.sqrt(0.16 / 200)


@pytest.mark.parametrize(("scale", "shift"), [(2.0, 0.0), (0.3, 0.0), (1.0, 1.0)])
def test_a_wrong_class_without_alarms_is_void_within_hundreds_of_samples(
    scale: float, shift: float
) -> None:
    scores = np.random.default_rng(1).normal(shift, scale, (20, 1500))
    test = Validity(Detector(Slack(1.1, 0.2), alternatives=FEW), 1e6)
    assert ever_void(test, scores).all()
    assert not ever_void(test, scores[:, :600]).any(), "seven blocks are not enough"
    assert not ever_void(Validity(Detector(Slack(2.2, 1.2), alternatives=FEW), 1e6), scores).any()


def test_a_fault_that_is_alarmed_voids_nothing() -> None:
    scores = np.random.default_rng(2).normal(size=(20, 1500))
    scores[:, 700:900] += 4
    alarms = np.zeros(scores.shape, dtype=bool)
    alarms[:, 705] = True
    scores[:, 706:900] = np.nan  # blanked
    assert not ever_void(Validity(Detector(alternatives=FEW), 1e6), scores, alarms).any()


def test_alarms_after_every_reset_void_the_promise() -> None:
    scores = np.zeros((1, 200))
    alarms = np.zeros((1, 200), dtype=bool)
    alarms[:, 20:161:20] = True
    test = Validity(Detector(Slack(1.5, 0.5), alternatives=FEW), 1e6)
    assert ever_void(test, scores, alarms).all()
    assert not ever_void(test, scores[:, :75], alarms[:, :75]).any(), "three alarms are not enough"


def test_steps_and_blocks_give_the_same_bytes_and_void_stays() -> None:
    rng = np.random.default_rng(3)
    scores = np.concatenate([rng.normal(0, 3, (3, 900)), rng.normal(size=(3, 300))], axis=1)
    scores[rng.random(scores.shape) < 0.1] = np.nan
    scores[0, :5] = [1e300, -np.inf, np.inf, 0, 0]
    test = Validity(Detector(Slack(1.1, 0.2), alternatives=FEW), 1e4, block=50)
    alarms = rng.random(scores.shape) < 0.002
    whole, evidence = test.run(test.start(3), alarms, scores)
    state, steps = test.start(3), []
    for t in range(scores.shape[1]):
        state, found = test.step(state, alarms[:, t], scores[:, t])
        steps.append(found)
    assert np.array(steps).T.tobytes() == evidence.tobytes()
    for name, value in vars(whole).items():
        assert getattr(state, name).tobytes() == value.tobytes(), name
    assert test.void(state).all()
    assert np.isfinite(evidence).all()


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match="alpha"):
        Validity(Detector(), 1e4, alpha=0)
    with pytest.raises(InputError, match="detector: expected Detector"):
        Validity(None, 1e4)  # type: ignore[arg-type]
