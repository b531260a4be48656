"""The hypothesis of each class of faults: a prior of `CommandSpace`'s z, and who is held when.

Healthy: z is distributed as the residual model has learned. Biased: one actuator's offsets have the
fault's size on top of that. Stuck: the effective commands of one actuator, or of two, stand still
from an onset on. Rows are trajectories times classes, all solved together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from retwin.checks import at_least
from retwin.diagnosis.inversion.latent_prior import command_problem, healthy_prior
from retwin.errors import InputError
from retwin.inference.problem import Rows
from retwin.twins.faults.actuator_faults import ActuatorBias, Fault, Stuck
from retwin.update.corrections import Context
from retwin.update.corrections.commands.missed_segments import LatentPrior
from retwin.update.corrections.commands.problem import CommandProblem
from retwin.update.residual import ResidualModel


def checked(faults: Mapping[str, Fault | None]) -> dict[str, Fault | None]:
    """The faults of at least two classes.

    Raises
    ------
    InputError
        There are fewer than two, or one cannot be inverted.

    """
    remedy = "give the faults of a case"
    at_least("faults", faults, 2, "classes, None for healthy", remedy=remedy)
    for fault in faults.values():
        _actuator_and_size(fault)
    return dict(faults)


@dataclass(frozen=True)
class StuckPair:
    """Two actuators that are stuck from the same moment on.

    Parameters
    ----------
    first : Stuck
        One of them, and the onset of both.
    other : int
        The other actuator.

    """

    first: Stuck
    other: int

    @property
    def actuators(self) -> tuple[int, int]:
        """Both, counted from 0."""
        return self.first.actuator, self.other


def stuck_pairs(faults: Mapping[str, Fault | None]) -> dict[tuple[str, str], StuckPair]:
    """The pairs of stuck actuators among some faults, by the names of their classes."""
    stuck = [(name, fault) for name, fault in faults.items() if isinstance(fault, Stuck)]
    return {
        (one, two): StuckPair(fault, other.actuator)
        for (one, fault), (two, other) in combinations(stuck, 2)
        if fault.onset == other.onset and fault.actuator != other.actuator
    }


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

    @property
    def deviation(self) -> Tensor:
        """Standard deviations (R, P) of x without a fault."""
        return self.healthy

    def excess(self, x: Tensor) -> Tensor:
        """What the part of x (R, P) beyond its limit costs, in nats."""
        beyond = ((x - self.gaussian.mean).abs() - self.limit).clamp_min(0)
        return 0.5 * (beyond / self.healthy).square()


@dataclass(frozen=True, eq=False)
class Hypotheses(Rows):
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
        (R,), which is faulty, of two the first; 0 where none is.
    held_actuators : Tensor
        (R, d_u) bool, those that are held from an onset on.
    size : Tensor
        (R, 2), smallest and largest size of a bias; 0 where there is none.
    onsets : Tensor
        (R, 2), first and last onset of a stuck actuator, in samples; T where none is stuck.

    """

    problem: CommandProblem
    prior: LatentPrior
    classes: int
    actuator: Tensor
    held_actuators: Tensor
    size: Tensor
    onsets: Tensor
    shared = ("classes",)

    @classmethod
    def of(
        cls,
        faults: Sequence[Fault | StuckPair | None],
        residual: ResidualModel,
        context: Context,
        observed: Tensor,
        mask: Tensor,
    ) -> Hypotheses:
        """Every fault about every trajectory; `mask` is True where the sensor was sampled."""
        n, steps, width = context.commands.shape
        rows = torch.arange(n).repeat_interleave(len(faults))
        limits = [_limits(fault, steps, width, context.rate) for fault in faults]
        actuator, held, size, onsets = (
            torch.tensor(column).repeat(n, *[1] * np.ndim(column[0]))
            for column in zip(*limits, strict=True)
        )
        problem = command_problem(residual, context[rows.numpy()], observed[rows], mask[rows])
        prior = healthy_prior(residual, context)[rows]
        made = cls(problem, prior, len(faults), actuator, held, size.double(), onsets)
        place, biased = made.offset_index, made.width > 0
        largest = torch.where(biased, made.size[:, 1], torch.inf)
        none = torch.zeros_like(prior.gaussian.mean)
        extra = none.scatter(1, place, made.width.square()[:, None].expand_as(place))
        limit = (none + torch.inf).scatter(1, place, largest[:, None].expand_as(place))
        wide = prior.gaussian.widened(extra)
        limited = LimitedPrior(wide, prior.odds, limit, prior.gaussian.deviation)
        return replace(made, prior=limited).held(onsets[:, 0])

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
        steps = self.problem.reference.shape[1]
        frozen = torch.where(self.held_actuators, onset[:, None], steps)
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
    expected = "None, Stuck, or ActuatorBias with its bias open"
    remedy = "leave out what cannot be inverted, train a diagnoser, or correct the dynamics "
    remedy += "(fit_dynamics, retwin fit --dynamics), by which every kind of fault is inverted"
    raise InputError("faults", expected=expected, got=repr(fault), remedy=remedy)


def _limits(
    fault: Fault | StuckPair | None, steps: int, width: int, rate: float
) -> tuple[int, list[bool], tuple[float, float], tuple[int, int]]:
    """Actuator, which are held, limits of the size of a bias, and of the sample at which one is
    stuck.
    """
    one = fault.first if isinstance(fault, StuckPair) else fault
    actuator, size = _actuator_and_size(one)
    held, onsets = [False] * width, (steps, steps)
    if isinstance(one, Stuck):
        onsets = one.onset_range(steps, rate)
        for index in fault.actuators if isinstance(fault, StuckPair) else (actuator,):
            held[index] = True
    return actuator, held, size, onsets
