"""How wide the distributions of corrected dynamics are, one step ahead and in free simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.update.dynamics.estimation import Estimation, correlation_time
from retwin.update.dynamics.filter.filtering import arrays_of
from retwin.update.dynamics.filter.noise_search import CHANCE, SMALLEST, Search, noisy
from retwin.update.dynamics.filter.prediction import Prediction
from retwin.update.dynamics.linearised import HeldOut
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.forecast_errors import LEVEL, USUAL

__all__ = ["edges", "fit_noise", "folds", "needed_factor", "widening"]

CERTAIN = 1.645
"""Standard errors between a quantile of held-out samples and its upper 95 % limit."""


def fit_noise(
    twin: DynamicsTwin,
    observed: Trajectories,
    corrected: Sequence[int],
    parts: Sequence[NDArray],
    moves: NDArray,
) -> DynamicsTwin:
    """The twin with the variances of w and v that maximise the likelihood of one-step predictions.

    Process noise acts on the corrected states, whose equations may be wrong. Each part of the
    record is predicted with the parameters that are estimated without it: with those that are
    fitted to it, it would seem to have less noise than other records. Noise in proportion to the
    change of a state is taken if nearly all parts are predicted better with it, where the noise is
    that of the other parts.

    Parameters
    ----------
    twin : DynamicsTwin
        The twin; its process noise is ignored.
    observed : Trajectories
        The n trajectories.
    corrected : sequence of int
        Indices of the corrected states.
    parts : sequence of NDArray
        K parts (n, T) of the samples, which do not overlap.
    moves : NDArray
        (K, q + d_x), by how much the values of the twin differ without each part; starts do not.

    """
    indices = np.array(corrected, dtype=int)
    # Number of samples from which the likelihood is computed, unless one trajectory has more. They
    # determine a variance to 1.4 %, and bands are scaled to all samples.
    number = max(1, min(len(observed), 10_000 // observed.steps))
    some = np.linspace(0, len(observed) - 1, number).round().astype(int)
    if not observed[some].mask.any(axis=(0, 1)).all():  # an output that few trajectories have
        some = np.arange(len(observed))
    # A linear step to the parameters without a part may lead where the equations diverge.
    usual = noisy(twin, indices, np.zeros(len(indices) + len(twin.noise)))
    finite = [
        np.isfinite(_predict(usual, observed, [part], move[None]).mean[part]).all()
        for part, move in zip(parts, moves, strict=True)
    ]
    kept = np.where(np.array(finite)[:, None], moves, 0.0)
    search = Search(twin, observed[some], indices, [part[some] for part in parts], kept)

    def scaled(logs: NDArray) -> DynamicsTwin:
        # A common scale changes no prediction, but all intervals.
        made = noisy(twin, indices, logs)
        error = np.abs(_predict(made, observed, parts, kept).standardised())
        scale = (np.nanquantile(error, LEVEL) / USUAL) ** 2
        return replace(
            made,
            process=scale * made.process,
            proportional=scale * made.proportional,
            free_process=scale * made.process,
            noise=np.maximum(scale * made.noise, SMALLEST**2 * twin.noise),
        )

    found = search.visit()
    made = scaled(found.best)
    if 0.5 ** len(parts) < CHANCE:  # fewer parts cannot show it
        more = search.visit(found.best)
        if more.decided(found):
            return replace(scaled(more.best), free_process=made.free_process)
    return made


def _predict(
    twin: DynamicsTwin, observed: Trajectories, parts: Sequence[NDArray], moves: NDArray
) -> Prediction:
    """One-step predictions of each part with the parameters that are estimated without it."""
    given = arrays_of(observed)
    measured = given[1]
    mean, covariance = (np.zeros((*measured.shape, *more)) for more in ((), measured.shape[2:]))
    for part, move in zip(parts, moves, strict=True):
        found = twin.filter(*given, moves=move)
        mean[part], covariance[part] = found[0][part], found[1][part]
    return Prediction(observed, mean, covariance, found[2])


def folds(seen: NDArray, count: int) -> list[NDArray]:
    """Parts (n, T) of the record: each trajectory is cut into `count` blocks of samples.

    A fold has one block of each trajectory, another one in each, so that it holds all phases of a
    record without holding out the start of all trajectories.
    """
    trajectories, samples, _ = seen.shape
    block = np.arange(samples) * count // samples
    own = (block + np.arange(trajectories)[:, None]) % count
    return [own == fold for fold in range(count)]


def edges(states: NDArray, commands: NDArray, count: int) -> list[NDArray]:
    """Parts (n, T) of the record that hold what is at one end of the range of a variable.

    Without such a part, what is learned has to be extrapolated to it. For each end of each state
    and command it is the share 1 / count of the blocks that reach furthest. A block is as long as
    the variable's distance from its mean is correlated.

    Parameters
    ----------
    states, commands : NDArray
        (n, T, d_x) and (n, T, d_u).
    count : int
        The number of parts of that size.

    """
    parts = []
    trajectories, samples = states.shape[:2]
    for variable in np.moveaxis(np.concatenate([states, commands], axis=2), 2, 0):
        distance = (variable - variable.mean()) ** 2
        length = correlation_time((distance - distance.mean())[..., None])
        blocks = int(np.clip(samples / length, 2, samples))
        first = np.arange(blocks) * samples // blocks
        block = np.searchsorted(first, np.arange(samples), side="right") - 1
        for reached in (
            np.maximum.reduceat(variable, first, axis=1),
            -np.minimum.reduceat(variable, first, axis=1),
        ):
            furthest = np.argsort(-reached, axis=None, kind="stable")
            own = np.isin(np.arange(reached.size), furthest[: max(1, reached.size // count)])
            parts.append(own.reshape(trajectories, blocks)[:, block])
    return parts


def widening(twin: DynamicsTwin, estimation: Estimation, held_out: HeldOut) -> NDArray:
    """Factors (d_y,) of deviations, with which the bands of each output hold the share they should.

    The share is that of held-out samples.
    """
    deviation = np.sqrt(held_out.variances + twin.simulation.noise_variance(estimation.commands))
    ratio, seen = np.abs(held_out.errors) / deviation, estimation.seen
    return np.array([needed_factor(ratio[..., i], seen[..., i]) for i in range(seen.shape[2])])


def needed_factor(ratio: NDArray, seen: NDArray) -> float:
    """Factor of deviations to which errors (n, T), in deviations, belong where they are seen.

    Bands become narrower only as far as errors show it beyond chance, which correlated ones do
    little: below 1 it is the upper limit of the factor, from as many independent samples as the
    hits of the band are worth.
    """
    factor = float(np.quantile(ratio[seen], LEVEL) / USUAL)
    if factor >= 1:
        return factor
    missed = ratio > factor * USUAL
    around = np.where(seen, missed - missed[seen].mean(), 0.0)
    number = seen.sum() / correlation_time(around[..., None])
    level = LEVEL + CERTAIN * np.sqrt(LEVEL * (1 - LEVEL) / number)
    return float(min(np.quantile(ratio[seen], min(level, 1.0)) / USUAL, 1.0))
