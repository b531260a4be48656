"""Markov chains on the posterior (emcee's ensemble sampler)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.progress import Progress
from retwin.update.identification.misfit import check_counts
from retwin.update.identification.problem import Problem
from retwin.update.identification.search import LeastSquares, Search

__all__ = ["MCMC"]

BALL = 0.02
"""Standard deviation of the walkers' begin about the best fit, in widths of the bounds."""
ENOUGH = 200.0
"""Independent samples below which the chains count as short."""


@dataclass(frozen=True)
class MCMC:
    """Markov chain Monte Carlo by an ensemble of walkers; for fast twins and surrogates.

    Starts about the best fit of least squares. All walkers' next steps are simulated in one batch.

    Parameters
    ----------
    walkers: at least twice as many as parameters and scales together.
    steps: per walker, after `warm_up` others that are thrown away.
    starts: of the least squares that it starts from.

    """

    walkers: int = 32
    steps: int = 600
    warm_up: int = 300
    starts: int = 3

    def __post_init__(self) -> None:
        check_counts(
            walkers=self.walkers, steps=self.steps, warm_up=self.warm_up, starts=self.starts
        )

    def sample(
        self, problem: Problem, *, seed: int, progress: Progress | None
    ) -> tuple[NDArray, dict[str, float], str]:
        """Points (s, k + q), figures, and in words how it went."""
        emcee = _emcee()
        if self.walkers < 2 * problem.size:
            raise InputError(
                "walkers",
                expected=f"at least {2 * problem.size}, twice the parameters and scales",
                got=repr(self.walkers),
                remedy="give more walkers, or free fewer parameters",
            )
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
        for done, _ in enumerate(sampler.sample(begin, iterations=total), 1):
            if progress is not None:
                progress(done / total)
        chain = sampler.get_chain(discard=self.warm_up)
        # A chain that is short for it gives too short a time: `ENOUGH` is on the safe side.
        slowest = float(np.max(emcee.autocorr.integrated_time(chain, tol=0)))
        independent = self.walkers * self.steps / max(slowest, 1.0)
        figures = {
            "acceptance": float(np.mean(sampler.acceptance_fraction)),
            "autocorrelation": slowest,
            "independent": independent,
        }
        doubt = "" if independent >= ENOUGH else f"short chains: {independent:.0f} samples' worth"
        return chain.reshape(-1, problem.size), figures, doubt

    def _begin(self, problem: Problem, rng: np.random.Generator) -> NDArray:
        """Points (walkers, k + q) about the best fit."""
        search = Search(problem.misfit, LeastSquares(self.starts, loss="soft_l1"), None)
        _, best = search.run(rng)[0]
        rms = problem.misfit.rms_of(np.nan_to_num(search.residuals(best[None])[0]))
        scales = problem.low[problem.parameters :].copy()
        scales[:2] = np.log(max(rms, 1e-300))
        scales[2:] += problem.width[-1] / 2
        begin = (scales - problem.low[problem.parameters :]) / problem.width[problem.parameters :]
        middle = np.concatenate([best, begin]).clip(2 * BALL, 1 - 2 * BALL)
        points = middle + BALL * rng.normal(size=(self.walkers, problem.size))
        return points.clip(1e-3, 1 - 1e-3)


def _emcee() -> Any:
    try:
        import emcee
    except ImportError:
        raise InputError(
            "method",
            expected="the package emcee, which samples by MCMC",
            got="none installed",
            remedy="pip install 'retwin[bayes]'",
        ) from None
    return emcee
