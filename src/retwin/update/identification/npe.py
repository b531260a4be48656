"""Neural posterior estimation (sbi): a network learns the posterior from simulated data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.progress import Progress
from retwin.update.identification.misfit import check_counts
from retwin.update.identification.problem import Problem
from retwin.update.identification.summaries import Summaries

__all__ = ["NPE"]

MARGIN = 0.25
"""By how much of its width the box of the next round is wider than the posterior."""
TAIL = 1e-3
"""Share of the posterior's draws beyond which its box ends, on either side."""
SPARE, LEAST = 4, 0.1
"""Draws per sample wanted, and the share of these below which they are set on the edge instead."""
HIDDEN, COMPONENTS = 64, 2
"""Of the mixture density network: in the last box a posterior is nearly Gaussian."""
BATCH, RATE, CLIP = 256, 5e-3, 5.0
VALIDATION = 10
"""One in so many points is held out to choose the best epoch."""


@dataclass(frozen=True)
class NPE:
    """Neural posterior estimation in rounds (truncated sequential, Deistler et al. 2022).

    A mixture density network learns θ from summaries of data simulated for the calibration
    commands. Each round draws from the part of the prior's box in which the posterior of the last
    one lies, and keeps what earlier rounds simulated there: within the box the prior stays uniform,
    so nothing has to be corrected.

    Parameters
    ----------
    simulations: values of the parameters per round, each simulated for all calibration commands;
        in the first round 200 at least, which also tell whether the twin is misspecified.
    rounds: 1 uses the whole prior only.
    samples: drawn from the posterior.
    epochs: of the network per round; each sees every path through `problem.NOISES` draws of noise.

    """

    simulations: int = 500
    rounds: int = 2
    samples: int = 4000
    epochs: int = 20

    def __post_init__(self) -> None:
        check_counts(rounds=self.rounds, epochs=self.epochs)
        check_counts(50, simulations=self.simulations)
        check_counts(100, samples=self.samples)

    def sample(
        self, problem: Problem, *, seed: int, progress: Progress | None
    ) -> tuple[NDArray, dict[str, float], str]:
        """Points (s, k + q), figures, and in words how it went."""
        rng = np.random.default_rng(seed)
        box = problem.box
        points, paths = problem.prior
        seen = problem.misfit.seen
        for done in range(self.rounds):
            count = self.simulations if done else max(self.simulations - len(points), 0)
            fresh = box[0] + (box[1] - box[0]) * rng.random((count, problem.size))
            made = problem.paths(fresh)
            good = np.isfinite(made).all(axis=(1, 2, 3))
            points = np.concatenate([points, fresh[good]])
            paths = np.concatenate([paths, made[good]])
            inside = np.all((points >= box[0]) & (points <= box[1]), axis=1)
            points, paths = points[inside], paths[inside]
            summaries = Summaries.of(paths)
            told, known = problem.seen_noisily(points, paths, box, summaries, rng)
            measured = summaries(problem.measured, seen)
            share = (told - box[0]) / (box[1] - box[0])
            found, loss = self._learn(share, known, measured, int(rng.integers(2**31)))
            drawn = box[0] + (box[1] - box[0]) * found
            if progress is not None:
                progress((done + 1) / self.rounds)
            if done < self.rounds - 1:
                ends = np.quantile(drawn, [TAIL, 1 - TAIL], axis=0)
                wider = MARGIN * (ends[1] - ends[0]) + 1e-6
                box = np.clip([ends[0] - wider, ends[1] + wider], box[0], box[1])
        volume = float(np.mean(np.log10(box[1] - box[0])))
        figures = {"loss": loss, "box_log10_width": volume, "kept": float(len(points))}
        return drawn, figures, ""

    def _learn(
        self, share: NDArray, told: NDArray, measured: NDArray, seed: int
    ) -> tuple[NDArray, float]:
        """Draws (s, K) from 0 to 1 given what was measured (1, S), and the loss on held-out points.

        `share` (m, c, K) are m points c times each, `told` (m, c, S) what was seen of them.
        """
        import torch

        from retwin.nets.training import Training, isolated, train

        build = _density()
        middle, scale = told.mean(axis=(0, 1)), told.std(axis=(0, 1)).clip(1e-12)

        def tensor(values: NDArray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32).reshape(-1, values.shape[-1])

        known, asked = (told - middle) / scale, tensor((measured - middle) / scale)
        # Points are held out, not single draws of their noise: those share the path.
        cut = len(share) - max(1, len(share) // VALIDATION)
        fitted_on, held_out = (
            (tensor(share[part]), tensor(known[part])) for part in (slice(cut), slice(cut, None))
        )

        def loss(network: Any, batch: tuple[torch.Tensor, ...]) -> torch.Tensor:
            return network.loss(batch[0], condition=batch[1]).mean()

        with isolated(seed):
            network = build(
                "mdn", z_score_x="none", hidden_features=HIDDEN, num_components=COMPONENTS
            )(*fitted_on)
        how = Training(max_epochs=self.epochs, batch_size=BATCH, learning_rate=RATE, clip=CLIP)
        fit = train(network, loss, fitted_on, held_out, how, seed=seed)
        with isolated(seed), torch.no_grad():
            drawn = network.sample((SPARE * self.samples,), condition=asked)[:, 0].double().numpy()
        # The network knows no edges: what leaks over those of the prior is drawn again.
        inside = drawn[np.all((drawn >= 0) & (drawn <= 1), axis=1)][: self.samples]
        if len(inside) < LEAST * self.samples:
            inside = drawn[: self.samples].clip(0.0, 1.0)
        return inside, min(fit.history["validation"])


def _density() -> Any:
    try:
        from sbi.neural_nets import posterior_nn
    except ImportError:
        raise InputError(
            "method",
            expected="the package sbi, which learns posteriors",
            got="none installed",
            remedy="pip install 'retwin[bayes]'",
        ) from None
    return posterior_nn
