"""ROC curves, compared with scikit-learn's."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score, roc_curve

from retwin.scores.roc import micro_roc

pytestmark = pytest.mark.numerical


def test_micro_roc_is_scikit_learns() -> None:
    rng = np.random.default_rng(7)
    truth = np.repeat(np.arange(9), 10)
    probabilities = rng.dirichlet(np.ones(9), size=(4, 90)) + 0.3 * np.eye(9)[truth]
    positive = np.eye(9)[truth].ravel()
    found = micro_roc(probabilities, truth)
    wanted = [roc_auc_score(positive, run.ravel()) for run in probabilities]
    np.testing.assert_allclose(found.areas, wanted, atol=1e-9)
    false, true, _ = roc_curve(positive, probabilities[0].ravel(), drop_intermediate=False)
    one = micro_roc(probabilities[:1], truth)
    middle = one.false_positive[1:-1]
    upper = np.array([true[false == each].max() for each in np.unique(false)])
    wanted = np.interp(middle, np.unique(false), upper)
    np.testing.assert_allclose(one.mean[1:-1], wanted, atol=1e-9)


def test_micro_roc_of_perfect_and_constant_answers() -> None:
    truth = np.array([0, 1, 2, 0, 1, 2])
    perfect = micro_roc(np.eye(3)[truth][None], truth)
    assert perfect.areas == pytest.approx([1.0])
    assert np.all(perfect.mean == 1)
    constant = micro_roc(np.full((2, 6, 3), 1 / 3), truth)
    assert constant.areas == pytest.approx([0.5, 0.5])
    np.testing.assert_allclose(constant.mean, constant.false_positive)
