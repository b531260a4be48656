"""Fitting the residual model per sample: windows, cross-validation, calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.checks import require
from retwin.nets.mixtures import Blocks
from retwin.nets.training import Fit, Loss, isolated, train
from retwin.progress import Progress, part_of
from retwin.update.residual.residual import BOUND_MARGIN, SMALLEST, mean_where
from retwin.update.residual.sequence import (
    SequenceMixture,
    SequenceResidual,
    past,
    scale_deviations,
    shrunk,
)
from retwin.update.residual.targets import ResidualTask

SPREADS = np.geomspace(0.5, 4.0, 85)
"""Candidates for the factor of the standard deviations, 2.5 % from one to the next."""
MAX_PERSISTENCE = 0.999
"""Largest persistence; beyond it the correlation time exceeds the length of common records."""


def fit_sequence(task: ResidualTask, density: SequenceMixture) -> SequenceResidual:
    """Fit the residual model of measured records, given their discrepancies.

    Parameters
    ----------
    task : ResidualTask
        Measured records, at least one, and the seed of initial weights, order of windows and
        dropout.
    density : SequenceMixture
        Settings.

    Returns
    -------
    SequenceResidual
        Its `fitted.figures` are of held-out parts, each predicted by the member that did not train
        on it: `rmse_NAME` in the output's unit, `rmse_NAME/constant` of the mean of z as the
        prediction, `trust_NAME`, the factor by which means are shrunk, `nll`, `coverage90` and
        `spread`. Both factors are chosen on the same parts, so the figures are slightly optimistic.

    Raises
    ------
    InputError
        A part of the data has no measurement, or a bound is not positive.

    """
    used, found, seed = task.used, task.found, task.seed
    with isolated(seed):
        model = SequenceResidual(task.correction, density, inputs=used.inputs, outputs=used.outputs)
    identified = found.identified.all(dim=-1)
    data = _Records(past(task.context), found.z.float(), identified, torch.as_tensor(used.lengths))
    valid = torch.arange(used.steps) < data.lengths[:, None]
    held_out = held_out_parts(valid, density)
    measured = (held_out & identified).flatten(1).any(dim=1).all()
    expected = f"measurements in each of {density.members} parts of the data"
    got = f"{int(identified.sum())} measured samples, some parts with none"
    remedy = "give longer records, fewer members, or shorter blocks"
    require(measured, "calibration", expected=expected, got=got, remedy=remedy)
    _prepare(model, data, task.bounds, seed)
    fitted = torch.stack([identified & ~_dilate(part, density.margin) for part in held_out])
    rounds = 1 + density.refit
    fit = _train_members(model, data, fitted, seed, part_of(task.progress, 0, rounds))
    figures = _calibrate(model, data, held_out)
    if density.refit:
        with isolated(seed + 1):
            model.members = model.fresh()
        _initialise(model, data, seed)
        every = identified.expand_as(fitted)
        fit = _train_members(model, data, every, seed + 1, part_of(task.progress, 1, rounds))
    model.fitted = replace(fit, figures=figures, reason=f"{density.members} members, {fit.reason}")
    return model


def _train_members(
    model: SequenceResidual, data: _Records, fitted: Tensor, seed: int, progress: Progress | None
) -> Fit:
    """Train all members together to the last epoch on their samples `fitted` (K, n, T).

    Held-out parts do not stop the training early, since members are calibrated on them. The loss is
    a sum over members, so that gradients are those of each alone.
    """
    how, windows = model.density.training, data.windows(model.density, fitted)
    epochs = model.density.max_steps * how.batch_size // len(windows[0])
    epochs = min(how.max_epochs, max(1, epochs))
    how = replace(how, max_epochs=epochs)
    return train(model.members, _objective(model), windows, None, how, seed=seed, progress=progress)


@dataclass(frozen=True, eq=False)
class _Records:
    """Features (n, T, F), z (n, T, d_z), whether z is identified (n, T), and lengths (n,)."""

    features: Tensor
    z: Tensor
    identified: Tensor
    lengths: Tensor

    def windows(self, density: SequenceMixture, usable: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features, z and flags of windows, (m, W, ·); samples of the burn-in are not flagged.

        Usable samples and flags have one entry for each member, (K, n, T) and (m, W, K).
        """
        longest = int(self.lengths.max())
        width = min(density.window, longest)
        stride = max(1, (width - density.burn_in) // 2)
        # The last window of a record ends with it.
        last = (self.lengths - width).clamp_min(0)
        grid = torch.arange(0, longest - width + stride, stride)[:, None]
        row, record = (grid < last + stride).nonzero().unbind(dim=1)
        starts = torch.minimum(grid, last)[row, record][:, None]
        time = torch.arange(width)
        inside = record[:, None], starts + time
        settled = (time >= density.burn_in) | (starts == 0)
        flags = usable.movedim(0, -1)[inside] & settled[..., None]
        some = flags.flatten(1).any(dim=1)
        return self.features[inside][some], self.z[inside][some], flags[some]


def held_out_parts(valid: Tensor, density: SequenceMixture) -> Tensor:
    """The folds of the cross-validation: whole records if there are enough, or else blocks.

    Parameters
    ----------
    valid : Tensor
        (n, T) bool, the samples that are no padding.
    density : SequenceMixture
        Settings.

    Returns
    -------
    Tensor
        (members, n, T) bool, the samples that each member holds out; together they are all.

    """
    if len(valid) >= density.members:
        fold = (torch.arange(len(valid)) % density.members)[:, None].expand_as(valid)
    else:
        # A short record has at least as many blocks as there are members.
        block = min(density.block, max(1, int(valid.sum()) // density.members))
        place = (valid.flatten().cumsum(dim=0) - 1).view_as(valid)
        fold = place // block % density.members
    return fold == torch.arange(density.members)[:, None, None]


def _dilate(held_out: Tensor, margin: int) -> Tensor:
    """The flags (n, T) with `margin` samples more on either side."""
    wide = torch.nn.functional.max_pool1d(held_out.float()[:, None], 2 * margin + 1, 1, margin)
    return wide[:, 0] > 0


@torch.no_grad()
def _prepare(model: SequenceResidual, data: _Records, bounds: NDArray | None, seed: int) -> None:
    """Take units, bounds and initial heads of the model from the data that it is trained on."""
    values = data.z[data.identified]
    model.before.fit(data.features[data.identified])
    model.shift.copy_(values.mean(dim=0))
    largest = values.abs().amax(dim=0).clamp_min(SMALLEST)
    model.scale.copy_(values.std(dim=0, correction=0).maximum(1e-6 * largest))
    model.bounds.copy_(BOUND_MARGIN * largest)
    model.take_bounds(bounds)
    _initialise(model, data, seed)


@torch.no_grad()
def _initialise(model: SequenceResidual, data: _Records, seed: int) -> None:
    """Start every head at the mixture of all z."""
    standard = ((data.z[data.identified] - model.shift) / model.scale).double()
    for k, member in enumerate(model.members):
        heads: Any = member.heads
        for head, part in zip(heads, standard.split(model.sizes, dim=-1), strict=True):
            head.initialise(part.numpy(), seed + k)


def _objective(model: SequenceResidual) -> Loss:
    """L_RG of Eq. 10 over t."""
    density = model.density

    def loss(_: Any, batch: tuple[Tensor, ...]) -> Tensor:
        features, z, flags = batch
        used, distribution = flags.movedim(-1, 0), Blocks(model.predict(features))
        deviation = (distribution.variance.sqrt() / model.scale).detach().mean(dim=-1)
        nll = -distribution.log_prob(z) * deviation ** (2 * density.moderation)
        return (mean_where(nll, used) + model.penalise(distribution.mean, used)).sum()

    return loss


@torch.no_grad()
def _calibrate(model: SequenceResidual, data: _Records, held_out: Tensor) -> dict[str, float]:
    """Set shrinkage, spread and persistence from held-out parts; the figures of these parts."""
    model.eval()
    held_out = held_out & data.identified
    predicted = model.predict(data.features)
    means = Blocks(predicted).mean
    z = data.z.expand_as(means)[held_out]
    model.trust.copy_(_trust(means[held_out] - model.shift, z - model.shift))
    predicted = shrunk(predicted, model.shift.split(model.sizes), model.trust.split(model.sizes))

    def with_spread(spread: float) -> Blocks:
        own = torch.full_like(model.spread, spread).split(model.sizes)
        return Blocks(scale_deviations(predicted, own))

    def log_likelihood(spread: float) -> float:
        return float(with_spread(spread).log_prob(data.z)[held_out].sum())

    spread = max(SPREADS.tolist(), key=log_likelihood)
    model.spread.fill_(spread)
    distribution = with_spread(spread)
    scores = distribution.normal_scores(data.z.expand_as(means))
    if model.density.persistent:
        model.persistence.copy_(_persistence(scores, held_out))
    # Absolute value that a standard normal variable exceeds with probability 0.1.
    figures = {
        "samples": float(held_out.sum()),
        "nll": -log_likelihood(spread) / int(held_out.sum()),
        "spread": spread,
        "coverage90": float((scores[held_out].abs() < 1.6449).float().mean()),
    }
    error = distribution.mean[held_out] - z
    by_name = {
        "rmse_{}": error.square().mean(dim=0).sqrt(),
        "rmse_{}/constant": (z - model.shift).square().mean(dim=0).sqrt(),
        "trust_{}": model.trust,
    }
    for label, values in by_name.items():
        for name, value in zip(model.latent.names, values.tolist(), strict=True):
            figures[label.format(name)] = value
    return figures


def _trust(predicted: Tensor, z: Tensor) -> Tensor:
    """The factors (d_z,), from 0 to 1, that fit predicted means (k, d_z) to z by least squares.

    A network trained on one record explains more of it than of others; a mean that explains nothing
    of held-out parts has the factor 0.
    """
    power = predicted.square().sum(dim=0).clamp_min(1e-12)
    return ((predicted * z).sum(dim=0) / power).clamp(0.0, 1.0)


def _persistence(scores: Tensor, held_out: Tensor) -> Tensor:
    """Lag-one autocorrelation (d_z,) of normal scores (..., T, d_z) where both are held out."""
    both = held_out[..., 1:] & held_out[..., :-1]
    following, current = scores[..., 1:, :][both], scores[..., :-1, :][both]
    power = 0.5 * (following.square() + current.square()).sum(dim=0)
    correlation = (following * current).sum(dim=0) / power.clamp_min(1e-9)
    return correlation.clamp(0.0, MAX_PERSISTENCE)
