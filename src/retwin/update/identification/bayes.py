"""Bayesian identification (Eq. 3): the posterior of a twin's parameters, and its calibration."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.identification.mcmc import MCMC
from retwin.update.identification.misfit import Misfit, misfit_of
from retwin.update.identification.npe import NPE
from retwin.update.identification.posterior import Posterior, PosteriorTwin
from retwin.update.identification.problem import BoxProblem, Summaries, outlyingness

SIGNIFICANCE = 0.02
"""Prior predictive p-value of the measured data below which the twin counts as misspecified."""


def infer_posterior(misfit: Misfit, method: MCMC | NPE, progress: Progress | None) -> Posterior:
    """The posterior of a twin's parameters given measured outputs, p(θ | y_obs, u) (Eq. 3).

    A warning is given where the data lie outside the prior predictive distribution of the twin with
    noise, and where chains are short.
    """
    seeds = np.random.SeedSequence(misfit.seed).generate_state(4).tolist()
    for_method, for_check, for_kept, for_prior = seeds
    problem = BoxProblem(misfit, method.noise, for_prior)
    points, figures, warning = method.sample(problem, seed=for_method, progress=progress)
    p_value = _prior_predictive(problem, np.random.default_rng(for_check))
    # Largest number of draws of the posterior that are kept.
    order = np.random.default_rng(for_kept).permutation(len(points))[:4000]
    samples, logs = problem.physical(points[order])
    twin, mean = misfit.twin, samples.mean(axis=0)
    figures["rms_after"] = misfit.rms_of(misfit.residuals(mean[None]))
    figures["rms_before"] = misfit.rms
    found = [warning] if warning else []
    if p_value < SIGNIFICANCE:
        found.append(
            f"misspecified: the data lie farther out than {1 - p_value:.1%} of simulations with "
            "parameters and noise from the prior"
        )
    if found:
        warnings.warn("; ".join(found), stacklevel=3)
    updated = PosteriorTwin(
        twin.with_values(mean),
        method.noise,
        samples,
        logs,
        misfit.unit,
        misfit.stride,
        misfit.observed.emulated,
    )
    return Posterior(
        twin=updated,
        names=twin.names,
        samples=samples,
        scales=dict(zip(method.noise.names, np.exp(logs).T, strict=True)),
        misspecified=p_value,
        twin_runs=misfit.twin_runs,
        seconds=0.0,
        figures=figures,
        reason="; ".join([f"{type(method).__name__} drew {len(points)} samples", *found]),
    )


def _prior_predictive(problem: BoxProblem, rng: np.random.Generator) -> float:
    """The prior predictive p-value of the measured data."""
    points, paths = problem.prior
    seen = problem.misfit.seen
    summaries = Summaries.of(paths)
    _, simulated = problem.with_noise(points, paths, problem.box, summaries, rng)
    flat = simulated.reshape(-1, simulated.shape[-1])
    return outlyingness(summaries(problem.measured, seen)[0], flat)


def calibration_ranks(
    twin: ParametricTwin,
    commands: NDArray,
    method: MCMC | NPE,
    *,
    count: int,
    seed: int,
    rate: float | None = None,
) -> NDArray:
    """Simulation-based calibration (Talts et al. 2018): ranks (count, k) from 0 to 1.

    Parameters, scales and data are drawn from the prior `count` times, and identified as measured
    data are. The rank is the share of the posterior below the true value; for a correct method
    ranks are uniform. They concentrate at 0.5 for a posterior that is too wide, at 0 and 1 for one
    that is too narrow.

    Parameters
    ----------
    twin, method, rate
        As in `identify`.
    commands : NDArray
        (n, T, d_u), commands of each data set.
    count : int
        Number of data sets.
    seed : int
        The same seed gives the same ranks on the same machine.

    Returns
    -------
    NDArray
        (count, k).

    References
    ----------
    Talts et al., "Validating Bayesian inference algorithms with simulation-based calibration",
    2018.

    """
    blank = twin.simulate(commands, seed=0)
    with misfit_of(twin, blank, seed=0, rate=rate, processes=1) as misfit:
        problem = BoxProblem(misfit, method.noise, 0)
    ranks = np.empty((count, len(twin.names)))
    for i, sequence in enumerate(np.random.SeedSequence(seed).spawn(count)):
        rng = np.random.default_rng(sequence)
        theta, logs = problem.physical(rng.random((1, problem.size)))
        truth = PosteriorTwin(twin, method.noise, theta, logs, misfit.unit, misfit.stride)
        made = truth.simulate(commands, seed=int(rng.integers(2**31)))
        data = made.replace(nominal=blank.nominal)
        drawn = _posterior(twin, data, method, problem, int(rng.integers(2**31)), rate)
        ranks[i] = np.mean(drawn < theta[0], axis=0)
    return ranks


def _posterior(
    twin: ParametricTwin,
    data: Trajectories,
    method: MCMC | NPE,
    problem: BoxProblem,
    seed: int,
    rate: float | None,
) -> NDArray:
    """Draws (s, k) of the parameters."""
    with misfit_of(twin, data, seed=0, rate=rate, processes=1) as misfit:
        own = BoxProblem(misfit, problem.noise, seed)
        points, _, _ = method.sample(own, seed=seed, progress=None)
    return own.physical(points)[0]
