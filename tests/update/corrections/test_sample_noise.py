"""The covariance of a sample's error: of the outputs, and of the actuators' positions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import retwin as rt
from retwin.inference.noise import Noise
from retwin.update.corrections.commands.problem import CommandProblem
from retwin.update.corrections.sample_noise import SampleNoise

pytestmark = pytest.mark.numerical

COUNT, STEPS = 40, 1000


def posed(exact, case: rt.Case, *, output: float, actuator: float, memory: bool) -> CommandProblem:
    """Healthy arms whose joints' sensors and whose outputs have independent Gaussian noise."""
    rng = np.random.default_rng(3)
    commands = case.sampler.sample(COUNT, rng=rng)
    read = commands + rng.normal(0.0, actuator, commands.shape)
    observed = exact.predict(read) + rng.normal(0.0, output, (COUNT, STEPS, 3))

    class Remembering:
        predict = staticmethod(exact.predict)

        def __call__(self, values: Tensor) -> Tensor:
            return exact(values)

    context = rt.Context.of(
        Remembering() if memory else exact,
        commands,
        rt.Segments.from_commands(commands),
        rate=case.twin.rate,
    )
    mask = torch.zeros(COUNT, STEPS, 3, dtype=torch.bool)
    mask[:, ::10] = True
    return CommandProblem.of(
        context, torch.tensor(observed), mask, delay_range=(-5.0, 30.0), max_samples=200
    )


@pytest.mark.parametrize("memory", [False, True])
@pytest.mark.parametrize(("output", "actuator"), [(0.002, 0.0), (0.0, 0.4), (0.001, 0.4)])
def test_both_variances_are_recovered(
    exact, case: rt.Case, output: float, actuator: float, memory: bool
) -> None:
    problem = posed(exact, case, output=output, actuator=actuator, memory=memory)
    gaussian = Noise(torch.full((2, 1), 1e3).double(), torch.ones(2).double())  # equal weights
    found = SampleNoise.of(problem).learned(problem, gaussian, problem.zero)
    # Weights of Student's t are (4 + 3) / 4 where errors are small against the scale.
    learned = (found.output / 1.75).sqrt() * problem.unit.mean(), (found.actuator / 1.75).sqrt()
    np.testing.assert_allclose(learned[0], output, rtol=0.1, atol=2e-4)
    # 1600 samples at rest resolve 3 % of the power: of 2 mm that is 0.35 mm or 0.5 units.
    np.testing.assert_allclose(learned[1], actuator, rtol=0.15, atol=0.5 if not actuator else 0.1)


def test_whitened_errors_are_independent_and_of_one_size(exact, case: rt.Case) -> None:
    problem = posed(exact, case, output=0.0005, actuator=0.4, memory=False)
    found = SampleNoise.of(problem)
    unit = torch.tensor(0.0005).double() / problem.unit.mean()
    found = SampleNoise(found.gain, unit.square(), torch.full((4,), 0.16).double())
    errors = (found.whitening() @ problem.residual(problem.zero)[..., None])[..., 0]
    rest = (problem.measured > 0) & (problem.group == 0)
    covariance = torch.cov(errors[rest].T)
    mean = covariance.diagonal().mean()
    torch.testing.assert_close(covariance / mean, torch.eye(3).double(), rtol=0, atol=0.1)
    # Before, they were largest in the direction in which the actuators act most.
    _, axes = torch.linalg.eigh(found.gain[rest] @ found.gain[rest].mT)
    along = (axes.mT @ problem.residual(problem.zero)[rest][..., None])[..., 0].square().mean(dim=0)
    assert along[-1] > 1.5 * along[0]


def test_nothing_at_rest_leaves_the_noise_as_it_is(exact, case: rt.Case) -> None:
    problem = posed(exact, case, output=0.001, actuator=0.4, memory=False)
    moving = CommandProblem(**{**vars(problem), "group": torch.ones_like(problem.group)})
    found = SampleNoise.of(problem)
    noise = Noise(torch.ones(2, 1).double(), torch.ones(2).double())
    assert found.learned(moving, noise, problem.zero) is found
