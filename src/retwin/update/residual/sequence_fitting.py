"""Fitting the RG per time step: windows, parts held out with a gap, and what those parts tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.nets.mixtures import Blocks
from retwin.nets.training import Fit, Loss, isolated, train
from retwin.progress import Progress
from retwin.update.corrections import Context, Correction, Discrepancy
from retwin.update.residual.penalties import penalties
from retwin.update.residual.sequence import (
    SequenceMixture,
    SequenceResidual,
    past,
    trusted,
    widened,
)

__all__ = ["fit_sequence", "held_parts"]

SPREADS = np.geomspace(0.5, 4.0, 85)
"""Factors by which members may prove too wide or too narrow."""
MIDDLE = 1.6449
"""Nine tenths of normal scores are smaller."""
LONGEST = 0.999
"""Persistence that is never exceeded: beyond, a record shows no end of it."""


def fit_sequence(
    used: Trajectories,
    correction: Correction,
    density: SequenceMixture,
    context: Context,
    found: Discrepancy,
    *,
    seed: int,
    bounds: NDArray | None = None,
    progress: Progress | None = None,
) -> SequenceResidual:
    """The RG of measured records `used`, one at least, whose z* was `found`.

    Its `fitted.figures` tell of parts held out, each judged by the member that did not see it:
    `rmse_NAME` in the output's unit, beside `rmse_NAME/constant` of a z that is always the mean,
    `trust_NAME`, `nll`, `coverage90`, and the `spread` that was needed. Trust and spread are chosen
    on those parts, which flatters them a little.
    """
    with isolated(seed):
        model = SequenceResidual(correction, density, inputs=used.inputs, outputs=used.outputs)
    known = found.identified.all(dim=-1)
    data = _Records(past(context), found.z.float(), known, torch.as_tensor(used.lengths))
    there = torch.arange(used.steps) < data.lengths[:, None]
    held = held_parts(there, density)
    if not (held & data.known).flatten(1).any(dim=1).all():
        raise InputError(
            "calibration",
            expected=f"measurements in each of {density.members} parts of the data",
            got=f"{int(data.known.sum())} measured samples, some parts with none",
            remedy="give longer records, fewer members, or shorter blocks",
        )
    _prepare(model, data, bounds, seed)
    seen = [data.known & ~_dilated(part, density.gap) for part in held]
    tell = _told(progress, (1 + density.refit) * len(seen))
    fits = _trained(model, data, seen, seed, tell)
    figures = _calibrate(model, data, held)
    if density.refit:
        with isolated(seed + 1):
            model.members = model.fresh()
        _start(model, data, seed)
        fits = _trained(model, data, [data.known] * len(seen), seed + len(seen), tell)
    model.emulated = used.emulated
    model.fitted = _summary(fits, figures)
    return model.eval()


def _told(progress: Progress | None, steps: int) -> Callable[[], None]:
    """Call it after each of so many steps."""
    done = count(1)
    return lambda: progress(next(done) / steps) if progress is not None else None


def _trained(
    model: SequenceResidual,
    data: _Records,
    seen: Sequence[Tensor],
    seed: int,
    tell: Callable[[], None],
) -> list[Fit]:
    """Each member trained to the end on what it has `seen` (n, T).

    None stops early on what it holds out: how much of its mean is to be believed is judged there.
    """
    fits = []
    for k, (member, part) in enumerate(zip(model.members, seen, strict=True)):
        windows = data.windows(model.density, part)
        how = model.density.training
        fits.append(train(member, _objective(model), windows, None, how, seed=seed + k))
        tell()
    return fits


@dataclass(frozen=True, eq=False)
class _Records:
    """What is known of each sample (n, T, F), its z (n, T, d_z), and whether that is known.

    Records have `lengths` (n,); what follows is padding.
    """

    features: Tensor
    z: Tensor
    known: Tensor
    lengths: Tensor

    def windows(self, density: SequenceMixture, usable: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features, z and flags of windows (m, W); what only warms the network up is not flagged.

        The network starts at rest in each window as it does at a record's begin.
        """
        longest = int(self.lengths.max())
        width = min(density.window, longest)
        stride = max(1, (width - density.burn_in) // 2)
        # The last window of a record ends with it.
        last = (self.lengths - width).clamp_min(0)
        begins = torch.arange(0, longest - width + stride, stride)[:, None]
        turn, record = (begins < last + stride).nonzero().unbind(dim=1)
        starts = torch.minimum(begins, last)[turn, record][:, None]
        time = torch.arange(width)
        inside = record[:, None], starts + time
        flags = usable[inside] & ((time >= density.burn_in) | (starts == 0))
        some = flags.any(dim=1)
        return self.features[inside][some], self.z[inside][some], flags[some]


def held_parts(there: Tensor, density: SequenceMixture) -> Tensor:
    """(members, n, T) bool: what each member holds out; all of them together hold out everything.

    Whole records where there are enough of them, else blocks of samples dealt out in turn, of those
    that are `there` (n, T) and no padding.
    """
    if len(there) >= density.members:
        turn = (torch.arange(len(there)) % density.members)[:, None].expand_as(there)
    else:
        # Not fewer blocks than members, however short a record is.
        block = min(density.block, max(1, int(there.sum()) // density.members))
        place = (there.flatten().cumsum(dim=0) - 1).view_as(there)
        turn = place // block % density.members
    return turn == torch.arange(density.members)[:, None, None]


def _dilated(held: Tensor, gap: int) -> Tensor:
    """What is held out (n, T), and `gap` samples on either side."""
    wide = torch.nn.functional.max_pool1d(held.float()[:, None], 2 * gap + 1, 1, gap)
    return wide[:, 0] > 0


@torch.no_grad()
def _prepare(model: SequenceResidual, data: _Records, bounds: NDArray | None, seed: int) -> None:
    """Standardise, bound and start the model from the data it is trained on."""
    values = data.z[data.known]
    model.before.fit(data.features[data.known])
    model.shift.copy_(values.mean(dim=0))
    largest = values.abs().amax(dim=0).clamp_min(1e-12)
    model.scale.copy_(values.std(dim=0, correction=0).maximum(1e-6 * largest))
    model.bounds.copy_(1.25 * largest)
    if bounds is not None:
        if np.shape(bounds) != (len(model.latent),) or not (np.asarray(bounds) > 0).all():
            raise InputError(
                "bounds",
                expected=f"one positive bound for each of {', '.join(model.latent.names)}",
                got=repr(bounds),
                remedy="leave bounds out to take them from the data",
            )
        model.bounds.copy_(torch.as_tensor(bounds, dtype=torch.float32))
    _start(model, data, seed)


@torch.no_grad()
def _start(model: SequenceResidual, data: _Records, seed: int) -> None:
    """Every head at the clusters of z, whatever the past."""
    standard = ((data.z[data.known] - model.shift) / model.scale).double()
    for k, member in enumerate(model.members):
        heads: Any = member.heads
        for head, part in zip(heads, standard.split(model.sizes, dim=-1), strict=True):
            head.initialise(part.numpy(), seed + k)


def _objective(model: SequenceResidual) -> Loss:
    """L_RG of Eq. 10 over t."""
    density = model.density

    def loss(member: Any, batch: tuple[Tensor, ...]) -> Tensor:
        features, z, known = batch
        law = Blocks(model.told(member, features))
        width = (law.variance.sqrt() / model.scale).detach().mean(dim=-1)
        nll = -law.log_prob(z) * width ** (2 * density.moderation)
        nll = torch.where(known, nll, 0.0).sum() / known.sum().clamp_min(1)
        return nll + penalties(
            law.mean, model.bounds, model.scale, known, density.smoothness, density.boundedness
        )

    return loss


@torch.no_grad()
def _calibrate(model: SequenceResidual, data: _Records, held: Tensor) -> dict[str, float]:
    """What to believe of members, seen where they have not looked; the figures there.

    How much of their means, how wide errors are, and how long they last.
    """
    model.eval()
    held = held & data.known
    plain = [model.told(member, data.features) for member in model.members]
    means = torch.stack([Blocks(law).mean for law in plain])
    z = data.z.expand_as(means)[held]
    trust = _trust(means[held] - model.shift, z - model.shift)
    model.trust.copy_(trust)
    plain = [
        trusted(law, *(each.split(model.sizes) for each in (model.shift, trust))) for law in plain
    ]

    def likelihood(spread: float) -> float:
        made = zip(plain, held, strict=True)
        told = (Blocks(widened(law, spread)).log_prob(data.z)[part].sum() for law, part in made)
        return float(sum(told))

    spread = max(SPREADS.tolist(), key=likelihood)
    model.spread.fill_(spread)
    laws = [Blocks(widened(law, spread)) for law in plain]
    scores = torch.stack([law.normal_scores(data.z) for law in laws])
    if model.density.persistent:
        model.persistence.copy_(_persistence(scores, held))
    figures = {
        "samples": float(held.sum()),
        "nll": -likelihood(spread) / int(held.sum()),
        "spread": spread,
        "coverage90": float((scores[held].abs() < MIDDLE).float().mean()),
    }
    error = torch.stack([law.mean for law in laws])[held] - z
    by_name = {
        "rmse_{}": error.square().mean(dim=0).sqrt(),
        "rmse_{}/constant": (z - model.shift).square().mean(dim=0).sqrt(),
        "trust_{}": trust,
    }
    for label, values in by_name.items():
        figures |= {
            label.format(name): value
            for name, value in zip(model.latent.names, values.tolist(), strict=True)
        }
    return figures


def _trust(told: Tensor, z: Tensor) -> Tensor:
    """The share of what members told (k, d_z) that comes nearest to z, from 0 to 1, (d_z,).

    A network that learned from one record sees more in it than holds elsewhere; a mean that holds
    nowhere else is worth nothing.
    """
    return ((told * z).sum(dim=0) / told.square().sum(dim=0).clamp_min(1e-12)).clamp(0.0, 1.0)


def _persistence(scores: Tensor, held: Tensor) -> Tensor:
    """Correlation of neighbouring normal scores (…, T, d_z) where both are `held`, (d_z,)."""
    both = held[..., 1:] & held[..., :-1]
    ahead, now = scores[..., 1:, :][both], scores[..., :-1, :][both]
    power = 0.5 * (ahead.square() + now.square()).sum(dim=0)
    return ((ahead * now).sum(dim=0) / power.clamp_min(1e-9)).clamp(0.0, LONGEST)


def _summary(fits: list[Fit], figures: dict[str, float]) -> Fit:
    """What the members' trainings were like, as one."""
    history = {f"train {k + 1}": fit.history["train"] for k, fit in enumerate(fits)}
    return Fit(figures, history, fits[0].best_epoch, f"{len(fits)} members, {fits[0].reason}")
