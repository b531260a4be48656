"""The hypothesis of each class of faults: a prior of `CommandSpace`'s z, and who is held when.

Healthy: z is distributed as the residual model has learned. Biased: one actuator's offsets have the
fault's size on top of that. Stuck: one actuator's effective command stands still from an onset on.
Rows are trajectories times classes, all solved together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from retwin.checks import require
from retwin.diagnosis.latent_prior import command_problem, healthy_prior
from retwin.errors import InputError
from retwin.twins.faults import ActuatorBias, Fault, Stuck
from retwin.update.corrections import Context
from retwin.update.corrections.command_problem import CommandProblem
from retwin.update.corrections.missed_segments import LatentPrior
from retwin.update.residual import ResidualModel


def checked(faults: Mapping[str, Fault | None]) -> dict[str, Fault | None]:
    """The faults of at least two classes.

    Raises
    ------
    InputError
        There are fewer than two, or one cannot be inverted.

    """
    require(
        len(faults) > 1,
        "faults",
        expected="at least two classes, None for healthy",
        got=list(faults),
        remedy="give the faults of a case",
    )
    for fault in faults.values():
        _actuator_and_size(fault)
    return dict(faults)


@dataclass(frozen=True, eq=False)
class LimitedPrior(LatentPrior):
    """A prior under which biases have a largest size.

    Under the Gaussian alone a bias of several times the largest size can be more probable than a
    missed segment, and the class is then rejected for its size.

    Attributes
    ----------
    limit : Tensor
        (R, P), largest distance of x from its mean, infinite where there is none.
    healthy : Tensor
        (R, P), standard deviation of what is not the bias.

    """

    limit: Tensor
    healthy: Tensor

    def __getitem__(self, rows: Tensor) -> LimitedPrior:
        """The prior of some rows."""
        gaussian, odds = self.gaussian[rows], self.odds[rows]
        return LimitedPrior(gaussian, odds, self.limit[rows], self.healthy[rows])

    @property
    def deviation(self) -> Tensor:
        """Standard deviations (R, P) of x without a fault."""
        return self.healthy

    def excess(self, x: Tensor) -> Tensor:
        """What the part of x (R, P) beyond its limit costs, in nats."""
        beyond = ((x - self.gaussian.mean).abs() - self.limit).clamp_min(0)
        return 0.5 * (beyond / self.healthy).square()


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """All classes about n trajectories: row r is class r % C of trajectory r // C.

    Attributes
    ----------
    problem : CommandProblem
        Of the rows.
    prior : LatentPrior
        Of the rows.
    classes : int
        C.
    actuator : Tensor
        (R,), which is faulty; 0 where none is.
    size : Tensor
        (R, 2), smallest and largest size of a bias; 0 where there is none.
    onsets : Tensor
        (R, 2), first and last onset of a stuck actuator, in samples; T where none is stuck.

    """

    problem: CommandProblem
    prior: LatentPrior
    classes: int
    actuator: Tensor
    size: Tensor
    onsets: Tensor

    @classmethod
    def of(
        cls,
        faults: Sequence[Fault | None],
        residual: ResidualModel,
        context: Context,
        observed: Tensor,
        mask: Tensor,
    ) -> Hypotheses:
        """Every fault about every trajectory; `mask` is True where the sensor was sampled."""
        n, steps, _ = context.commands.shape
        rows = torch.arange(n).repeat_interleave(len(faults))
        limits = [_limits(fault, steps, context.rate) for fault in faults]
        actuator, size, onsets = (
            torch.tensor(column).repeat(n, *[1] * np.ndim(column[0]))
            for column in zip(*limits, strict=True)
        )
        problem = command_problem(residual, context[rows.numpy()], observed[rows], mask[rows])
        prior = healthy_prior(residual, context)[rows]
        made = cls(problem, prior, len(faults), actuator, size.double(), onsets)
        place, biased = made.offset_index, made.width > 0
        largest = torch.where(biased, made.size[:, 1], torch.inf)
        extra, limit = (
            torch.full_like(prior.gaussian.mean, rest).scatter(
                1, place, own[:, None].expand(place.shape)
            )
            for rest, own in ((0.0, made.width.square()), (torch.inf, largest))
        )
        wide = prior.gaussian.widened(extra)
        limited = LimitedPrior(wide, prior.odds, limit, prior.gaussian.deviation)
        return replace(made, prior=limited).held(onsets[:, 0])

    def __getitem__(self, rows: Tensor) -> Hypotheses:
        """Some of the rows."""
        parts = (self.actuator[rows], self.size[rows], self.onsets[rows])
        return Hypotheses(self.problem[rows], self.prior[rows], self.classes, *parts)

    @property
    def trajectory(self) -> Tensor:
        """The trajectory of each row (R,)."""
        return torch.arange(len(self.actuator)) // self.classes

    @property
    def stuck(self) -> Tensor:
        """Whether the row's actuator is stuck (R,) bool."""
        return self.onsets[:, 0] < self.problem.reference.shape[1]

    @property
    def width(self) -> Tensor:
        """Standard deviation of a bias (R,); 0 where there is none."""
        low, high = self.size.unbind(dim=1)
        return ((low.square() + low * high + high.square()) / 3).sqrt()

    @property
    def offset_index(self) -> Tensor:
        """Index in x of the faulty actuator's offset in every segment, (R, M)."""
        _, segments, width = self.problem.missed.shape
        return (1 + width) * torch.arange(segments) + 1 + self.actuator[:, None]

    @property
    def start(self) -> Tensor:
        """The prior's mean of x (R, P)."""
        return self.prior.gaussian.mean

    def held(self, onset: Tensor) -> Hypotheses:
        """The same with stuck actuators held from `onset` (R,) on."""
        steps, width = self.problem.reference.shape[1:]
        own = torch.nn.functional.one_hot(self.actuator, width).bool()
        frozen = torch.where(own, onset[:, None], steps)
        return replace(self, problem=self.problem.held_from(frozen))


def _actuator_and_size(fault: Fault | None) -> tuple[int, tuple[float, float]]:
    """Actuator, and limits of the size of a bias; InputError for a fault of another kind."""
    match fault:
        case None:
            return 0, (0.0, 0.0)
        case Stuck(actuator=actuator):
            return actuator, (0.0, 0.0)
        case ActuatorBias(actuator=actuator, size=(low, high), bias=()):
            return actuator, (low, high)
    raise InputError(
        "faults",
        expected="None, Stuck, or ActuatorBias with its bias open",
        got=repr(fault),
        remedy="leave out what cannot be inverted, train a diagnoser, or correct the dynamics "
        "(fit_dynamics, retwin fit --dynamics), by which every kind of fault is inverted",
    )


def _limits(
    fault: Fault | None, steps: int, rate: float
) -> tuple[int, tuple[float, float], tuple[int, int]]:
    """Actuator, limits of the size of a bias, and of the sample at which it is stuck."""
    onsets = fault.onset_range(steps, rate) if isinstance(fault, Stuck) else (steps, steps)
    return *_actuator_and_size(fault), onsets
