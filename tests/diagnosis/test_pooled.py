"""Pooled diagnosers: the formula, and the contract of every diagnoser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import retwin as rt
from retwin.diagnosis import PooledDiagnoser
from retwin.nets.training import Training
from retwin.testing import DIAGNOSER_CHECKS, DiagnoserSubject


@dataclass(frozen=True)
class Always:
    """Gives the same probabilities for every trajectory."""

    classes: tuple[str, ...]
    probabilities: tuple[float, ...]

    def predict_proba(self, trajectories: rt.Trajectories) -> np.ndarray:
        return np.tile(self.probabilities, (len(trajectories), 1))


CLASSES = ("Healthy", "a", "b")


def test_the_pool_is_the_geometric_mean(emulated: rt.Trajectories) -> None:
    one = Always(CLASSES, (0.5, 0.3, 0.2))
    other = Always(("b", "Healthy", "a"), (0.8, 0.1, 0.1))
    pool = PooledDiagnoser((one, other))
    root = np.sqrt([0.5 * 0.1, 0.3 * 0.1, 0.2 * 0.8])
    assert pool.classes == CLASSES
    np.testing.assert_allclose(pool.predict_proba(emulated[:2]), [root / root.sum()] * 2)
    agreed = PooledDiagnoser((one, one)).predict_proba(emulated[:1])
    np.testing.assert_allclose(agreed, [one.probabilities])


def test_no_member_excludes_a_class_alone(emulated: rt.Trajectories) -> None:
    sure, other = Always(CLASSES, (1.0, 0.0, 0.0)), Always(CLASSES, (0.0, 0.0, 1.0))
    (got,) = PooledDiagnoser((sure, other)).predict_proba(emulated[:1])
    assert (got > 0).all()
    assert got[0] == pytest.approx(got[2])
    assert got[1] < 0.05


def test_members_must_have_the_same_classes() -> None:
    with pytest.raises(rt.InputError, match="of the same classes"):
        PooledDiagnoser(())
    with pytest.raises(rt.InputError, match="of the same classes"):
        PooledDiagnoser((Always(CLASSES, (1, 0, 0)), Always(CLASSES[:2], (1, 0))))


@pytest.fixture(scope="module")
def pool(twin_set: rt.Trajectories, case: rt.Case) -> PooledDiagnoser:
    training = Training(max_epochs=1, batch_size=64, learning_rate=1e-3)
    members = [
        rt.fit_diagnoser(twin_set, seed=seed, classes=order, training=training)
        for seed, order in enumerate((case.classes, case.classes[::-1]))
    ]
    return PooledDiagnoser(members)


@pytest.mark.parametrize("check", DIAGNOSER_CHECKS, ids=lambda check: check.__name__)
def test_contract(pool: PooledDiagnoser, emulated: rt.Trajectories, check) -> None:
    check(DiagnoserSubject(pool, emulated[::30]))
