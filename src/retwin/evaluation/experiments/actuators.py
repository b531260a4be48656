"""What is not yet known of the actuators' errors, and what would reduce it, for `CommandSpace`.

The inference of `CommandSpace` learns the mean error of every actuator as a regression on its
motion and on the pose. The posterior of that regression is used here as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.checks import given
from retwin.data.trajectories import Trajectories
from retwin.inference.design import Knowledge
from retwin.inference.hierarchy import Likelihood
from retwin.inference.solver import solve
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import CommandSpace, Context, Discrepancy, before_sensor, sample_mask
from retwin.update.corrections.commands.inference import Hyperparameters
from retwin.update.corrections.commands.problem import CommandProblem
from retwin.update.corrections.delay_range import range_in_samples


@dataclass(frozen=True, eq=False)
class ActuatorKnowledge:
    """The posterior of the regression, and what it belongs to.

    Attributes
    ----------
    twin : CorrectedTwin
        With `CommandSpace`, alone or before a sensor.
    operator : CommandSpace
        With its range of delays.
    hyperparameters : Hyperparameters
        Learned from the calibration trajectories.
    unit : Tensor
        (d_y,), the unit of its noise.
    context, found : Context, Discrepancy
        Of the calibration trajectories.

    """

    twin: CorrectedTwin
    operator: CommandSpace
    hyperparameters: Hyperparameters
    unit: Tensor
    context: Context
    found: Discrepancy

    @classmethod
    def of(cls, twin: CorrectedTwin, calibration: Trajectories) -> ActuatorKnowledge:
        """The information in healthy trajectories."""
        correction = twin.residual.correction
        operator = before_sensor(correction)
        assert isinstance(operator, CommandSpace)
        context = twin.residual.context(twin.surrogate, calibration.commands)
        observed = torch.tensor(calibration.observed)
        mask = sample_mask(correction, observed, torch.tensor(calibration.mask), context.rate)
        limits = range_in_samples(operator.delay_range, context, observed, mask)
        found, learned = operator.infer_with_hyperparameters(context, observed, mask)
        learned = given(
            "calibration",
            learned,
            "trajectories with segments of motion",
            got="commands that never change",
            remedy="give those that the twin was calibrated on",
        )
        seen = CommandProblem.of(
            context, observed, mask, delay_range=limits, max_samples=operator.max_samples
        )
        timed = (limits[0] / context.rate, limits[1] / context.rate)
        return cls(twin, replace(operator, delay_range=timed), learned, seen.unit, context, found)

    def knowledge(self, commands: NDArray) -> Knowledge:
        """The knowledge about delays and offsets, in units of their scatter, at the segments."""
        problem, learned = self._problem(commands), self.hyperparameters
        design = learned.features.design(problem)
        n, segments, width = problem.missed.shape
        used = torch.zeros(n, segments, problem.size, dtype=torch.bool)
        used[..., : 1 + width] = problem.valid[..., None]
        rows = used.flatten(1)
        scatter = learned.hierarchy.scatter(design)
        return Knowledge(learned.hierarchy.covariance, design.features[rows], scatter[rows])

    @torch.no_grad()
    def roots(self, commands: NDArray) -> Tensor:
        """(n, F, F) roots of the information that outputs of commands would give."""
        problem, learned = self._problem(commands), self.hyperparameters
        prior = learned.prior(problem).gaussian
        # Outputs as expected: the solution is the mean of the prior, only its curvature is new.
        expected = problem.observed - problem.residual(prior.mean)
        samples = replace(learned.samples, gain=problem.gain())
        problem = replace(problem, observed=expected, whitening=samples.whitening())
        found = solve(problem, prior, learned.noise, prior.mean, bounds=problem.bounds)
        likelihood, design = Likelihood.of(found, prior), learned.features.design(problem)
        information = learned.hierarchy.information(design, likelihood)
        values, vectors = torch.linalg.eigh((information + information.mT) / 2)
        return (vectors * values.clamp_min(0).sqrt()[..., None, :]).mT

    def mean(self, commands: NDArray) -> Tensor:
        """The mean z (n, M, d_z) of the segments of commands, none of which is missed."""
        context = self.twin.residual.context(self.twin.surrogate, commands)
        problem = self._problem_of(context)
        mean = problem.per_segment(self.hyperparameters.prior(problem).gaussian.mean)
        width = problem.missed.shape[2]
        return torch.cat([mean[..., : 1 + width], torch.zeros_like(problem.missed)], dim=-1)

    def _problem(self, commands: NDArray) -> CommandProblem:
        return self._problem_of(self.twin.residual.context(self.twin.surrogate, commands))

    def _problem_of(self, context: Context) -> CommandProblem:
        """The problem of outputs that the sensor is to sample, and that are not known yet."""
        low, high = self.operator.delay_range or (0.0, 0.0)
        mask = torch.ones(context.nominal.shape, dtype=torch.bool)
        correction = self.twin.residual.correction
        mask = sample_mask(correction, context.nominal, mask, context.rate)
        limits, count = (low * context.rate, high * context.rate), self.operator.max_samples
        problem = CommandProblem.of(
            context, context.nominal, mask, delay_range=limits, max_samples=count, unit=self.unit
        )
        return replace(problem, own_delays=True)
