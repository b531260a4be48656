from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.nets.training import Training
from retwin.testing import check_diagnoser

SMALL = rt.CNN(channels=(8, 16), dropout=0.0)
SHORT = Training(max_epochs=8, batch_size=16, learning_rate=1e-2)


def toy(count: int, *, seed: int, gain: float = 1.0, leak: float = 0.0) -> rt.Trajectories:
    """Two classes that differ after a motion: r is about 0.5 or -0.5, times `gain`.

    With a `leak`, the initial pose depends on the class too, in nominal and observed path.
    """
    rng = np.random.default_rng(seed)
    side = np.resize([1.0, -1.0], count)[:, None, None]
    time = np.arange(300)[None, :, None]
    start = leak * side
    commands = start + (1 - start) * np.clip((time - 20) / 60, 0, 1)
    moved = time >= 80
    residual = 0.5 * gain * side * moved + 0.1 * rng.normal(size=(count, 300, 1))
    labels = np.where(side[:, 0, 0] > 0, "high", "low")
    return rt.Trajectories(commands, commands, commands + residual, rate=100.0, labels=labels)


@pytest.fixture(scope="module")
def generated() -> rt.Trajectories:
    return toy(160, seed=0)


@pytest.fixture(scope="module")
def base(generated: rt.Trajectories) -> rt.NetworkDiagnoser:
    return rt.fit_diagnoser(generated, SMALL, seed=0, training=SHORT)


def test_learns_a_difference_that_generated_trajectories_lack(
    base: rt.NetworkDiagnoser, generated: rt.Trajectories
) -> None:
    def real(count: int, seed: int) -> rt.Trajectories:
        """The sensor has another sign and scale, and an offset."""
        inverted = toy(count, seed=seed, gain=-3.0)
        return inverted.replace(observed=inverted.observed + 2.0)

    test = real(40, seed=2)
    assert rt.evaluate(base, test).accuracy < 0.8
    before = base.predict_proba(test)
    method = rt.FineTune(base)
    few = real(8, seed=1)
    tuned = rt.fit_diagnoser(generated, method, target=few, seed=0, training=SHORT)
    assert rt.evaluate(tuned, test).accuracy > 0.95
    assert rt.evaluate(tuned, toy(40, seed=3)).accuracy > 0.95
    np.testing.assert_array_equal(base.predict_proba(test), before)


def test_the_initial_pose_has_no_effect(
    base: rt.NetworkDiagnoser, generated: rt.Trajectories
) -> None:
    leaking = toy(8, seed=1, gain=0.0, leak=0.8)
    method = rt.FineTune(base)
    tuned = rt.fit_diagnoser(generated, method, target=leaking, seed=0, training=SHORT)
    test = toy(160, seed=2, gain=0.0, leak=0.8)
    other = toy(160, seed=2, gain=0.0, leak=-0.8)
    np.testing.assert_array_equal(other.observed[:, 80:], test.observed[:, 80:])
    np.testing.assert_array_equal(tuned.predict_proba(other), tuned.predict_proba(test))
    # The classes differ in nothing else: the probability to guess three quarters of 160
    # trajectories is 1e-10.
    assert rt.evaluate(tuned, test).accuracy < 0.75
    # A network that sees the start needs nothing else.
    seeing = rt.fit_diagnoser(toy(160, seed=3, gain=0.0, leak=0.8), SMALL, seed=0, training=SHORT)
    assert rt.evaluate(seeing, test).accuracy > 0.95


def test_is_saved_with_the_start_hidden(
    base: rt.NetworkDiagnoser, generated: rt.Trajectories, tmp_path: Path
) -> None:
    real = toy(4, seed=1, leak=0.3)
    for name in ("a", "b"):
        brief = Training(max_epochs=1)
        tuned = rt.fit_diagnoser(generated, rt.FineTune(base), target=real, seed=3, training=brief)
        tuned.save(tmp_path / name)
    for file in ("model.json", "weights.safetensors"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    back = rt.NetworkDiagnoser.load(tmp_path / "a")
    assert back.features.hide_start
    assert not base.features.hide_start
    np.testing.assert_array_equal(back.predict_proba(real), tuned.predict_proba(real))
    check_diagnoser(back, toy(5, seed=4))


def test_bad_input_is_refused(base: rt.NetworkDiagnoser, generated: rt.Trajectories) -> None:
    real, method = toy(4, seed=1), rt.FineTune(base)
    with pytest.raises(rt.InputError, match="label every trajectory"):
        rt.fit_diagnoser(generated, method, target=real.replace(labels=None), seed=0)
    with pytest.raises(rt.InputError, match=r"unknown \['third'\]"):
        other = real.replace(labels=np.array(["high", "low", "low", "third"]))
        rt.fit_diagnoser(generated, method, target=other, seed=0)
    with pytest.raises(rt.InputError, match=r"trajectories\.rate"):
        rt.fit_diagnoser(generated, method, target=real.replace(rate=50.0), seed=0)
    with pytest.raises(rt.InputError, match="target: expected real trajectories for FineTune"):
        rt.fit_diagnoser(generated, method, seed=0)
    with pytest.raises(rt.InputError, match="keeps those of its base"):
        rt.fit_diagnoser(generated, method, target=real, rate=5.0, seed=0)
    with pytest.raises(rt.InputError, match="base: expected NetworkDiagnoser, got CNN"):
        rt.FineTune(SMALL)
    with pytest.raises(rt.InputError, match="generated_per_labelled: expected a whole number"):
        rt.FineTune(base, 0)
