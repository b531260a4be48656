"""Markov chain Monte Carlo on the posterior (emcee's ensemble sampler)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from retwin.checks import needs_extra, whole
from retwin.progress import Progress, tracked
from retwin.update.identification.problem import BoxProblem, Noise
from retwin.update.identification.search import LeastSquares, Search

INITIAL_DEVIATION = 0.02
"""Standard deviation of the walkers' initial points about the best fit, in widths of the bounds."""


@dataclass(frozen=True)
class MCMC:
    """Markov chain Monte Carlo by an ensemble of walkers, for fast twins and surrogates.

    The walkers start about the least-squares fit. All of a step's proposals are simulated in one
    batch.

    Parameters
    ----------
    walkers : int
        Walkers, at least twice as many as parameters and scales together.
    steps, warm_up : int
        Steps per walker that are kept, and those before them that are discarded.
    starts : int
        Starts of the least squares.
    noise : Noise
        Distribution of the output error, whose scales are inferred too.

    Raises
    ------
    InputError
        A count below 1.

    """

    walkers: int = 32
    steps: int = 600
    warm_up: int = 300
    starts: int = 3
    noise: Noise = field(default_factory=Noise)

    def __post_init__(self) -> None:
        for name in ("walkers", "steps", "warm_up", "starts"):
            whole(name, getattr(self, name), at_least=1)

    def sample(
        self, problem: BoxProblem, *, seed: int, progress: Progress | None
    ) -> tuple[NDArray, dict[str, float], str]:
        """Points (s, k + q), figures, and a warning, or "" where there is none."""
        emcee = needs_extra("emcee", "bayes", "samples posteriors")
        remedy = "give twice as many as parameters and scales, or free fewer parameters"
        whole("walkers", self.walkers, at_least=2 * problem.size, remedy=remedy)
        rng = np.random.default_rng(seed)
        sampler = emcee.EnsembleSampler(
            self.walkers,
            problem.size,
            problem.log_posterior,
            moves=[(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)],
            vectorize=True,
        )
        begin = emcee.State(self._begin(problem, rng))
        # Its own generator, not numpy's global one: the chain is a function of the seed.
        begin.random_state = np.random.RandomState(rng.integers(2**31)).get_state()
        total = self.warm_up + self.steps
        for _ in tracked(sampler.sample(begin, iterations=total), total, progress):
            pass
        chain = sampler.get_chain(discard=self.warm_up)
        # A short chain underestimates its autocorrelation time, so the minimum is conservative.
        slowest = float(np.max(emcee.autocorr.integrated_time(chain, tol=0)))
        independent = self.walkers * self.steps / max(slowest, 1.0)
        figures = {
            "acceptance": float(np.mean(sampler.acceptance_fraction)),
            "autocorrelation": slowest,
            "independent": independent,
        }
        short = f"short chains: the effective sample size is {independent:.0f}"
        # Effective sample size below which the chains count as short.
        warning = "" if independent >= 200.0 else short
        return chain.reshape(-1, problem.size), figures, warning

    def _begin(self, problem: BoxProblem, rng: np.random.Generator) -> NDArray:
        """Initial points (walkers, k + q) about the best fit."""
        search = Search(problem.misfit, LeastSquares(self.starts, loss="soft_l1"), None)
        _, best = search.run(rng)[0]
        rms = problem.misfit.rms_of(np.nan_to_num(search.residuals(best[None])[0]))
        scales = problem.low[problem.parameters :].copy()
        scales[:2] = np.log(max(rms, 1e-300))
        scales[2:] += problem.width[-1] / 2
        begin = (scales - problem.low[problem.parameters :]) / problem.width[problem.parameters :]
        middle = np.concatenate([best, begin]).clip(
            2 * INITIAL_DEVIATION, 1 - 2 * INITIAL_DEVIATION
        )
        points = middle + INITIAL_DEVIATION * rng.normal(size=(self.walkers, problem.size))
        return points.clip(1e-3, 1 - 1e-3)
