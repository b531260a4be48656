"""Whether a regression of the offsets predicts conditions that it was not fitted to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from retwin.inference.hierarchy import Hierarchy, Likelihood
from retwin.update.corrections.commands.offset_features import OffsetFeatures
from retwin.update.corrections.commands.problem import CommandProblem

FOLDS = 5
"""Parts of the conditions, each of which is left out in turn."""


def regression_predicts_better(
    features: OffsetFeatures, hierarchy: Hierarchy, problem: CommandProblem, likelihood: Likelihood
) -> bool:
    """Whether offsets of conditions left out are more probable by a regression than by a constant.

    All replicates of a condition are left out together: a regression that has seen one of them has
    nothing to predict. Compared is the log density of the linearised problem.

    Parameters
    ----------
    features : OffsetFeatures
        Those of a constant.
    hierarchy : Hierarchy
        The hyperparameters for it.
    problem : CommandProblem
        Of all trajectories.
    likelihood : Likelihood
        Of their outputs.

    """
    every = features.conditions(problem)
    index = every.flatten(0, 1).unique(dim=0, return_inverse=True)[1].view(every.shape[:2])
    shown = index[problem.valid].unique()
    if len(shown) < 2:
        return False
    order = np.random.default_rng(0).permutation(len(shown))
    folds = [torch.isin(index, shown[order[k::FOLDS]]) for k in range(min(FOLDS, len(shown)))]
    masks = [(each & problem.valid)[..., None].expand(*each.shape, problem.size) for each in folds]
    both = (replace(features, regression=each) for each in (False, True))
    constant, regression = (_density(e, hierarchy, problem, likelihood, masks) for e in both)
    gain = regression - constant
    # A gain that is within its standard error is none.
    return bool(gain.sum() > len(gain) ** 0.5 * gain.std())


def _density(
    features: OffsetFeatures,
    hierarchy: Hierarchy,
    problem: CommandProblem,
    likelihood: Likelihood,
    folds: list[Tensor],
) -> Tensor:
    """Log predictive densities (K,) of the outputs of each fold, given those of the others."""
    design = features.design(problem)
    start = hierarchy.adapted(design).learned(design, likelihood)
    densities = []
    for fold in folds:
        kept = (~fold).flatten(1).to(design.used)
        rest = likelihood.weighted(kept)
        found = start.learned(replace(design, used=design.used * kept), rest)
        densities.append(found.evidence(design, likelihood) - found.evidence(design, rest))
    return torch.tensor(densities)
