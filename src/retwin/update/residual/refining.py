"""Fine-tuning the RG on outputs, the paper's future work: g and the surrogate are differentiable.

The likelihood of z trusts z*; what counts is how simulated outputs compare with measured ones. The
energy score of simulated trajectories is minimised from the likelihood's solution on. Which
component of a mixture is drawn, and what happens or not, has no gradient: only what the components
are like is refined, in the last layer; a flow has no such limit. What is gained must show on
trajectories held out, or nothing is changed.
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
from retwin.update.corrections import Context, measured_outputs
from retwin.update.residual.model import ResidualModel, describe
from retwin.update.residual.settings import Refinement

__all__ = ["energy_score", "refine"]

CHECKS = 64
"""Simulations of each held-out trajectory by which before and after are compared."""


def refine(
    model: ResidualModel,
    context: Context,
    observed: Tensor,
    mask: Tensor,
    *,
    fitted: Tensor,
    held: Tensor,
    how: Refinement,
    seed: int,
    progress: Progress | None = None,
) -> dict[str, float]:
    """Refine `model` in place; say what the energy score of held-out trajectories was and is.

    Parameters
    ----------
    context: of n trajectories.
    observed, mask: (n, T, d_y), what was measured; only readings should be unmasked.
    fitted, held: rows to learn from, and those kept back.

    """
    features = describe(context)
    unit = _unit(observed, mask, model.outputs)
    frozen = [model.encoder, *(head for head in model.heads if isinstance(head, BernoulliHead))]

    def score(network: Any, batch: tuple[Tensor, ...], draws: int, seed: int) -> Tensor:
        rows = batch[1].cpu()
        generator = torch.Generator().manual_seed(seed)
        law = network.distribution(batch[0].repeat_interleave(draws, dim=0))
        z = network.drawn(law, generator=generator).cpu()
        every = context[rows.repeat_interleave(draws).numpy()]
        made = measured_outputs(network.correction, every, z, generator).unflatten(
            0, (len(rows), draws)
        )
        return energy_score(made / unit, observed[rows] / unit, mask[rows]).mean()

    seeds = iter(torch.randint(2**31, (100_000,), generator=torch.Generator().manual_seed(seed)))

    def loss(network: Any, batch: tuple[Tensor, ...]) -> Tensor:
        return score(network, batch, how.draws, int(next(seeds)) if network.training else seed)

    @torch.no_grad()
    def on_held() -> float:
        return float(score(model.eval(), (features[held], held), CHECKS, seed + 1))

    before, start = on_held(), copy.deepcopy(model.state_dict())
    for part in frozen:
        part.requires_grad_(False)
    train(
        model,
        loss,
        (features[fitted], fitted),
        (features[held], held),
        how.training,
        seed=seed,
        progress=progress,
    )
    for part in frozen:
        part.requires_grad_(True)
    after = on_held()
    kept = after < before
    if not kept:
        model.load_state_dict(start)
    return {"energy before": before, "energy after": after, "refined": float(kept)}


def energy_score(made: Tensor, observed: Tensor, mask: Tensor) -> Tensor:
    """The energy score (n,) of S simulations (n, S, T, d) of measured outputs (n, T, d).

    All measured samples and outputs are one vector, its norm per root of the number of samples;
    unbiased for any number of simulations.
    """
    seen = mask.all(dim=-1)
    weight = (seen / seen.sum(dim=1, keepdim=True).clamp_min(1)).sqrt()[:, None, :, None]
    flat = ((made - torch.nan_to_num(observed)[:, None]) * weight).flatten(2)
    draws = flat.shape[1]
    error = _norm(flat).mean(dim=1)
    one, other = torch.triu_indices(draws, draws, 1)
    return error - 0.5 * _norm(flat[:, one] - flat[:, other]).mean(dim=1)


def _norm(vectors: Tensor) -> Tensor:
    """Their lengths; differentiable where there is none."""
    return (vectors.square().sum(dim=-1) + 1e-24).sqrt()


def _unit(observed: Tensor, mask: Tensor, outputs: Channels) -> Tensor:
    """What outputs are divided by, (d,): their spread, or one for all where units are the same."""
    spread = observed[mask.all(dim=-1)].std(dim=0).clamp_min(1e-12)
    return spread.mean().expand_as(spread) if outputs.comparable else spread
