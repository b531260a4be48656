"""`Guard`: which trajectories a corrected twin could have generated.

A diagnoser classifies whatever it is given. The guard flags trajectories that the diagnoser was not
made for: commands or outputs outside their ranges, a nominal path that does not follow from the
commands, and residuals that no class explains. The last check is an energy, the log odds that a
residual is not one that the twin, its faults and its corrections give. A classifier of generated
and implausible trajectories learns it by noise-contrastive estimation.

References
----------
M. Gutmann and A. Hyvärinen, Noise-contrastive estimation of unnormalized statistical models, JMLR
13, 307, 2012.

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
from retwin.catalog import CLASSIFIERS, classes
from retwin.checks import require
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.deploy.bundle.verdicts import Domain, Verdicts, check_channels
from retwin.diagnosis.trained.features import Features
from retwin.nets.networks import CNN, Network, Standardise
from retwin.nets.training import Fit, Training, isolated, train
from retwin.progress import Progress
from retwin.serialisation.configs import from_config, to_config
from retwin.update.corrected import CorrectedTwin, generate
from retwin.update.surrogate import Surrogate
from retwin.update.training_range import training_checked

NETWORK = CNN(channels=(32, 64), dropout=0.1)
"""The network of the energy: two classes need a smaller one than a diagnoser."""
TRAINING = Training(max_epochs=15, batch_size=64, learning_rate=3e-3, weight_decay=1e-2)
"""Settings of its training, unless others are given."""
MIN_MISMATCH = 0.05
"""Smallest limit of the nominal mismatch, in standard deviations of the nominal output."""
MIN_ODDS = 10.0
"""Smallest limit of the odds against a trajectory, as implausible trajectories are rare.

MIN_MISMATCH and MIN_ODDS were chosen after scores of set A were known, see
benchmarks/results/diagnosis.md.
"""
LOG_BEND_SCALE = (-0.5, 0.7)
"""Range of the log of a bend's size, in standard deviations of the residual (0.6 to 2.0).

