"""Bayesian updating (Eq. 3): the rival that finds all plausible parameters."""

from __future__ import annotations

import time
import warnings

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.parametric import ParametricTwin
from retwin.update.identification.mcmc import MCMC
from retwin.update.identification.misfit import misfit_of
from retwin.update.identification.noise import Noise
from retwin.update.identification.npe import NPE
from retwin.update.identification.posterior import Posterior, PosteriorTwin
from retwin.update.identification.problem import Problem
from retwin.update.identification.summaries import Summaries, outlyingness

__all__ = ["calibration_ranks", "identify_bayes"]

KEPT = 4000
"""Draws of the posterior that are kept at most."""
OUTSIDE = 0.02
"""Share of prior predictive data below which the measured ones count as outside."""


def identify_bayes(
    twin: ParametricTwin,
    observed: Trajectories,
    *,
    seed: int,
    method: MCMC | NPE = MCMC(),  # noqa: B008 - a frozen config
    noise: Noise = Noise(),  # noqa: B008 - a frozen config
    rate: float | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """The posterior of a twin's parameters given measured outputs, p(θ | y_obs, u) (Eq. 3).

    Parameters
    ----------
    twin: says which parameters are free; the prior is uniform within their bounds.
    observed: healthy calibration trajectories with commands; what is masked does not count.
    seed: the same seed gives the same result on the same machine.
    method: `MCMC` for twins that are fast, as surrogates are; `NPE` counts its simulations.
    noise: law of the output error, whose scales are inferred too.
    rate: samples per second to look at, a whole part of the data's; by default all. The sensor's
        true rate: with a discrepancy all samples of it count, without one it is wrong to count
        samples that the sensor has only joined up.

    Warns where the data lie outside what the twin can produce with any parameters and such noise,
    and where chains are short.

    Raises
    ------
    InputError: as `identify`; too few walkers; a package of the extra `bayes` is missing.

    """
    began = time.perf_counter()
    with misfit_of(twin, observed, seed=seed, rate=rate, processes=1) as misfit:
        seeds = np.random.SeedSequence(seed).generate_state(4).tolist()
        for_method, for_check, for_kept, for_prior = seeds
        problem = Problem(misfit, noise, for_prior)
        points, figures, doubt = method.sample(problem, seed=for_method, progress=progress)
        outside = _outside(problem, np.random.default_rng(for_check))
        order = np.random.default_rng(for_kept).permutation(len(points))[:KEPT]
        samples, logs = problem.physical(points[order])
        mean = samples.mean(axis=0)
        figures["rms_after"] = misfit.rms_of(misfit.residuals(mean[None]))
        figures["rms_before"] = misfit.rms
    doubts = [doubt] if doubt else []
    if outside < OUTSIDE:
        doubts.append(
            f"misspecified: the data lie farther out than {1 - outside:.1%} of what the twin and "
            "its noise can produce"
        )
    if doubts:
        warnings.warn("; ".join(doubts), stacklevel=2)
    updated = PosteriorTwin(
        twin.with_values(mean), noise, samples, logs, misfit.unit, misfit.stride, observed.emulated
    )
    return Posterior(
        twin=updated,
        names=twin.names,
        samples=samples,
        scales=dict(zip(noise.names, np.exp(logs).T, strict=True)),
        misspecified=outside,
        twin_runs=misfit.twin_runs,
        seconds=time.perf_counter() - began,
        figures=figures,
        reason="; ".join([f"{type(method).__name__} drew {len(points)} samples", *doubts]),
    )


def _outside(problem: Problem, rng: np.random.Generator) -> float:
    """Share of prior predictive data that lie as far out as the measured ones."""
    points, paths = problem.prior
    seen = problem.misfit.seen
    summaries = Summaries.of(paths)
    _, simulated = problem.seen_noisily(points, paths, problem.box, summaries, rng)
    flat = simulated.reshape(-1, simulated.shape[-1])
    return outlyingness(summaries(problem.measured, seen)[0], flat)


def calibration_ranks(
    twin: ParametricTwin,
    commands: NDArray,
    method: MCMC | NPE,
    *,
    count: int,
    seed: int,
    noise: Noise = Noise(),  # noqa: B008 - a frozen config
    rate: float | None = None,
) -> NDArray:
    """Simulation-based calibration (Talts et al. 2018): ranks (count, k) from 0 to 1.

    Parameters, scales and data are drawn from the prior `count` times, and updated as measured data
    are. The rank is the share of the posterior below the true value; if the method is right, ranks
    are uniform. A hump in the middle tells of a posterior that is too wide, horns of one that is
    too narrow.
    """
    blank = twin.simulate(commands, seed=0)
    with misfit_of(twin, blank, seed=0, rate=rate, processes=1) as misfit:
        problem = Problem(misfit, noise, 0)
    ranks = np.empty((count, len(twin.names)))
    for i, sequence in enumerate(np.random.SeedSequence(seed).spawn(count)):
        rng = np.random.default_rng(sequence)
        theta, logs = problem.physical(rng.random((1, problem.size)))
        true = PosteriorTwin(twin, noise, theta, logs, misfit.unit, misfit.stride)
        made = true.simulate(commands, seed=int(rng.integers(2**31)))
        data = made.replace(nominal=blank.nominal)
        drawn = _posterior(twin, data, method, problem, int(rng.integers(2**31)), rate)
        ranks[i] = np.mean(drawn < theta[0], axis=0)
    return ranks


def _posterior(
    twin: ParametricTwin,
    data: Trajectories,
    method: MCMC | NPE,
    problem: Problem,
    seed: int,
    rate: float | None,
) -> NDArray:
    """Draws (s, k) of the parameters."""
    with misfit_of(twin, data, seed=0, rate=rate, processes=1) as misfit:
        own = Problem(misfit, problem.noise, seed)
        points, _, _ = method.sample(own, seed=seed, progress=None)
    return own.physical(points)[0]
