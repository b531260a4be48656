"""How commands pass between samples, chosen with the discrepancy where a twin leaves it open.

A wrong one is an error of half a sample, which no discrepancy explains. The errors of the twin
alone do not show which is right, since what the twin lacks is larger; those with the discrepancy
do. The search under held commands shows at little cost whether another one can be right: then that
is tried too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.equations.interpolation import INTERPOLATIONS
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.dynamics.candidates import (
    Candidate,
    best_of,
    better,
    searched,
    without_discrepancy,
)
from retwin.update.dynamics.estimation import Estimation
from retwin.update.dynamics.filter.noise import edges
from retwin.update.dynamics.linearised import Linearised
from retwin.update.dynamics.settings import Dynamics
from retwin.update.dynamics.unknowns import Unknowns

__all__ = ["chosen"]

Found = tuple[Estimation, Linearised, Candidate]


def chosen(
    base: StateTwin,
    observed: Trajectories,
    unknowns: Unknowns,
    settings: Dynamics,
    parts: Sequence[NDArray],
    progress: Progress,
) -> Found:
    """The fit of the twin alone, its optimum, and the best candidate for its discrepancy.

    A twin that gives its interpolation keeps it. Otherwise commands are held, unless another
    interpolation lowers the held-out errors of nearly all parts, those in time and those at the
    edges of the domain; of two that do, the simpler one is taken unless the other is better alike.

    Parameters
    ----------
    base : StateTwin
        The twin.
    observed : Trajectories
        The n trajectories.
    unknowns : Unknowns
        Its unknowns.
    settings : Dynamics
        The forms that are tried.
    parts : sequence of NDArray
        Parts (n, T) of the samples that are held out in turn.
    progress : callable
        Called with the share of the work that is done.

    """
    is_open = base.interpolation is None and base.step is None
    share = 0.5 if is_open else 0.95
    first, *others = INTERPOLATIONS if is_open else (base.interpolation,)
    held, fitted = without_discrepancy(replace(base, interpolation=first), observed, unknowns)
    progress(0.05)
    # The same states for all interpolations, so that their equations are compiled once.
    visited = held.simulated(fitted.point)[1]
    far = edges(visited, held.commands, settings.folds)

    def report(done: float) -> None:
        progress(0.05 + share * done)

    tried = searched(held, fitted.point, settings, visited, parts, far, report)
    best = (held, fitted, best_of(tried))
    for other in others:
        if not any(_is_shown(each, other, parts) for each in tried):
            continue
        try:
            own, at = without_discrepancy(replace(base, interpolation=other), observed, unknowns)
        except InputError:  # its simulation is not finite
            continue
        given = (own, at.point, settings, visited, parts, far, lambda done: None)
        # The best form first: where that gains nothing, the others are not tried.
        if better(best_of(searched(*given, only=best[2])), best[2]):
            best = (own, at, best_of(searched(*given)))
    return best


def _is_shown(candidate: Candidate, other: str, parts: Sequence[NDArray]) -> bool:
    """Whether the errors of a candidate are in the direction of another interpolation.

    That is its effect on the outputs, without what the unknowns can do instead: the errors are
    regressed on it, and the standard error of the coefficient is that over parts of the record.
    """
    estimation, found = candidate.estimation, candidate.found
    changed = replace(estimation, twin=replace(estimation.twin, interpolation=other))
    effect = found.residual - changed.residual(found.point)
    if not (found.finite and np.isfinite(effect).all()):
        return False
    effect = _subtract_explained(candidate, effect) / np.sqrt(estimation.variance)
    residual = found.residual / np.sqrt(estimation.variance)
    products = np.array(
        [[np.sum(effect[part] * each[part]) for part in parts] for each in (residual, effect)]
    )
    along, size = products
    if size.sum() <= 0:
        return False
    share = along.sum() / size.sum()
    # Number of standard errors by which the errors under held commands must be in the direction of
    # another interpolation before that is tried.
    return bool(share > 2.0 * np.sqrt(np.sum((along - share * size) ** 2)) / size.sum())


def _subtract_explained(candidate: Candidate, effect: NDArray) -> NDArray:
    """An effect (n, T, d_y) on the outputs without what the shared unknowns can do, linearly."""
    estimation, found = candidate.estimation, candidate.found
    matrix, k = estimation.unknowns.matrix, estimation.unknowns.count
    scale = 1 / np.sqrt(estimation.variance)
    curvature, gradient = np.zeros((k, k)), np.zeros(k)
    for rows, _, slope in estimation.derivatives(found.point):
        own = ((slope[..., : len(matrix)] @ matrix) * scale[:, None]).reshape(-1, k)
        curvature += own.T @ own
        gradient += own.T @ (effect[rows] * scale).ravel()
    step = np.linalg.pinv(curvature, hermitian=True) @ gradient
    made = effect.copy()
    for rows, _, slope in estimation.derivatives(found.point):
        made[rows] -= slope[..., : len(matrix)] @ (matrix @ step)
    return made