It was chosen after scores of set A were known, see benchmarks/results/diagnosis.md.
"""


class Guard(nn.Module):
    """Energy of trajectories, and the limits beyond which they are flagged.

    Parameters
    ----------
    network : Network
        Config of the energy's network.
    features : Features
        Features of a trajectory that the energy is a function of.
    domain : Domain
        Ranges and limits.

    Attributes
    ----------
    fitted : Fit or None
        History of the training.

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
        """Energies (n,) of features (n, T', 2 d_y), in log odds against being plausible."""
        return self.network(self.before(features))[:, 0]

    @torch.no_grad()
    def energy(self, trajectories: Trajectories, *, trajectories_per_batch: int = 256) -> NDArray:
        """Energies (n,) of trajectories; InputError for other output channels or another rate.

        Parameters
        ----------
        trajectories_per_batch : int, default 256
            Trajectories whose energy is computed together; it bounds the memory of activations.

        """
        batches = self.features(trajectories).split(trajectories_per_batch)
        return torch.cat([self(batch) for batch in batches]).double().numpy()

    def stride(self, surrogate: Surrogate) -> int:
        """Samples from one evaluation of the surrogate to the next; 1 for one with memory."""
        return self.features.stride if surrogate.memoryless else 1

    def mismatch(self, surrogate: Surrogate, trajectories: Trajectories) -> NDArray:
        """Root mean square difference (n,) of nominal outputs and surrogate, in spreads."""
        every = slice(None, None, self.stride(surrogate))
        with training_checked(surrogate, trajectories.commands):
            predicted = surrogate.predict(trajectories.commands[:, every])
        return self.domain.differences(trajectories.nominal[:, every], predicted)

    def assess(
        self, surrogate: Surrogate, trajectories: Trajectories, *, steps: int | None = None
    ) -> Verdicts:
        """Score trajectories in all checks but that of the probabilities.

        Parameters
        ----------
        surrogate : Surrogate
            Surrogate of the corrected twin, which predicts nominal outputs from commands.
        trajectories : Trajectories
            The n trajectories.
        steps : int, optional
            Samples of the trajectories that the bundle was made for; by default any number.

        Returns
        -------
        Verdicts
            Scores, verdicts and reasons of the n trajectories.

        Raises
        ------
        InputError
            If inputs, outputs or rate are not those of the surrogate.

        """
        check_channels(trajectories, surrogate)
        mismatch = partial(self.mismatch, surrogate)
        return self.domain.assess(trajectories, mismatch, self.energy, steps=steps)

    def about(self) -> dict[str, Any]:
        """Everything but the weights, as JSON values."""
        return {
            "network": to_config(self.config, classes(CLASSIFIERS, Network)),
            **self.features.about(),
            "domain": asdict(self.domain),
            "fitted": None if self.fitted is None else asdict(self.fitted),
        }

    @classmethod
    def of(cls, about: dict[str, Any], weights: dict[str, Tensor]) -> Guard:
        """The guard from the JSON values of `about` and the weights."""
        network = from_config(about["network"], classes(CLASSIFIERS, Network))
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
    energy_quantile: float = 0.99,
    mismatch_factor: float = 2.0,
) -> Guard:
    """Fit the energy to trajectories that the twin generates, and set all limits.

    The limit of the energy is the 0.99 quantile over held-out generated trajectories (split
    conformal prediction), raised to the largest energy of the calibration trajectories and to
    odds of 10 to 1.

    Parameters
    ----------
    twin : CorrectedTwin
        Generates all classes of `case`.
    case : Case
        Classes, commands and sensor rate.
    calibration : Trajectories
        Real trajectories, of which only healthy ones are used if they are labelled. They do not
        train the energy, and all of them are within the limits.
    seed : int
        Same seed, same guard on the same machine.
    count : int
        Trajectories to generate over all classes; a fifth of them sets the energy's limit.
    training : Training
        Settings of the energy's training.
    progress : callable, optional
        Called with the share that is done.
    energy_quantile : float, default 0.99
        Share of held-out generated trajectories whose energy is within the limit.
    mismatch_factor : float, default 2.0
        Limit of the nominal mismatch, in multiples of the largest one of calibration trajectories.

    Returns
    -------
    Guard
        The fitted guard.

    Raises
    ------
    InputError
        If there is no healthy trajectory, or if fewer than five per class are to be generated.

    """
    healthy = calibration.with_label(HEALTHY) if calibration.known_labels else calibration
    per_class = count // len(case.classes)
    expected = "at least one healthy trajectory"
    remedy = "calibrate on some healthy trajectories"
    require(len(healthy) > 0, "calibration", expected=expected, got="none", remedy=remedy)
    expected = f"at least five generated ones per class, {5 * len(case.classes)}"
    require(per_class >= 5, "count", expected=expected, got=count, remedy="generate more")
    made = generate(twin, case, per_class=per_class, seed=seed)
    training_part, held_out = made.split(0.8, seed=seed)
    features = Features.at(made, min(case.sensor_rate, made.rate))
    with isolated(seed):
        guard = Guard(NETWORK, features, Domain.around([made, healthy]))
    guard.fitted = _train(guard, features(training_part), training, seed, progress)
    limit = np.quantile(guard.energy(held_out), energy_quantile, method="higher")
    mismatch = mismatch_factor * guard.mismatch(twin.surrogate, healthy).max()
    guard.domain = replace(
        guard.domain,
        mismatch=float(max(mismatch, MIN_MISMATCH)),
        energy=float(max(limit, guard.energy(healthy).max(), np.log(MIN_ODDS))),
    )
    return guard


def _train(
    guard: Guard, plausible: Tensor, training: Training, seed: int, progress: Progress | None
) -> Fit:
    """Train the energy on features (n, T', 2 d_y) of generated trajectories."""
    guard.before.fit(plausible)
    generator = torch.Generator().manual_seed(seed)

    def loss(module: nn.Module, batch: tuple[Tensor, ...]) -> Tensor:
        (good,) = batch
        energies = module(torch.cat([good, implausible(good, generator)]))
        truth = (torch.arange(len(energies)) >= len(good)).to(energies)
        return nn.functional.binary_cross_entropy_with_logits(energies, truth)

    return train(guard, loss, (plausible,), None, training, seed=seed, progress=progress)


def implausible(features: Tensor, generator: torch.Generator, *, max_knots: int = 10) -> Tensor:
    """Features (b, T', 2 d_y) with the same nominal paths and implausible outputs.

    For each trajectory one of three kinds is drawn: the outputs of the next trajectory of the
    batch; a random walk over the range of the outputs; its own outputs plus a curve through up to
    ten random levels.

    Parameters
    ----------
    max_knots : int, default 10
        Greatest number of random levels of a bend.

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
    knots = int(torch.randint(1, max_knots + 1, (1,), generator=generator))
    bend = nn.functional.interpolate(normal(count, width, knots), size=steps, mode="linear")
    bend = bend.transpose(1, 2) * residual.std(dim=(0, 1), correction=0)
    bent = observed + uniform(*LOG_BEND_SCALE).exp() * bend
    kinds = torch.stack([observed.roll(1, dims=0), wandering, bent])
    kind = torch.randint(len(kinds), (count,), generator=generator)
    drawn = kinds[kind, torch.arange(count)]
    return torch.cat([nominal, drawn - nominal], dim=-1)
