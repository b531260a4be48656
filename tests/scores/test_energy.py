from __future__ import annotations

import numpy as np
import pytest
import scoringrules
import torch

from retwin.scores.energy import energy_score

pytestmark = pytest.mark.numerical


@pytest.fixture
def ensemble() -> tuple[np.ndarray, np.ndarray]:
    """Thirty simulations of fifteen samples of two outputs, and a measured trajectory."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(30, 15, 2)), rng.normal(size=(15, 2))


def test_it_is_the_score_of_the_literature(ensemble: tuple[np.ndarray, np.ndarray]) -> None:
    simulated, observed = ensemble
    wanted = scoringrules.es_ensemble(
        observed.ravel() / np.sqrt(15), simulated.reshape(30, -1) / np.sqrt(15), estimator="fair"
    )
    np.testing.assert_allclose(energy_score(simulated, observed), wanted)
    np.testing.assert_allclose(energy_score(*map(torch.tensor, ensemble)), wanted)


def test_of_a_point_forecast_it_is_the_root_mean_square_error(
    ensemble: tuple[np.ndarray, np.ndarray],
) -> None:
    simulated, observed = ensemble
    point = np.repeat(simulated[:1], 5, axis=0)
    wanted = np.sqrt(np.square(simulated[0] - observed).sum(axis=1).mean())
    np.testing.assert_allclose(energy_score(point, observed), wanted)


def test_its_gradient_is_finite_where_simulations_are_equal() -> None:
    simulated = torch.zeros(3, 4, 2, requires_grad=True)
    energy_score(simulated, torch.zeros(4, 2)).backward()
    assert torch.isfinite(simulated.grad).all()


def test_its_gradient_is_that_of_finite_differences(
    ensemble: tuple[np.ndarray, np.ndarray],
) -> None:
    simulated, observed = (torch.tensor(each) for each in ensemble)
    few = simulated[:4].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda made: energy_score(made, observed), (few,))
