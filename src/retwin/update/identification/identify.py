"""Deterministic parameter identification (Eq. 2): the rival that finds the best parameters."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.parametric import ParametricTwin
from retwin.update.identification.identifiability import (
    PLAUSIBLE,
    Identifiability,
    identifiability,
    noise_of,
)
from retwin.update.identification.misfit import misfit_of
from retwin.update.identification.search import EDGE, Evolution, LeastSquares, Loss, Optimum, Search

__all__ = ["Updated", "identify"]


@dataclass(frozen=True, eq=False)
class Updated:
    """A twin with identified parameters.

    Attributes
    ----------
    twin: the updated twin; a `Twin`.
    values, errors: θ̂ and its standard errors by name. Errors allow for neighbouring residuals being
        alike, and for what a robust loss left out; they do not know of a twin that cannot fit.
    objective: ‖y_obs − f(θ̂, u)‖ of Eq. 2 over all measurements.
    starts: all starts' optima, best first.
    identifiability: what the outputs leave open.
    twin_runs: trajectories simulated.
    seconds: that it took.
    figures: `rms_before` and `rms_after` in output units (relative to each output's standard
        deviation where units differ), `measurements`, `independent`, `starts_agreeing`.
    reason: why the search ended, and what is in doubt.
    loss, scale: under which it was searched, and the residual beyond which a robust one forgives.

    """

    twin: ParametricTwin
    values: dict[str, float]
    errors: dict[str, float]
    objective: float
    starts: tuple[Optimum, ...]
    identifiability: Identifiability
    twin_runs: int
    seconds: float
    figures: dict[str, float]
    reason: str
    loss: Loss
    scale: float


def identify(
    twin: ParametricTwin,
    observed: Trajectories,
    *,
    seed: int,
    method: LeastSquares | Evolution = LeastSquares(),  # noqa: B008 - a frozen config
    rate: float | None = None,
    processes: int = 1,
    progress: Progress | None = None,
) -> Updated:
    """The parameters that fit measured outputs best, θ̂ = argmin ‖y_obs − f(θ, u)‖ (Eq. 2).

    Parameters
    ----------
    twin: says which parameters are free, within which bounds, and where the search starts.
    observed: healthy calibration trajectories with commands; what is masked does not count.
    seed: of the starts; the same seed gives the same result.
    method: `LeastSquares` from several starts, or `Evolution`, a global search; with loss="linear"
        the plain norm of Eq. 2, by default a robust one.
    rate: samples per second to look at, a whole part of the data's; by default all. The sensor's
        true rate serves best: samples in between say nothing new.
    processes: that values of the parameters are spread over. 1 for twins that use all cores.

    Warns where a parameter is not identified, or its best value lies on a bound.

    Raises
    ------
    InputError: a twin without declared parameters, no healthy trajectory, channels or a rate that
        are not the twin's, no more measurements than parameters.

    """
    began = time.perf_counter()
    with misfit_of(twin, observed, seed=seed, rate=rate, processes=processes) as misfit:
        search = Search(misfit, method, progress)
        before = misfit.rms
        optima = search.run(np.random.default_rng(seed))
        best, point = optima[0]
        residual = misfit.residuals(np.array([best.values]))[0]
        picture, agreeing = _picture(search, optima, point, residual)
    if picture.doubts:
        warnings.warn(picture.doubts, stacklevel=2)
    independent, measurements = picture.independent, float(misfit.seen.sum())
    return Updated(
        twin=twin.with_values(best.values),
        values=dict(zip(twin.names, best.values, strict=True)),
        errors=dict(zip(twin.names, picture.errors.tolist(), strict=True)),
        objective=float(np.sqrt(np.sum(residual**2))),
        starts=tuple(each for each, _ in optima),
        identifiability=picture,
        twin_runs=misfit.twin_runs,
        seconds=time.perf_counter() - began,
        figures={
            "rms_before": before,
            "rms_after": misfit.rms_of(residual),
            "measurements": measurements,
            "independent": independent,
            "starts_agreeing": float(agreeing),
        },
        reason="; ".join(filter(None, [best.reason, picture.doubts])),
        loss=search.loss,
        scale=search.scale,
    )


def _picture(
    search: Search, optima: list[tuple[Optimum, NDArray]], best: NDArray, residual: NDArray
) -> tuple[Identifiability, int]:
    """What is identified, and how many starts fit as well as the best one."""
    misfit = search.misfit
    # An outlier tells as little of the errors as it told of the optimum.
    _, residual, rise = search.judged(residual)
    # As well as the best one: within what noise alone does to the objective (95 % of chi-square).
    measured, lowest = int(misfit.seen.sum()), optima[0][0].objective ** 2
    margin = PLAUSIBLE * rise * noise_of(residual, measured, len(best)) + 1e-6 * lowest
    rivals = [point for each, point in optima if each.objective**2 <= lowest + margin]
    picture = identifiability(
        misfit.twin.names,
        search.jacobian(best).reshape(*residual.shape, -1),
        residual,
        measured=measured,
        width=misfit.high - misfit.low,
        at_bound=(best <= EDGE) | (best >= 1 - EDGE),
        rivals=np.array(rivals) - best,
    )
    return picture, len(rivals)
