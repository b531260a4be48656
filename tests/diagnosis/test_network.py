from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.nets.training import Training

SMALL = rt.CNN(channels=(16, 32))
SHORT = Training(max_epochs=15, batch_size=32, learning_rate=5e-3)


@pytest.fixture(scope="module")
def training(case: rt.Case, ibg: rt.Surrogate) -> rt.Trajectories:
    made = rt.generate(ibg, case, per_class=60, seed=0)
    return made[np.isin(made.labels, ["Healthy", "Motor_1_Stuck", "Motor_2_Steady_state_error"])]


@pytest.fixture(scope="module")
def cnn(training: rt.Trajectories) -> rt.NetworkDiagnoser:
    return rt.fit_diagnoser(training, SMALL, seed=0, training=SHORT)


def test_learns_classes_that_differ(
    cnn: rt.NetworkDiagnoser, case: rt.Case, ibg: rt.Surrogate
) -> None:
    test = rt.generate(ibg, case, per_class=20, seed=1)
    test = test[np.isin(test.labels, cnn.classes)]
    scores = rt.evaluate(cnn, test)
    assert scores.macro_f1 > 0.9
    assert scores.n == 60


def test_is_a_diagnoser(cnn: rt.NetworkDiagnoser, training: rt.Trajectories) -> None:
    assert isinstance(cnn, rt.Diagnoser)
    unlabelled = training[:7].replace(labels=None)
    probabilities = cnn.predict_proba(unlabelled)
    assert probabilities.shape == (7, 3)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1)


def test_features_have_the_true_sensor_rate(
    cnn: rt.NetworkDiagnoser, training: rt.Trajectories
) -> None:
    assert cnn.features(training[:2]).shape == (2, 100, 6)
    np.testing.assert_allclose(
        cnn.features(training[:2])[:, :, 3:].numpy(), training.residual[:2, ::10], atol=1e-6
    )


def test_missing_samples_are_zero_residual(
    cnn: rt.NetworkDiagnoser, training: rt.Trajectories
) -> None:
    mask = training.mask[:1].copy()
    mask[:, 500:] = False
    holes = training[:1].replace(mask=mask)
    assert (cnn.features(holes)[0, 50:, 3:] == 0).all()


def test_same_seed_same_bytes(training: rt.Trajectories, tmp_path: Path) -> None:
    for name in ("a", "b"):
        rt.fit_diagnoser(training, SMALL, seed=2, training=Training(max_epochs=2)).save(
            tmp_path / name
        )
    for file in ("model.json", "weights.safetensors"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_saved_and_loaded_is_the_same(
    cnn: rt.NetworkDiagnoser, training: rt.Trajectories, tmp_path: Path
) -> None:
    cnn.save(tmp_path / "cnn")
    back = rt.NetworkDiagnoser.load(tmp_path / "cnn")
    assert back.classes == cnn.classes
    np.testing.assert_array_equal(back.predict_proba(training[:5]), cnn.predict_proba(training[:5]))


def test_classes_keep_the_order_given(training: rt.Trajectories, case: rt.Case) -> None:
    named = rt.fit_diagnoser(
        training, SMALL, seed=0, classes=case.classes, training=Training(max_epochs=1)
    )
    assert named.classes == case.classes
    assert named.predict_proba(training[:2]).shape == (2, 9)


def test_the_paper_s_lstm_trains(training: rt.Trajectories) -> None:
    model = rt.fit_diagnoser(
        training, rt.LSTMClassifier(16), seed=0, training=Training(max_epochs=2, batch_size=16)
    )
    assert np.isfinite(model.predict_proba(training[:3])).all()


def test_bad_input_is_refused(cnn: rt.NetworkDiagnoser, training: rt.Trajectories) -> None:
    with pytest.raises(rt.InputError, match=r"unknown \['Motor_1_Stuck'"):
        rt.fit_diagnoser(training, SMALL, seed=0, classes=["Healthy", "Other"])
    with pytest.raises(rt.InputError, match="label every trajectory"):
        rt.fit_diagnoser(training.replace(labels=None), SMALL, seed=0)
    with pytest.raises(rt.InputError, match=r"trajectories.rate: expected .* 100.0, got 50.0"):
        cnn.predict_proba(training.replace(rate=50.0))
    for rate in (0.0, -5.0, 40.0, 200.0):
        with pytest.raises(rt.InputError, match="rate: expected 100 Hz"):
            rt.fit_diagnoser(training, SMALL, seed=0, rate=rate)
    with pytest.raises(rt.InputError, match="labels among"):
        rt.evaluate(cnn, training.replace(labels=np.array(["Another"] * len(training))))


def test_a_diagnoser_of_any_kind_is_loaded_by_its_kind(
    cnn: rt.NetworkDiagnoser, ibg: rt.Surrogate, tmp_path: Path
) -> None:
    cnn.save(tmp_path / "cnn")
    assert isinstance(rt.load_diagnoser(tmp_path / "cnn"), rt.NetworkDiagnoser)
    ibg.save(tmp_path / "surrogate")
    for folder in ("surrogate", "missing"):
        with pytest.raises(rt.InputError, match="a diagnoser model"):
            rt.load_diagnoser(tmp_path / folder)
