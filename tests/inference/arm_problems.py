"""A small fixed set of emulated trajectories, for comparisons of the engine with frozen results."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import torch
from numpy.typing import NDArray
from torch import Tensor

import retwin as rt
from retwin.nets.mixtures import Bernoullis, GaussianMixture
from retwin.twins.faults.applied_faults import draw_faults, faulty_commands, frozen_from

FROZEN = Path(__file__).with_name("frozen.npz")
"""Results of the three solvers that the engine replaced, with their inputs."""
HEALTHY = 6
"""The first so many trajectories are healthy."""
FAULTS = [*[None] * HEALTHY, rt.Stuck(1, onset=0.49), rt.ActuatorBias(2, size=(10.0, 50.0))]
KNOWN = [*[None] * HEALTHY, rt.Stuck(1, onset=0.49), rt.ActuatorBias(2, bias=(1.0,) * 5)]
"""What `CommandSpace` is given: the class of each fault, not its severity."""
POLL = 10


def context_of(exact, commands: NDArray, faults: list | None = None) -> rt.Context:
    segments = rt.Segments.from_commands(commands)
    if faults is None:
        return rt.Context.of(exact, commands, segments, rate=100.0)
    drawn = draw_faults(faults, segments, 0, rate=100.0)
    return rt.Context.of(
        exact,
        commands,
        segments,
        rate=100.0,
        faulty_commands=faulty_commands(commands, drawn, segments, rate=100.0),
        frozen=frozen_from(drawn, *commands.shape[1:], rate=100.0),
    )


def polled(count: int, steps: int = 1000) -> Tensor:
    mask = torch.zeros(count, steps, 3, dtype=torch.bool)
    mask[:, ::POLL] = True
    return mask


class KnownResidual:
    """Stands for a fitted residual model: the same Gaussian z for every segment."""

    correction = rt.CommandSpace(delay_range=(-0.05, 0.3))
    persistence = torch.full((9,), 0.2)
    fitted = None

    def __call__(self, context: rt.Context) -> SimpleNamespace:
        shape = context.segments.start.shape

        def gaussian(mean: list[float], deviation: list[float]) -> GaussianMixture:
            width = len(mean)
            return GaussianMixture(
                torch.zeros(*shape, 1),
                torch.tensor(mean).expand(*shape, 1, width),
                torch.diag(torch.tensor(deviation)).expand(*shape, 1, width, width),
            )

        return SimpleNamespace(
            blocks=[
                gaussian([6.8], [1.2]),
                gaussian([0.0] * 4, [5.0, 4.0, 4.5, 5.0]),
                Bernoullis(torch.full((*shape, 4), -4.5)),
            ]
        )
