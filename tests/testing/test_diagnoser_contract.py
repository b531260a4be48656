"""All diagnosers satisfy the contract, and each check of it can fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.nets.training import Training
from retwin.testing import DIAGNOSER_CHECKS, DiagnoserSubject, check_diagnoser

DIAGNOSERS: dict[str, Callable[[rt.Trajectories], rt.Diagnoser]] = {
    "convolutional": lambda training: rt.fit_diagnoser(
        training, rt.CNN(channels=(4, 8)), seed=0, training=Training(max_epochs=1)
    ),
    "recurrent": lambda training: rt.fit_diagnoser(
        training, rt.LSTMClassifier(4), seed=0, training=Training(max_epochs=1)
    ),
}


@pytest.fixture(scope="module")
def trajectories(twin_set: rt.Trajectories) -> rt.Trajectories:
    return twin_set[::27]


@pytest.fixture(scope="module", params=DIAGNOSERS)
def subject(
    request: pytest.FixtureRequest, twin_set: rt.Trajectories, trajectories: rt.Trajectories
) -> DiagnoserSubject:
    return DiagnoserSubject(DIAGNOSERS[request.param](twin_set), trajectories)


@pytest.mark.parametrize("check", DIAGNOSER_CHECKS, ids=lambda check: check.__name__)
def test_diagnoser(subject: DiagnoserSubject, check: Callable) -> None:
    check(subject)


@dataclass(frozen=True)
class LargestResidual:
    """A small diagnoser that is correct: which of the first two outputs has the larger residual."""

    outputs: rt.Channels
    rate: float
    classes: tuple[str, ...] = ("x", "y")

    def predict_proba(self, trajectories: rt.Trajectories) -> np.ndarray:
        for name in ("outputs", "rate"):
            if getattr(trajectories, name) != getattr(self, name):
                raise rt.InputError(
                    f"trajectories.{name}",
                    expected=f"{getattr(self, name)}",
                    got=f"{getattr(trajectories, name)}",
                    remedy="give others",
                )
        size = 1e-9 + np.abs(trajectories.residual[..., :2].astype(float)).mean(axis=1)
        return size / size.sum(axis=1, keepdims=True)


@dataclass(frozen=True)
class Modified:
    """A correct diagnoser whose probabilities are modified."""

    modify: Callable[[Callable, rt.Trajectories], np.ndarray]
    correct: LargestResidual
    classes: tuple[str, ...] = ("x", "y")

    def predict_proba(self, trajectories: rt.Trajectories) -> np.ndarray:
        return self.modify(self.correct.predict_proba, trajectories)


def forgets_to_normalise(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    return 2 * predict(trajectories)


def uses_labels(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    return np.where((trajectories.labels == "x")[:, None], [1.0, 0.0], predict(trajectories))


def subtracts_the_mean_of_all(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    return 0.5 + (predict(trajectories) - predict(trajectories).mean(axis=0)) / 4


def needs_some_measurement(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    seen = trajectories.mask.any(axis=(1, 2))
    return np.where(seen[:, None], predict(trajectories), np.nan)


def takes_any_rate(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    return predict(trajectories.replace(rate=100.0))


def uses_a_global_generator(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    share = torch.rand(1).item()
    return np.tile([share, 1 - share], (len(trajectories), 1))


BROKEN = [
    ("check_protocol", None),
    ("check_probabilities", forgets_to_normalise),
    ("check_blindness", uses_labels),
    ("check_batch", subtracts_the_mean_of_all),
    ("check_missing", needs_some_measurement),
    ("check_other_data", takes_any_rate),
    ("check_same_again", uses_a_global_generator),
]


@pytest.fixture(scope="module")
def correct(trajectories: rt.Trajectories) -> LargestResidual:
    return LargestResidual(trajectories.outputs, trajectories.rate)


@pytest.mark.parametrize(("name", "modify"), BROKEN)
def test_a_broken_diagnoser_is_caught(
    name: str, modify, correct: LargestResidual, trajectories: rt.Trajectories
) -> None:
    broken = Modified(modify, correct) if modify else SimpleNamespace(classes=("x", "y"))
    check = {check.__name__: check for check in DIAGNOSER_CHECKS}[name]
    with pytest.raises(AssertionError):
        check(DiagnoserSubject(broken, trajectories))


def test_every_check_can_fail() -> None:
    assert {check.__name__ for check in DIAGNOSER_CHECKS} == {name for name, _ in BROKEN}


def test_all_that_is_broken_is_listed(
    correct: LargestResidual, trajectories: rt.Trajectories
) -> None:
    check_diagnoser(correct, trajectories)
    with pytest.raises(AssertionError, match="- check_probabilities: probabilities must sum to 1"):
        check_diagnoser(Modified(forgets_to_normalise, correct), trajectories)
    with pytest.raises(AssertionError, match=r"breaks(.|\n)*check_batch(.|\n)*check_same_again"):
        check_diagnoser(Modified(uses_a_global_generator, correct), trajectories)
    with pytest.raises(rt.InputError, match="trajectories: expected at least two"):
        check_diagnoser(correct, trajectories[:1])
