"""`evaluate` scores probabilities, and refuses what cannot be scored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import retwin as rt


@dataclass(frozen=True)
class Given:
    """A diagnoser whose probabilities are given."""

    probabilities: np.ndarray
    classes: tuple[str, ...] = ("Healthy", "Fault")

    def predict_proba(self, trajectories: rt.Trajectories) -> np.ndarray:
        return self.probabilities


@pytest.fixture
def test_set() -> rt.Trajectories:
    commands = np.zeros((4, 5, 1))
    labels = np.array(["Healthy", "Healthy", "Fault", "Fault"])
    return rt.Trajectories(commands, commands, commands, rate=1.0, labels=labels)


def test_scores_are_those_of_the_probabilities(test_set: rt.Trajectories) -> None:
    first = np.array([0.9, 0.4, 0.1, 0.2])
    scores = rt.evaluate(Given(np.stack([first, 1 - first], axis=1)), test_set)
    assert (scores.accuracy, scores.healthy_recall, scores.n) == (0.75, 0.5, 4)
    assert scores.auroc == 1.0


def test_probabilities_that_are_not_finite_are_no_class(test_set: rt.Trajectories) -> None:
    probabilities = np.full((4, 2), 0.5)
    probabilities[2] = np.nan
    with pytest.raises(rt.InputError, match=r"probabilities: .* NaN for "):
        rt.evaluate(Given(probabilities), test_set)


def test_unknown_labels_are_refused(test_set: rt.Trajectories) -> None:
    other = test_set.replace(labels=np.array(["Healthy", "Other", "Fault", "Fault"]))
    with pytest.raises(rt.InputError, match="test: expected labels among Healthy, Fault"):
        rt.evaluate(Given(np.full((4, 2), 0.5)), other)
