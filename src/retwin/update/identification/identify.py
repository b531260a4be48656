"""`identify`: a twin's own parameters from measured outputs, by Eq. 2 or Eq. 3."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import overload

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from retwin.checks import given, require
from retwin.data.measured import measured_only, unmeasured
from retwin.data.quality.copies import distinct_records
from retwin.data.quality.sensors import limits_of
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.sensor_limits import describe_limits, limit_outputs
from retwin.update.dynamics.windows import state_based
from retwin.update.identification.bayes import infer_posterior
from retwin.update.identification.horizon import (
    Candidate,
    HeldOut,
    choose_length,
    lasting,
    lengths_of,
    overfitted,
)
from retwin.update.identification.identifiability import (
    CHI2_95,
    MIN_TRAJECTORIES,
    NEGLIGIBLE,
    RANK_TOLERANCE,
    Identifiability,
    identifiability,
    noise_of,
    standard_errors,
)
from retwin.update.identification.mcmc import MCMC
from retwin.update.identification.misfit import Misfit, misfit_of
from retwin.update.identification.npe import NPE
from retwin.update.identification.posterior import Posterior
from retwin.update.identification.search import (
    AT_BOUND,
    Evolution,
    LeastSquares,
    Loss,
    Optimum,
    Search,
)
from retwin.update.score_covariance import variance_of


@dataclass(frozen=True, eq=False)
class Updated:
    """A twin with identified parameters.

    Attributes
    ----------
    twin : ParametricTwin
        The updated twin.
    values, errors : dict of str to float
        θ̂ and its standard errors by name. They allow for residuals that are correlated in any way
        within a trajectory, and for a robust loss, but not for a twin that cannot fit the data.
        NaN below three trajectories, from which they cannot be given; `reason` then has a note.
    intervals : dict of str to tuple of float
        95 % intervals from the standard errors and Student's t distribution, with one degree of
        freedom less than trajectories.
    objective : float
        ‖y_obs − f(θ̂, u)‖ of Eq. 2 over all measurements.
    starts : tuple of Optimum
        The optima of all starts, best first.
    identifiability : Identifiability
        What the outputs determine.
    twin_runs : int
        Trajectories simulated.
    seconds : float
        Duration of the identification.
    figures : dict of str to float
        `rms_before` and `rms_after` in output units (relative to each output's standard deviation
        where units differ), `measurements`, `independent`, the effective sample size,
        `copies`, the trajectories that repeat another one, and `starts_agreeing`.
    reason : str
        Why the search ended, and the warnings.
    loss : str
        The loss that was minimised.
    scale : float
        The residual beyond which a robust loss grows slower.
    horizon : float
        Length in s of the windows into which records were cut, whose starts were estimated;
        infinite for whole records.
    horizons : tuple of Candidate
        What was compared for it, the chosen one first; empty where there was no choice.
    lasting : bool
        Whether effects of a start or of early commands last until the end of the record.
    own_starts : dict of str to float
        Parameters that are starts of states of which each record has its own: by name, the standard
        deviation between the records, of which the mean is in `values`. `errors`, `intervals` and
        `identifiability` are those of the other parameters.

    """

    twin: ParametricTwin
    values: dict[str, float]
    errors: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    objective: float
    starts: tuple[Optimum, ...]
    identifiability: Identifiability
    twin_runs: int
    seconds: float
    figures: dict[str, float]
    reason: str
    loss: Loss
    scale: float
    horizon: float = np.inf
    horizons: tuple[Candidate, ...] = ()
    lasting: bool = False
    own_starts: dict[str, float] = field(default_factory=dict)


@overload
def identify(
    twin: ParametricTwin,
    observed: Trajectories,
    method: LeastSquares | Evolution = ...,
    *,
    seed: int,
    rate: float | None = ...,
    processes: int = ...,
    horizon: float | None = ...,
    progress: Progress | None = ...,
) -> Updated: ...


@overload
def identify(
    twin: ParametricTwin,
    observed: Trajectories,
    method: MCMC | NPE,
    *,
    seed: int,
    rate: float | None = ...,
    processes: int = ...,
    progress: Progress | None = ...,
) -> Posterior: ...


def identify(
    twin: ParametricTwin,
    observed: Trajectories,
    method: LeastSquares | Evolution | MCMC | NPE = LeastSquares(),  # noqa: B008 - a frozen config
    *,
    seed: int,
    rate: float | None = None,
    processes: int = 1,
    horizon: float | None = None,
    progress: Progress | None = None,
) -> Updated | Posterior:
    """Estimate a twin's own parameters from measured outputs.

    `LeastSquares` and `Evolution` find the parameters that fit best, θ̂ = argmin ‖y_obs − f(θ, u)‖
    (Eq. 2). `MCMC` and `NPE` draw from the posterior p(θ | y_obs, u) (Eq. 3).

    Parameters
    ----------
    twin : ParametricTwin
        Declares the free parameters, their bounds, and the first start. The prior of Eq. 3 is
        uniform within the bounds.
    observed : Trajectories
        Healthy calibration trajectories with commands; masked samples are not used. Where an
        output stays at exactly its lowest or highest value, that is taken for a limit of its
        sensor, which a simulated value may exceed.
    method : LeastSquares, Evolution, MCMC or NPE
        Local searches from several starts, a global search, Markov chains for fast twins such as
        surrogates, or a network that needs few simulations. The loss of the searches is robust by
        default; loss="linear" is the norm of Eq. 2.
    seed : int
        Seed of starts, draws and simulations; the same seed gives the same result on the same
        machine.
    rate : float, optional
        Sample rate of the residuals in Hz, a whole part of the data's, which is the default. The
        sensor's true rate is best: interpolated samples hold no information, and without a
        discrepancy the posterior is too narrow if they count.
    processes : int
        Worker processes over which values of the parameters are distributed; 1 for twins that use
        all cores.
    horizon : float, optional
        Time in s over which the twin is simulated from starts that are estimated, for a search and
        a twin with states; infinite for whole records. By default it is chosen where effects of the
        start last until the end of the record, as in slow, integrating and unstable plants.
    progress : callable, optional
        Called with the share of the work that is done.

    Returns
    -------
    Updated or Posterior
        The best fit with standard errors, or draws from the posterior; `twin` of either is the
        updated twin.

    Raises
    ------
    InputError
        An unknown method, a twin without declared parameters, no healthy trajectory, channels or a
        rate that differ from the twin's, not more measurements than parameters, too few walkers,
        or a package of the extra `bayes` that is missing.

    Warns
    -----
    UserWarning
        Readings stop at a limit. Parameters are not identified, or their best value lies on a
        bound (Eq. 2); chains are short, or the data lie outside the prior predictive distribution
        (Eq. 3).

    """
    known = isinstance(method, LeastSquares | Evolution | MCMC | NPE)
    expected = "LeastSquares(), Evolution(), MCMC() or NPE()"
    remedy = "give the settings of one of these methods"
    require(known, "method", expected=expected, got=repr(method), remedy=remedy)
    began, missing = time.perf_counter(), ""
    if isinstance(method, LeastSquares | Evolution) and isinstance(observed, Trajectories):
        missing = unmeasured(observed)
        observed = measured_only(observed) if missing else observed
    found: Updated | Posterior
    limits, read = np.array([]), twin
    if isinstance(twin, ParametricTwin) and isinstance(observed, Trajectories):
        limits = limits_of(observed)
        read = limit_outputs(twin, limits)
    begin = partial(misfit_of, seed=seed, rate=rate, processes=processes)
    if isinstance(method, MCMC | NPE):
        with begin(read, observed) as misfit:
            found = infer_posterior(misfit, method, progress)
    else:
        several = isinstance(observed, Trajectories) and len(observed) > 1
        how = (partial(begin, own=several), missing, progress)
        found = _search(read, observed, method, horizon, how)
        copies = int(found.figures["copies"])
        again = f"{copies} of {len(observed)} trajectories are copies and count once"
        for note in filter(None, [found.identifiability.warning, missing, again * bool(copies)]):
            warnings.warn(note, stacklevel=2)
    if read is not twin:
        found = _without_limits(found, twin)
        warnings.warn(describe_limits(observed.outputs.names, limits), stacklevel=2)
    return replace(found, seconds=time.perf_counter() - began)


def _without_limits(found: Updated | Posterior, twin: ParametricTwin) -> Updated | Posterior:
    """What was found for readings of a twin, for the twin itself."""
    if isinstance(found, Updated):
        return replace(found, twin=replace(found.twin, twin=twin.twin))
    own = replace(found.twin.twin, twin=twin.twin)
    return replace(found, twin=replace(found.twin, twin=own))


def _search(
    twin: ParametricTwin,
    observed: Trajectories,
    method: LeastSquares | Evolution,
    horizon: float | None,
    how: tuple[Callable[..., AbstractContextManager[Misfit]], str, Progress | None],
) -> Updated:
    """The parameters that fit best over a horizon that is given or chosen."""
    (begin, missing, progress), found = how, None
    length, candidates = _samples_of(horizon, twin, observed), []
    if length is None:
        choice = horizon is None and state_based(twin)
        try:
            with begin(twin, observed) as misfit:
                found, stride = _fit(misfit, method, missing, progress), misfit.stride
                best = np.array([found.starts[0].values])
                residual = misfit.residuals(best)[0] * misfit.unit
        except InputError:
            usable = isinstance(observed, Trajectories)
            if not (choice and usable and lasting(twin, observed)):
                raise
            stride = 1

        def fit(part: Trajectories, windows: int | None) -> ParametricTwin:
            own = twin if windows or found is None else found.twin
            with begin(own, part, length=windows) as misfit:
                return _fit(misfit, LeastSquares(1, method.loss), "", None).twin

        held, whole = HeldOut(observed, fit, stride), None
        if found is not None:
            lasts = lasting(found.twin, observed)
            found = replace(found, lasting=lasts)
            if not choice or not lengths_of(observed):
                return found
            whole = held.fit_without(None)
            if not (lasts or overfitted(held, residual, whole)):
                return found

        candidates = choose_length(held, whole)
        length = candidates[0].length if candidates else None
        if length is None:
            expected = "records of 200 samples or more, for a twin that cannot simulate them"
            remedy = "choose other starts of the parameters, or give longer records"
            got = f"{observed.steps} samples"
            found = given("observed", found, expected, got=got, remedy=remedy)
            return replace(found, horizons=tuple(candidates))
    with begin(twin, observed, length=length) as misfit:
        again = _fit(misfit, method, missing, progress)
    lasts = found.lasting if found is not None else lasting(again.twin, observed)
    return replace(again, horizon=length / observed.rate, horizons=tuple(candidates), lasting=lasts)


def _samples_of(horizon: float | None, twin: ParametricTwin, observed: Trajectories) -> int | None:
    """The samples of a horizon that is given; None for one to be chosen, or for whole records."""
    if horizon is None or horizon == np.inf:
        return None
    expected = "none for a twin without states"
    got = f"{horizon:g} s for a {type(twin).__name__}"
    remedy = "starts of windows can only be estimated where the equations of the states are "
    remedy += "known: write them as a StateTwin, or leave the horizon out"
    require(state_based(twin), "horizon", expected=expected, got=got, remedy=remedy)
    longest = observed.steps / observed.rate
    inside = 2 / observed.rate <= horizon <= longest
    expected = f"a time from {2 / observed.rate:g} to {longest:g} s, the longest record"
    got = f"{horizon:g} s"
    require(inside, "horizon", expected=expected, got=got, remedy="leave it out to have it chosen")
    return round(horizon * observed.rate)


def _fit(
    misfit: Misfit, method: LeastSquares | Evolution, missing: str, progress: Progress | None
) -> Updated:
    """The parameters that fit best; `missing` describes outputs that were never measured."""
    twin, search = misfit.twin, Search(misfit, method, progress)
    optima = search.run(np.random.default_rng(misfit.seed))
    best, point = optima[0] = _hold_insensitive(search, *optima[0])
    residual = misfit.residuals(np.array([best.values]))[0]
    once = distinct_records(np.where(misfit.seen, misfit.measured, np.nan))
    values = np.array(best.values)
    starts = {} if misfit.windows is None else misfit.windows.own_starts(values)
    for number, each in starts.items():
        values[number] = each.mean()
    if len(starts) == len(values):  # nothing else is to be identified
        starts = {}
    shared = np.array([number not in starts for number in range(len(values))])
    found, errors, agreeing = _identifiability(search, optima, point, residual, once, shared)
    best = replace(best, values=tuple(values.tolist()))
    optima[0] = best, point
    count = len(once)
    half = stats.t.ppf(0.975, max(count - 1, 1)) * errors
    names, known = np.array(twin.names)[shared].tolist(), values[shared]
    unknown = ""
    if np.isnan(errors).any():
        alone = "" if count < MIN_TRAJECTORIES else ", of which one alone determines a parameter"
        unknown = f"no standard errors can be given from {count} trajectories{alone}"
    return Updated(
        twin=twin.with_values(best.values),
        values=dict(zip(twin.names, best.values, strict=True)),
        errors=dict(zip(names, errors.tolist(), strict=True)),
        intervals=dict(zip(names, zip(known - half, known + half, strict=True), strict=True)),
        objective=float(np.sqrt(np.sum(residual**2))),
        starts=tuple(each for each, _ in optima),
        identifiability=found,
        twin_runs=misfit.twin_runs,
        seconds=0.0,
        figures={
            "rms_before": misfit.rms,
            "rms_after": misfit.rms_of(residual),
            "measurements": float(misfit.seen.sum()),
            "independent": found.independent,
            "copies": float(len(residual) - len(once)),
            "starts_agreeing": float(agreeing),
        },
        reason="; ".join(filter(None, [best.reason, found.warning, missing, unknown])),
        loss=search.loss,
        scale=search.scale,
        own_starts={twin.names[number]: float(each.std()) for number, each in starts.items()},
    )


def _hold_insensitive(search: Search, best: Optimum, point: NDArray) -> tuple[Optimum, NDArray]:
    """An optimum at which parameters that hardly change the outputs have their present values.

    Starts draw all parameters. Hardly is, to first order and from one bound to the other, by less
    in all samples together than the standard deviation of one residual, and than a hundredth of
    what another parameter changes: a twin may be far too small for what was measured.
    """
    misfit = search.misfit
    residual = misfit.residuals(np.array([best.values]))[0]
    noise = variance_of(residual, int(misfit.seen.sum()), len(point))
    change = np.square(search.jacobian(point)).sum(axis=0)
    largest = change.max(initial=0.0)
    insensitive = change <= max(min(noise, NEGLIGIBLE**2 * largest), RANK_TOLERANCE**2 * largest)
    present = np.array(misfit.twin.values)
    held = np.where(insensitive, (present - misfit.low) / search.width, point)
    values = np.where(insensitive, present, best.values)
    more = np.sum(misfit.residuals(values[None]) ** 2) - np.sum(residual**2)
    if not insensitive.any() or not more <= noise:
        return best, point
    return replace(best, values=tuple(values.tolist())), held


def _identifiability(
    search: Search,
    optima: list[tuple[Optimum, NDArray]],
    best: NDArray,
    residual: NDArray,
    once: NDArray,
    shared: NDArray,
) -> tuple[Identifiability, NDArray, int]:
    """The identifiability at the best optimum, its standard errors, and how many starts agree.

    It is that of the `shared` parameters (k,), which do not differ between trajectories. Those that
    are not among `once` are copies, and no information.
    """
    misfit = search.misfit
    # Outliers have as little weight in the standard errors as they had in the optimum.
    _, gradient, curvature = search.linearised(residual)
    jacobian = search.jacobian(best).reshape(*residual.shape, -1)[..., shared]
    width, best = (misfit.high - misfit.low)[shared], best[shared]
    # As least squares: near the optimum, losses are squares of residuals that have these weights.
    weight = np.sqrt(curvature)[once]
    errors = width * standard_errors(jacobian[once] * weight[..., None], gradient[once] / weight)
    # Where noise is to be the same in all samples of an output, their weights must be so.
    weight = np.sqrt(search.average_curvature(curvature))
    jacobian, residual = jacobian * weight[..., None], gradient / weight
    jacobian, residual, seen = jacobian[once], residual[once], misfit.seen[once]
    # As well as the best: within the 95 % range of the objective under noise (chi-square).
    measured, lowest = int(seen.sum()), optima[0][0].objective ** 2
    margin = CHI2_95 * noise_of(residual, measured, len(best)) + 1e-6 * lowest
    alternatives = [p[shared] for each, p in optima if each.objective**2 <= lowest + margin]
    found = identifiability(
        tuple(np.array(misfit.twin.names)[shared].tolist()),
        jacobian,
        residual,
        measured=measured,
        width=width,
        at_bound=(best <= AT_BOUND) | (best >= 1 - AT_BOUND),
        alternatives=np.array(alternatives) - best,
    )
    return found, errors, len(alternatives)
