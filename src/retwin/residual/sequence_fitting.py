"""Fitting the RG per time step: windows, parts held out with a gap, and what those parts tell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.corrections import Context, Correction, Discrepancy
from retwin.errors import InputError
from retwin.mixture import Blocks
from retwin.residual.penalties import penalties
from retwin.residual.sequence import SequenceMixture, SequenceResidual, past, widened
from retwin.training import Fit, Loss, isolated, train
from retwin.trajectories import Trajectories
from retwin.twins.protocol import Progress

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
    `rmse_NAME` in the output's unit, `nll`, `coverage90`, and the `spread` that was needed. Members
    stopped early on those parts, which flatters them a little.
    """
    with isolated(seed):
        model = SequenceResidual(correction, density, inputs=used.inputs, outputs=used.outputs)
    data = _Records(past(context), found.z.float(), found.identified.all(dim=-1))
    n, steps = data.known.shape
    held = held_parts(n, steps, density)
    if not (held & data.known).flatten(1).any(dim=1).all():
        raise InputError(
            "calibration",
            expected=f"measurements in each of {density.members} parts of the data",
            got=f"{int(data.known.sum())} measured samples, some parts with none",
            remedy="give longer records, fewer members, or shorter blocks",
        )
    _prepare(model, data, bounds, seed)
    fits = []
    for k, member in enumerate(model.members):
        near = _dilated(held[k], density.gap)
        fits.append(
            train(
                member,
                _objective(model),
                data.windows(density, data.known & ~near),
                (data.features, data.z, data.known & held[k]),
                density.training,
                seed=seed + k,
            )
        )
        if progress is not None:
            progress((k + 1) / (len(model.members) * (1 + density.refit)))
    figures = _calibrate(model, data, held)
    epochs = _best_epoch(fits)
    if density.refit:
        _refit(model, data, epochs, seed, progress)
    model.emulated = used.emulated
    model.fitted = _summary(fits, figures, epochs)
    return model.eval()


def _best_epoch(fits: list[Fit]) -> int:
    """The epoch after which members together erred least on what they held out, in proportion.

    Geometric means: a part that is like no other errs by far the most and must not decide alone.
    """
    curves = [fit.history["validation"] for fit in fits]
    shortest = min(len(curve) for curve in curves)
    return 1 + int(np.argmin(np.mean([np.log(curve[:shortest]) for curve in curves], axis=0)))


def _refit(
    model: SequenceResidual, data: _Records, epochs: int, seed: int, progress: Progress | None
) -> None:
    """All members anew on all data, for as long as proved best."""
    how = replace(model.density.training, epochs=epochs)
    with isolated(seed + 1):
        model.members = model.fresh()
    _start(model, data, seed)
    for k, member in enumerate(model.members):
        train(
            member,
            _objective(model),
            data.windows(model.density, data.known),
            None,
            how,
            seed=seed + len(model.members) + k,
        )
        if progress is not None:
            progress(0.5 + (k + 1) / (2 * len(model.members)))


@dataclass(frozen=True, eq=False)
class _Records:
    """What is known of each sample (n, T, F), its z (n, T, d_z), and whether that is known."""

    features: Tensor
    z: Tensor
    known: Tensor

    def windows(self, density: SequenceMixture, usable: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features, z and flags of windows (m, W); what only warms the network up is not flagged.

        The network starts at rest in each window as it does at a record's begin.
        """
        steps = usable.shape[1]
        width = min(density.window, steps)
        stride = max(1, (width - density.burn_in) // 2)
        starts = sorted({*range(0, steps - width, stride), steps - width})
        time = torch.arange(width)
        parts: list[tuple[Tensor, Tensor, Tensor]] = []
        for start in starts:
            inside = slice(start, start + width)
            warm = (time >= density.burn_in) | (start == 0)
            parts.append((self.features[:, inside], self.z[:, inside], usable[:, inside] & warm))
        features, z, flags = (torch.cat(each) for each in zip(*parts, strict=True))
        some = flags.any(dim=1)
        return features[some], z[some], flags[some]


def held_parts(n: int, steps: int, density: SequenceMixture) -> Tensor:
    """(members, n, T) bool: what each member holds out; all of them together hold out everything.

    Whole records where there are enough of them, else blocks of samples dealt out in turn.
    """
    if n >= density.members:
        turn = (torch.arange(n) % density.members)[:, None].expand(n, steps)
    else:
        # Not fewer blocks than members, however short a record is.
        block = min(density.block, max(1, n * steps // density.members))
        turn = (torch.arange(n * steps) // block % density.members).view(n, steps)
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
    model.scale.copy_(values.std(dim=0, correction=0).clamp_min(1e-9))
    model.bounds.copy_(1.25 * values.abs().amax(dim=0).clamp_min(1e-9))
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
    """L_RG of Eq. 10 over t; in validation the mean's error, as widths are calibrated after."""
    density = model.density

    def loss(member: Any, batch: tuple[Tensor, ...]) -> Tensor:
        features, z, known = batch
        law = Blocks(model.law(member, features))
        if not member.training:
            error = ((law.mean - z) / model.scale).square().mean(dim=-1)
            return (error * known).sum() / known.sum().clamp_min(1)
        width = (law.variance.sqrt() / model.scale).detach().mean(dim=-1)
        nll = -law.log_prob(z) * width ** (2 * density.moderation)
        nll = torch.where(known, nll, 0.0).sum() / known.sum().clamp_min(1)
        return nll + penalties(
            law.mean, model.bounds, model.scale, known, density.smoothness, density.boundedness
        )

    return loss


@torch.no_grad()
def _calibrate(model: SequenceResidual, data: _Records, held: Tensor) -> dict[str, float]:
    """How wide and how persistent errors are where a member has not looked; the figures there."""
    model.eval()
    held = held & data.known
    plain = list(model.laws(data.features))

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
    error = torch.stack([law.mean - data.z for law in laws])[held]
    rmse = error.square().mean(dim=0).sqrt().tolist()
    figures = {
        "samples": float(held.sum()),
        "nll": -likelihood(spread) / int(held.sum()),
        "spread": spread,
        "coverage90": float((scores[held].abs() < MIDDLE).float().mean()),
    }
    return figures | {f"rmse_{name}": e for name, e in zip(model.latent.names, rmse, strict=True)}


def _persistence(scores: Tensor, held: Tensor) -> Tensor:
    """Correlation of neighbouring normal scores (…, T, d_z) where both are `held`, (d_z,)."""
    both = held[..., 1:] & held[..., :-1]
    ahead, now = scores[..., 1:, :][both], scores[..., :-1, :][both]
    power = 0.5 * (ahead.square() + now.square()).sum(dim=0)
    return ((ahead * now).sum(dim=0) / power.clamp_min(1e-9)).clamp(0.0, LONGEST)


def _summary(fits: list[Fit], figures: dict[str, float], epochs: int) -> Fit:
    """What the members' trainings were like, as one."""
    history = {
        f"{name} {k + 1}": values
        for k, fit in enumerate(fits)
        for name, values in fit.history.items()
    }
    best = sorted(fit.best_epoch for fit in fits)
    reason = f"{len(fits)} members, each best after {best[0]} to {best[-1]} epochs, all {epochs}"
    return Fit(figures, history, epochs, reason)
