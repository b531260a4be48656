"""`Guard`: which trajectories are of the kind that a corrected twin can give at all.

A diagnoser answers whatever it is shown. The guard says when not to listen: commands or outputs
outside the ranges it was made for, a nominal path that is not the commands', and residuals that no
class explains. The last is an energy, learned by telling generated trajectories from implausible
ones (noise-contrastive estimation: Gutmann and Hyvärinen, JMLR 13, 307, 2012): the log odds of a
residual being something else than what the twin, its faults and its corrections give.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.cases.case import Case
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.deploy.bundle.verdicts import Domain, Verdicts
from retwin.diagnosis.features import Features
from retwin.errors import InputError
from retwin.nets.networks import CNN, NETWORKS, Network, Standardise
from retwin.nets.training import Fit, Training, isolated, train
from retwin.progress import Progress
from retwin.serialisation.configs import from_config, to_config
from retwin.update.corrected import CorrectedTwin, generate
from retwin.update.surrogate import Surrogate

__all__ = ["Guard", "fit_guard"]

NETWORK = CNN(channels=(32, 64), dropout=0.1)
TRAINING = Training(max_epochs=15, batch_size=64, learning_rate=3e-3, weight_decay=1e-2)
SHARE = 0.99
"""Of generated trajectories are usual."""
TWICE = 2.0
"""Nominal paths may differ from the surrogate so many times as much as calibrated ones do."""
NOTHING = 0.05
"""A difference, in spreads, that is usual whatever calibrated ones show."""
ODDS = 10.0
"""Odds against a trajectory that are usual whatever calibrated ones show: most are plausible.

