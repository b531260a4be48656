"""Fitting the residual model per segment: folds of trajectories, calibration, refit."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from retwin.nets.mixtures import BernoulliHead, Blocks
from retwin.nets.student import widening
from retwin.nets.training import Fit, Training, train
from retwin.progress import part_of
from retwin.update.residual.model import ResidualModel
from retwin.update.residual.residual import BOUND_MARGIN, SMALLEST
from retwin.update.residual.targets import ResidualTask, Targets

SPREADS = np.geomspace(1.0, 4.0, 57)
"""Candidates for the factor of the deviations, 2.5 % from one to the next: none is narrower than
what was learned."""
LEVEL = 0.9
"""Share of held-out z that the central interval of that probability is to hold."""
QUANTILE = float(stats.norm.ppf((1 + LEVEL) / 2))
"""Normal score at the end of that interval."""
PERSISTENCES = np.linspace(0.0, 0.95, 96)
"""Values of the persistence that are equally probable before the data."""

Predicted = list[tuple[Blocks, Targets]]
"""What models predict for trajectories that they were not trained on, and the z of these."""


def fit_segments(model: ResidualModel, targets: Targets, task: ResidualTask) -> tuple[Fit, Tensor]:
    """Train `model` in place, and calibrate it on trajectories that it was not trained on.

    A fifth of the trajectories, or one, is held out for early stopping. Where that is too few to
    calibrate on, further folds are held out in turn, each by a model of its own; the model is then
    trained on all trajectories, for as many epochs as were best on average. Its deviations are
    widened to those with which 90 % intervals hold 90 % of held-out z. Since they are estimated
    from few trajectories, they have degrees of freedom, see `Student`.

    Parameters
    ----------
    model : ResidualModel
        With its initial weights.
    targets : Targets
        z of all trajectories.
    task : ResidualTask
        Bounds, and the seed of folds, order of examples and dropout.

    Returns
    -------
    Fit, Tensor
        The record, whose figures are `spread`, the largest factor of the deviations of a block
        that held-out z need, and `folds`; and the trajectories of the first fold, none if there is
        a single one.

    """
    rows = targets.valid.any(dim=1).nonzero().flatten()
    targets = targets[rows]
    # Of a single trajectory two halves are held out in turn, as if they were two.
    parts = targets if len(rows) > 1 else targets.halved()
    folds = _folds(len(parts.valid), task.seed)
    runs = len(folds) + (len(folds) > 1)
    members = [copy.deepcopy(model) for _ in folds] if len(folds) > 1 else [model]
    fits = []
    for k, (member, held_out) in enumerate(zip(members, folds, strict=True)):
        every = torch.arange(len(parts.valid))
        rest = every[~torch.isin(every, held_out)]
        own = part_of(task.progress, k, runs)
        fits.append(_trained(member, parts[rest], parts[held_out], replace(task, progress=own)))
    with torch.no_grad():
        pairs = zip(members, map(parts.__getitem__, folds), strict=True)
        unseen = [(each.predict(part.features), part) for each, part in pairs]
        spread = _spread(model, unseen)
        persistence = _persistence(unseen, single=len(rows) == 1)
    if len(folds) > 1:
        epochs = round(float(np.mean([fit.best_epoch for fit in fits])))
        how = replace(model.density.training, max_epochs=epochs)
        last = replace(task, progress=part_of(task.progress, len(folds), runs))
        refit = _trained(model, targets, None, last, how)
        reason = f"{epochs} epochs, as many as were best on average in {len(folds)} folds"
        fits.append(replace(refit, reason=reason))
    # Events are too few to show whether they persist.
    model.persistence.copy_(persistence.masked_fill(model.events, 0.0))
    # What held-out z need are deviations; those of the refitted model may be larger already.
    needed = spread * _deviation(unseen)
    if len(rows) == 1:
        # Deviations that were learned from half a trajectory are chance: the errors are a bound.
        needed = torch.minimum(needed, _errors(model, unseen))
    ratio = needed / _deviation([(model.predict(part.features), part) for _, part in unseen])
    model.spread.copy_(torch.where(model.events, 1.0, ratio.clamp_min(1.0)))
    model.degrees = _degrees(model, targets, persistence)
    if task.bounds is None:
        # The largest of few |z*| is uncertain as the width is. The spread corrects the network.
        wider = torch.tensor([widening(each) for each in model.degrees])
        model.bounds.mul_(wider.repeat_interleave(torch.tensor(model.sizes)))
    figures = {"spread": float(spread.max()), "folds": float(len(folds))}
    return replace(fits[-1], figures=figures), rows[folds[0]] if len(rows) > 1 else rows[:0]


def _folds(count: int, seed: int, *, held_out: int = 20) -> list[Tensor]:
    """The trajectories that each fold holds out, as many folds as hold out enough in all.

    Parameters
    ----------
    held_out : int, default 20
        Trajectories to hold out at least, over all folds: a standard deviation from twenty values
        has a standard error of 16 %.

    """
    order = torch.as_tensor(np.random.default_rng(seed).permutation(count))
    size = max(1, round(0.2 * count))
    return list(order.split(size)[: -(-held_out // size)])


def _trained(
    model: ResidualModel,
    fitted: Targets,
    held_out: Targets | None,
    task: ResidualTask,
    how: Training | None = None,
) -> Fit:
    """Train `model` in place, with units, bounds and initial heads from its training data."""
    _prepare(model, fitted, task.bounds, task.seed)
    sets = fitted.examples(model), None if held_out is None else held_out.examples(model)
    how = how or model.density.training
    return train(model, _objective, *sets, how, seed=task.seed, progress=task.progress)


def _spread(model: ResidualModel, held_out: Predicted) -> Tensor:
    """The factors (d_z,) with which intervals hold held-out z as often as they should, per block.

    By coverage and not by likelihood, which a single missed segment would dominate.
    """
    spread = torch.ones(len(model.latent))
    narrow = [block for head, block in model.parts() if not isinstance(head, BernoulliHead)]
    for factor in SPREADS.tolist():
        for block in narrow:
            spread[block] = factor
        held, used = [], []
        for distribution, part in held_out:
            scores = distribution.widened(torch.full_like(spread, factor)).normal_scores(part.z)
            held.append((scores.abs() <= QUANTILE).float().mean(dim=0) * part.used)
            used.append(part.used)
        inside, count = (torch.cat(each).double().sum(dim=(0, 1)) for each in (held, used))
        narrow = [block for block in narrow if inside[block].sum() < LEVEL * count[block].sum()]
        if not narrow:
            break
    return spread


@torch.no_grad()
def _deviation(held_out: Predicted) -> Tensor:
    """Geometric mean of the deviations (d_z,) that models predict for held-out segments."""
    variances = [distribution.variance[part.valid] for distribution, part in held_out]
    return (0.5 * torch.cat(variances).log().mean(dim=0)).exp()


@torch.no_grad()
def _errors(model: ResidualModel, held_out: Predicted) -> Tensor:
    """The deviations (d_z,) of normal distributions as wide as the errors of held-out z.

    Components of a block have the same deviation in their units, `ResidualModel.scale`.
    """
    unit = model.scale
    error = torch.cat([((part.z - own.mean) / unit).abs() for own, part in held_out], dim=1)
    used = torch.cat([part.used for _, part in held_out])
    found = torch.full_like(unit, torch.inf)
    for _, block in model.parts():
        own = error[:, used[..., block].any(dim=-1)][..., block].flatten()
        if len(own):
            found[block] = own.quantile(LEVEL) / QUANTILE
    return found * unit


def _persistence(held_out: Predicted, *, single: bool) -> Tensor:
    """Correlation (d_z,) of normal scores between the segments of a trajectory.

    It is the mean of its posterior given the ratio of the variances between and within held-out
    trajectories (one-way analysis of variance), all values being equally probable before the data.
    """
    scores, used = [], []
    for distribution, part in held_out:
        score = distribution.normal_scores(part.z).mean(dim=0)
        score = torch.where(part.used, score, torch.nan)
        # The error of a prediction from the other folds is in the mean of a fold, K / (K - 1) of
        # what the mean of all trajectories would leave there.
        scores.append(score - score.nanmean(dim=(0, 1)) / len(held_out))
        used.append(part.used)
    width = scores[0].shape[-1]
    if single:
        return torch.full((width,), float(PERSISTENCES.mean()))
    score, count = torch.cat(scores).double(), torch.cat(used).sum(dim=1)
    return torch.tensor([_intraclass(score[..., d], count[:, d]) for d in range(width)])


def _intraclass(score: Tensor, count: Tensor) -> float:
    """The posterior mean of the intraclass correlation of scores (n, M), `count` (n,) of them."""
    several = count > 1
    score, size = score[several], count[several]
    free = len(size) - 1, int((size - 1).sum())
    if free[0] < 1:
        return 0.0
    mean = score.nanmean(dim=1)
    within = torch.nansum((score - mean[:, None]).square()) / free[1]
    middle = (size * mean).sum() / size.sum()
    between = (size * (mean - middle).square()).sum() / free[0]
    if not within > 0:
        return 0.0
    inflation = 1 + float(size.double().mean()) * PERSISTENCES / (1 - PERSISTENCES)
    logs = stats.f.logpdf(float(between / within) / inflation, *free) - np.log(inflation)
    weights = np.exp(logs - logs.max())
    return float(weights @ PERSISTENCES / weights.sum())


def _degrees(model: ResidualModel, targets: Targets, persistence: Tensor) -> list[float]:
    """Degrees of freedom of the width of each block, those of one component on average.

    They are those of a variance from correlated values: the squares of normal scores of correlation
    r correlate by r². The components of a block are not added up: each has a variance of its own,
    and where a covariance is estimated, Student's t has no more degrees than for one of them.
    """
    count = targets.used.sum(dim=(0, 1))
    size = count / targets.used.any(dim=1).sum(dim=0).clamp_min(1)
    effective = count / (1 + (size - 1).clamp_min(0) * persistence.square())
    free = (effective - 1).clamp_min(1).double()
    return [
        math.inf if isinstance(head, BernoulliHead) else float(free[block].mean())
        for head, block in model.parts()
    ]


@torch.no_grad()
def _prepare(model: ResidualModel, targets: Targets, bounds: NDArray | None, seed: int) -> None:
    """Take units, bounds and initial heads of the model from the data that it is trained on."""
    valid, z = targets.valid, targets.z
    model.before.fit(targets.features[valid])
    for head, part in model.parts():
        if isinstance(head, BernoulliHead):
            model.shift[part], model.scale[part], model.bounds[part] = 0.0, 1.0, 1.0
            head.initialise(z[:, valid][..., part].flatten(0, 1).double().numpy(), seed)
            continue
        identified = targets.identified[..., part].all(dim=-1) & valid
        values = z[:, identified if identified.any() else valid][..., part].flatten(0, 1)
        # Robust: the unit of z must not depend on a few missed segments.
        shift = values.median(dim=0).values
        scale = 1.4826 * (values - shift).abs().median(dim=0).values
        spread = values.std(dim=0, correction=0)
        largest = values.abs().amax(dim=0).clamp_min(SMALLEST)
        scale = torch.maximum(scale, 0.1 * spread).maximum(1e-6 * largest)
        model.shift[part], model.scale[part] = shift, scale
        model.bounds[part] = BOUND_MARGIN * largest
        head.initialise(((values - shift) / scale).double().numpy(), seed)
    model.take_bounds(bounds)


def _objective(model: Any, batch: tuple[Tensor, ...]) -> Tensor:
    """L_RG of Eq. 10, averaged over segments."""
    features, z, identified, valid = batch
    distribution = model.predict(features)
    # Blocks that are not identified hold a finite placeholder and are not in the likelihood.
    log_prob = torch.where(identified, distribution.block_log_prob(z), 0.0).sum()
    nll = -log_prob / identified.sum().clamp_min(1) * identified.shape[-1]
    return nll + model.penalise(distribution.mean, valid)
