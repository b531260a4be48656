"""All diagnosers keep the same contract, and the checks of it can fail."""

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
class Farthest:
    """A small diagnoser that is sound: which of the first two outputs goes astray more."""

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
        astray = 1e-9 + np.abs(trajectories.residual[..., :2].astype(float)).mean(axis=1)
        return astray / astray.sum(axis=1, keepdims=True)


@dataclass(frozen=True)
class Bent:
    """A sound diagnoser whose answer is bent."""

    bend: Callable[[Callable, rt.Trajectories], np.ndarray]
    sound: Farthest
    classes: tuple[str, ...] = ("x", "y")

    def predict_proba(self, trajectories: rt.Trajectories) -> np.ndarray:
        return self.bend(self.sound.predict_proba, trajectories)


def forgets_to_normalise(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    return 2 * predict(trajectories)


def peeks_at_labels(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    return np.where((trajectories.labels == "x")[:, None], [1.0, 0.0], predict(trajectories))


def compares_with_the_others(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    return 0.5 + (predict(trajectories) - predict(trajectories).mean(axis=0)) / 4


def divides_by_what_is_seen(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    seen = trajectories.mask.any(axis=(1, 2))
    return np.where(seen[:, None], predict(trajectories), np.nan)


def takes_any_rate(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    return predict(trajectories.replace(rate=100.0))


def rolls_dice(predict: Callable, trajectories: rt.Trajectories) -> np.ndarray:
    share = torch.rand(1).item()
    return np.tile([share, 1 - share], (len(trajectories), 1))


BROKEN = [
    ("check_protocol", None),
    ("check_probabilities", forgets_to_normalise),
    ("check_blindness", peeks_at_labels),
    ("check_batch", compares_with_the_others),
    ("check_missing", divides_by_what_is_seen),
    ("check_other_data", takes_any_rate),
    ("check_same_again", rolls_dice),
]


@pytest.fixture(scope="module")
def sound(trajectories: rt.Trajectories) -> Farthest:
    return Farthest(trajectories.outputs, trajectories.rate)


@pytest.mark.parametrize(("name", "bend"), BROKEN)
def test_a_broken_diagnoser_is_caught(
    name: str, bend, sound: Farthest, trajectories: rt.Trajectories
) -> None:
    broken = Bent(bend, sound) if bend else SimpleNamespace(classes=("x", "y"))
    check = {check.__name__: check for check in DIAGNOSER_CHECKS}[name]
    with pytest.raises(AssertionError):
        check(DiagnoserSubject(broken, trajectories))


def test_every_check_can_fail() -> None:
    assert {check.__name__ for check in DIAGNOSER_CHECKS} == {name for name, _ in BROKEN}


def test_all_that_is_broken_is_listed(sound: Farthest, trajectories: rt.Trajectories) -> None:
    check_diagnoser(sound, trajectories)
    with pytest.raises(AssertionError, match="- check_probabilities: probabilities must sum to 1"):
        check_diagnoser(Bent(forgets_to_normalise, sound), trajectories)
    with pytest.raises(AssertionError, match=r"breaks(.|\n)*check_batch(.|\n)*check_same_again"):
        check_diagnoser(Bent(rolls_dice, sound), trajectories)
    with pytest.raises(rt.InputError, match="trajectories: expected at least two"):
        check_diagnoser(sound, trajectories[:1])