NOTHING and ODDS were set when the scores of set A had been seen, see docs/bundle.md.
"""
SIZES = (-0.5, 0.7)
"""Log of the least and the greatest size of a bend, in standard deviations of the residual."""
KNOTS = 10
CHUNK = 256


class Guard(nn.Module):
    """Energies of trajectories, and the limits beyond which they are not to be trusted.

    Parameters
    ----------
    network: the config of the energy's network.
    features: what it looks at.
    domain: ranges and limits.

    """

    def __init__(self, network: Network, features: Features, domain: Domain) -> None:
        super().__init__()
        self.config = network
        self.features = features
        self.domain = domain
        self.before = Standardise(features.width)
        self.network = network.build(features.width, 1)
        self.fitted: Fit | None = None

    def forward(self, features: Tensor) -> Tensor:
        """Energies (n,) of features (n, T', 2 d_y): log odds against being plausible."""
        return self.network(self.before(features))[:, 0]

    @torch.no_grad()
    def energy(self, trajectories: Trajectories) -> NDArray:
        """Energies (n,); InputError for other output channels or another rate."""
        parts = [self(part) for part in self.features(trajectories).split(CHUNK)]
        return torch.cat(parts).double().numpy()

    def stride(self, surrogate: Surrogate) -> int:
        """Every how many samples it asks the surrogate: all, where that remembers."""
        return self.features.stride if surrogate.memoryless else 1

    def mismatch(self, surrogate: Surrogate, trajectories: Trajectories) -> NDArray:
        """How far (n,) nominal paths are from what the surrogate says of the commands."""
        every = slice(None, None, self.stride(surrogate))
        predicted = surrogate.predict(trajectories.commands[:, every])
        return self.domain.differences(trajectories.nominal[:, every], predicted)

    def judge(
        self, surrogate: Surrogate, trajectories: Trajectories, *, steps: int | None = None
    ) -> Verdicts:
        """The verdict on each trajectory; `steps` as for `Domain.judge`.

        Raises InputError for other channels or another rate, or trajectories without commands.
        """
        if trajectories.inputs != surrogate.inputs:
            raise InputError(
                "trajectories.inputs",
                expected=f"{surrogate.inputs}",
                got=f"{trajectories.inputs}",
                remedy="read the file with its case, which recovers commands",
            )
        mismatch = partial(self.mismatch, surrogate)
        return self.domain.judge(trajectories, mismatch, self.energy, steps=steps)

    def about(self) -> dict[str, Any]:
        """Everything but the weights, for JSON."""
        return {
            "network": to_config(self.config, NETWORKS),
            **self.features.about(),
            "domain": asdict(self.domain),
            "fitted": None if self.fitted is None else asdict(self.fitted),
        }

    @classmethod
    def of(cls, about: dict[str, Any], weights: dict[str, Tensor]) -> Guard:
        """From what `about` gave, and the weights."""
        network = from_config(about["network"], NETWORKS)
        guard = cls(network, Features.of(about), Domain.of(about["domain"]))
        guard.load_state_dict(weights)
        guard.fitted = Fit.of(about["fitted"])
        return guard.eval()


def fit_guard(
    twin: CorrectedTwin,
    case: Case,
    calibration: Trajectories,
    *,
    seed: int,
    count: int = 1800,
    training: Training = TRAINING,
    progress: Progress | None = None,
) -> Guard:
    """Learn what is usual from trajectories that the twin generates, and from healthy ones.

    Parameters
    ----------
    twin: generates all classes of `case`.
    calibration: real trajectories; where they are labelled only healthy ones are looked at, and
        none of them trains the energy. All of them are usual by definition.
    seed: same seed, same guard on the same machine.
    count: trajectories to generate, over all classes; a fifth sets the energy's limit.
    training: of the energy.

    The limit of the energy is what 99 % of held-out generated trajectories keep (split conformal
    prediction), widened to take in the calibrated ones, and odds of 10 to 1.

    Raises
    ------
    InputError: no healthy trajectory, or fewer generated ones than five per class.

    """
    healthy = calibration.with_label(HEALTHY) if calibration.known_labels else calibration
    each = count // len(case.classes)
    if len(healthy) == 0 or each < 5:
        raise InputError(
            "calibration" if len(healthy) == 0 else "count",
            expected="at least one healthy trajectory, and five generated ones per class",
            got=f"{len(healthy)} and {each}",
            remedy="calibrate on some healthy trajectories, and generate more",
        )
    made = generate(twin, case, per_class=each, seed=seed)
    learnt, held_out = made.split(0.8, seed=seed)
    features = Features.at(made, min(case.sensor_rate, made.rate))
    with isolated(seed):
        guard = Guard(NETWORK, features, Domain.around([made, healthy]))
    guard.fitted = _train(guard, features(learnt), training, seed, progress)
    usual = np.quantile(guard.energy(held_out), SHARE, method="higher")
    guard.domain = replace(
        guard.domain,
        mismatch=float(max(TWICE * guard.mismatch(twin.surrogate, healthy).max(), NOTHING)),
        energy=float(max(usual, guard.energy(healthy).max(), np.log(ODDS))),
    )
    return guard


def _train(
    guard: Guard, plausible: Tensor, training: Training, seed: int, progress: Progress | None
) -> Fit:
    """Train the energy on features (n, T', 2 d_y) of plausible trajectories."""
    guard.before.fit(plausible)
    generator = torch.Generator().manual_seed(seed)

    def loss(module: nn.Module, batch: tuple[Tensor, ...]) -> Tensor:
        (good,) = batch
        energies = module(torch.cat([good, implausible(good, generator)]))
        truth = (torch.arange(len(energies)) >= len(good)).to(energies)
        return nn.functional.binary_cross_entropy_with_logits(energies, truth)

    return train(guard, loss, (plausible,), None, training, seed=seed, progress=progress)


def implausible(features: Tensor, generator: torch.Generator) -> Tensor:
    """The same nominal paths (b, T', 2 d_y) with outputs that belong to something else.

    Each one by a draw: the outputs of the next trajectory of the batch; a random walk over the
    range of the outputs; its own outputs, bent by a curve through up to ten random levels.
    """
    nominal, residual = features.chunk(2, dim=-1)
    observed = nominal + residual
    count, steps, width = observed.shape

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator).to(observed)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, 1, 1, generator=generator).to(observed)

    walk = normal(count, steps, width).cumsum(dim=1)
    walk = walk / walk.abs().amax(dim=1, keepdim=True) * uniform(0.0, 2.0)
    wandering = observed.mean(dim=(0, 1)) + walk * observed.std(dim=(0, 1), correction=0)
    knots = int(torch.randint(1, KNOTS + 1, (1,), generator=generator))
    bend = nn.functional.interpolate(normal(count, width, knots), size=steps, mode="linear")
    bend = bend.transpose(1, 2) * residual.std(dim=(0, 1), correction=0)
    bent = observed + uniform(*SIZES).exp() * bend
    kinds = torch.stack([observed.roll(1, dims=0), wandering, bent])
    which = torch.randint(len(kinds), (count,), generator=generator)
    drawn = kinds[which, torch.arange(count)]
    return torch.cat([nominal, drawn - nominal], dim=-1)
