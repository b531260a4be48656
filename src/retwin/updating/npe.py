"""Neural posterior estimation (sbi): a network learns the posterior from simulated data."""

from __future__ import annotations

import io
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.trajectories import Progress
from retwin.updating.misfit import check_counts
from retwin.updating.problem import Problem
from retwin.updating.summaries import Summaries

__all__ = ["NPE"]

MARGIN = 0.25
"""By how much of its width the box of the next round is wider than the posterior."""
TAIL = 1e-3
"""Share of the posterior's draws beyond which its box ends, on either side."""
SPARE, LEAST = 4, 0.1
"""Draws per sample wanted, and the share of these below which they are set on the edge instead."""
HIDDEN, COMPONENTS = 32, 2
"""Of the mixture density network: in the last box a posterior is nearly Gaussian."""
BATCH, RATE, PATIENCE = 500, 2e-3, 20


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
    epochs: at most, per round.

    """

    simulations: int = 500
    rounds: int = 2
    samples: int = 4000
    epochs: int = 500

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
        epochs = 0
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
            told, noisy = problem.seen_noisily(points, paths, box, rng)
            known = summaries(noisy, seen)
            measured = summaries(problem.measured, seen)
            share = (told - box[0]) / (box[1] - box[0])
            found, taken = self._learn(share, known, measured, int(rng.integers(2**31)))
            drawn = box[0] + (box[1] - box[0]) * found
            epochs += taken
            if progress is not None:
                progress((done + 1) / self.rounds)
            if done < self.rounds - 1:
                ends = np.quantile(drawn, [TAIL, 1 - TAIL], axis=0)
                wider = MARGIN * (ends[1] - ends[0]) + 1e-6
                box = np.clip([ends[0] - wider, ends[1] + wider], box[0], box[1])
        volume = float(np.mean(np.log10(box[1] - box[0])))
        figures = {"epochs": float(epochs), "box_log10_width": volume, "kept": float(len(points))}
        doubt = (
            "" if taken <= self.epochs else "the network was still learning when its epochs ended"
        )
        return drawn, figures, doubt

    def _learn(
        self, share: NDArray, told: NDArray, measured: NDArray, seed: int
    ) -> tuple[NDArray, int]:
        """Draws (s, K) from 0 to 1 given what was measured, and the epochs it took."""
        import torch

        from retwin.training import isolated

        trainer, builder = _sbi()
        middle, scale = told.mean(axis=0), told.std(axis=0).clip(1e-12)
        known = torch.as_tensor((told - middle) / scale, dtype=torch.float32)
        asked = torch.as_tensor((measured - middle) / scale, dtype=torch.float32)
        with isolated(seed):
            learner = trainer(
                density_estimator=builder(
                    "mdn", z_score_x="none", hidden_features=HIDDEN, num_components=COMPONENTS
                ),
                show_progress_bars=False,
                tracker=_Silent(),
            )
            learner.append_simulations(torch.as_tensor(share, dtype=torch.float32), known)
            # sbi prints that it is done; that the epochs are spent is told in the result's reason.
            with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
                warnings.filterwarnings("ignore", "Maximum number of epochs", UserWarning)
                network = learner.train(
                    training_batch_size=min(BATCH, max(10, len(share) // 10)),
                    learning_rate=RATE,
                    stop_after_epochs=PATIENCE,
                    max_num_epochs=self.epochs,
                )
            with torch.no_grad():
                drawn = (
                    network.sample((SPARE * self.samples,), condition=asked)[:, 0].double().numpy()
                )
        # The network knows no edges: what leaks over those of the prior is drawn again.
        inside = drawn[np.all((drawn >= 0) & (drawn <= 1), axis=1)][: self.samples]
        if len(inside) < LEAST * self.samples:
            inside = drawn[: self.samples].clip(0.0, 1.0)
        return inside, int(learner.epoch)


class _Silent:
    """Keeps sbi from writing logs into the current folder."""

    log_dir = None

    def log_metric(self, *_: Any, **__: Any) -> None: ...

    def log_metrics(self, *_: Any, **__: Any) -> None: ...

    def log_params(self, *_: Any, **__: Any) -> None: ...

    def add_figure(self, *_: Any, **__: Any) -> None: ...

    def flush(self) -> None: ...


def _sbi() -> tuple[Any, Any]:
    try:
        from sbi.inference import NPE as Trainer  # noqa: N811
        from sbi.neural_nets import posterior_nn
    except ImportError:
        raise InputError(
            "method",
            expected="the package sbi, which learns posteriors",
            got="none installed",
            remedy="pip install 'retwin[bayes]'",
        ) from None
    return Trainer, posterior_nn
