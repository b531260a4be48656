"""Fine-tuning of the residual model on outputs, the paper's future work.

The likelihood of z takes z* as exact, although what counts is how well simulated outputs agree with
measured ones. Since g and the surrogate are differentiable, the energy score of simulated
trajectories is minimised, starting at the maximum of the likelihood. The choice of a mixture's
component, and an event, have no gradient: of a mixture only the means and covariances of the
components are refined, in the last layer; a flow has no such limit.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

from retwin.data.trajectories import Channels
from retwin.nets.mixtures import BernoulliHead
from retwin.nets.training import train
from retwin.progress import Progress
from retwin.scores.energy import energy_score
from retwin.update.corrections import Context, measured_outputs
from retwin.update.residual.model import ResidualModel, describe
from retwin.update.residual.settings import Refinement


def refine(
    model: ResidualModel,
    context: Context,
    observed: Tensor,
    mask: Tensor,
    *,
    fitted: Tensor,
    held_out: Tensor,
    how: Refinement,
    seed: int,
    progress: Progress | None = None,
    held_out_draws: int = 64,
) -> dict[str, float]:
    """Refine `model` in place if that lowers the energy score of held-out trajectories.

    Parameters
    ----------
    model : ResidualModel
        Fitted by its likelihood.
    context : Context
        Commands and nominal outputs of n trajectories.
    observed, mask : Tensor
        (n, T, d_y), measured outputs, and where they are true samples of the sensor.
    fitted, held_out : Tensor
        Indices of the trajectories to train on, and of those for validation.
    how : Refinement
        Settings.
    seed : int
        Seed of the draws and of the training.
    progress : callable, optional
        Called with the share of the epochs that are done.
    held_out_draws : int, default 64
        Simulations of each held-out trajectory that the energy score before and after is estimated
        from. They are four times as many as in training by default, to halve the error of the
        estimate.

    Returns
    -------
    dict of str to float
        "energy before" and "energy after", the score of the held-out trajectories in units of the
        outputs' spread, and "refined", 1 if the refined weights were kept.

    """
    features = describe(context)
    unit = _unit(observed, mask, model.outputs)
    frozen = [model.encoder, *(head for head in model.heads if isinstance(head, BernoulliHead))]
    fresh = torch.Generator().manual_seed(seed)

    def score(network: Any, batch: tuple[Tensor, ...], draws: int, seed: int) -> Tensor:
        """The mean energy score of so many simulations each of a batch: features and indices."""
        features, rows = batch
        generator = torch.Generator().manual_seed(seed)
        distribution = network.distribution(features.repeat_interleave(draws, dim=0))
        z = network.drawn(distribution, generator=generator)
        every = context[rows.repeat_interleave(draws).numpy()]
        outputs = measured_outputs(network.correction, every, z, generator) / unit
        scores = []
        for row, made in zip(rows.tolist(), outputs.split(draws), strict=True):
            seen = mask[row].all(dim=-1)
            scores.append(energy_score(made[:, seen], observed[row, seen] / unit))
        return torch.stack(scores).mean()

    def loss(network: Any, batch: tuple[Tensor, ...]) -> Tensor:
        # New draws at each training step; the same in each validation, to compare epochs.
        training = torch.is_grad_enabled()
        drawn = int(torch.randint(2**31, (), generator=fresh)) if training else seed
        return score(network, batch, how.draws, drawn)

    @torch.no_grad()
    def held_out_score() -> float:
        batch = (features[held_out], held_out)
        return float(score(model.eval(), batch, held_out_draws, seed + 1))

    before, start = held_out_score(), copy.deepcopy(model.state_dict())
    for part in frozen:
        part.requires_grad_(False)
    sets = (features[fitted], fitted), (features[held_out], held_out)
    train(model, loss, *sets, how.training, seed=seed, progress=progress)
    for part in frozen:
        part.requires_grad_(True)
    after = held_out_score()
    kept = after < before
    if not kept:
        model.load_state_dict(start)
    return {"energy before": before, "energy after": after, "refined": float(kept)}


def _unit(observed: Tensor, mask: Tensor, outputs: Channels) -> Tensor:
    """Divisor (d_y,) of the outputs: their spread, the mean one where their units are the same."""
    spread = observed[mask.all(dim=-1)].std(dim=0).clamp_min(1e-12)
    return spread.mean().expand_as(spread) if outputs.comparable else spread
