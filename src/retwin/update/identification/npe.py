"""Neural posterior estimation: a network that approximates the posterior from simulations (sbi)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite, needs_extra, positive, whole
from retwin.progress import Progress, tracked
from retwin.update.identification.problem import BoxProblem, Noise, Summaries


@dataclass(frozen=True)
class NPE:
    """Neural posterior estimation in rounds (truncated sequential, Deistler et al. 2022).

    A mixture density network predicts θ from summaries of data simulated for the calibration
    commands. Each round draws from the part of the prior's box that contains the posterior of the
    last one, and keeps the earlier simulations there. Within the box the prior stays uniform, so
    the posterior needs no correction.

    Parameters
    ----------
    simulations : int
        Values of the parameters per round, at least 50, each simulated for all calibration
        commands. The first round has at least 200, which the test for misspecification needs.
    rounds : int
        Rounds, at least 1; a single one uses the whole prior.
    samples : int
        Draws from the posterior, at least 100.
    max_epochs : int
        Epochs of the network's training per round, at least 1. An epoch has every path with
        `problem.NOISES` draws of noise.
    noise : Noise
        Distribution of the output error, whose scales are inferred too.
    hidden, components : int
        Width and components of the mixture density network, at least 1: in the last box a
        posterior is nearly Gaussian.
    batch_size, learning_rate, clip
        Examples per step, learning rate, and largest norm of the gradient in its training.
    margin : float
        Margin of the next round's box on either side, at least 0, over the width of the posterior.
    tail : float
        Probability of the posterior outside its box, on either side, from 0 to 0.49.

    Raises
    ------
    InputError
        A count below its minimum, or another setting out of its range.

    References
    ----------
    Deistler, Goncalves and Macke, "Truncated proposals for scalable and hassle-free
    simulation-based inference", NeurIPS 2022.

    """

    simulations: int = 500
    rounds: int = 2
    samples: int = 4000
    max_epochs: int = 20
    noise: Noise = field(default_factory=Noise)
    hidden: int = 64
    components: int = 2
    batch_size: int = 256
    learning_rate: float = 5e-3
    clip: float = 5.0
    margin: float = 0.25
    tail: float = 1e-3

    def __post_init__(self) -> None:
        whole("simulations", self.simulations, at_least=50)
        whole("rounds", self.rounds, at_least=1)
        whole("samples", self.samples, at_least=100)
        for name in ("max_epochs", "hidden", "components", "batch_size"):
            whole(name, getattr(self, name), at_least=1)
        positive("learning_rate", self.learning_rate)
        positive("clip", self.clip)
        finite("margin", self.margin, at_least=0.0)
        finite("tail", self.tail, at_least=0.0, at_most=0.49)

    def sample(
        self, problem: BoxProblem, *, seed: int, progress: Progress | None
    ) -> tuple[NDArray, dict[str, float], str]:
        """Points (s, k + q), figures, and a warning, which is empty."""
        rng = np.random.default_rng(seed)
        box = problem.box
        points, paths = problem.prior
        seen = problem.misfit.seen
        for done in tracked(range(self.rounds), self.rounds, progress):
            count = self.simulations if done else max(self.simulations - len(points), 0)
            if count:
                fresh = box[0] + (box[1] - box[0]) * rng.random((count, problem.size))
                made = problem.paths(fresh)
                good = np.isfinite(made).all(axis=(1, 2, 3))
                points = np.concatenate([points, fresh[good]])
                paths = np.concatenate([paths, made[good]])
            inside = np.all((points >= box[0]) & (points <= box[1]), axis=1)
            points, paths = points[inside], paths[inside]
            summaries = Summaries.of(paths)
            theta, observed = problem.with_noise(points, paths, box, summaries, rng)
            measured = summaries(problem.measured, seen)
            unit = (theta - box[0]) / (box[1] - box[0])
            samples, loss = self._posterior(unit, observed, measured, int(rng.integers(2**31)))
            drawn = box[0] + (box[1] - box[0]) * samples
            if done < self.rounds - 1:
                ends = np.quantile(drawn, [self.tail, 1 - self.tail], axis=0)
                margin = self.margin * (ends[1] - ends[0]) + 1e-6
                box = np.clip([ends[0] - margin, ends[1] + margin], box[0], box[1])
        volume = float(np.mean(np.log10(box[1] - box[0])))
        figures = {"loss": loss, "box_log10_width": volume, "kept": float(len(points))}
        return drawn, figures, ""

    def _posterior(
        self, unit: NDArray, observed: NDArray, measured: NDArray, seed: int
    ) -> tuple[NDArray, float]:
        """Draws (s, K), from 0 to 1, given the measured summaries (1, S), and the validation loss.

        `unit` (m, c, K) are m points c times each, `observed` (m, c, S) their noisy summaries.
        """
        import torch

        from retwin.nets.training import Training, isolated, train

        neural_nets = needs_extra("sbi.neural_nets", "bayes", "estimates posteriors")
        mean, scale = observed.mean(axis=(0, 1)), observed.std(axis=(0, 1)).clip(1e-12)

        def tensor(values: NDArray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32).reshape(-1, values.shape[-1])

        context, condition = (observed - mean) / scale, tensor((measured - mean) / scale)
        # Points are held out with all draws of their noise, which share the path.
        # One in this many points is held out to choose the best epoch.
        cut = len(unit) - max(1, len(unit) // 10)
        fitted_on, held_out = (
            (tensor(unit[part]), tensor(context[part])) for part in (slice(cut), slice(cut, None))
        )

        def loss(network: Any, batch: tuple[torch.Tensor, ...]) -> torch.Tensor:
            return network.loss(batch[0], condition=batch[1]).mean()

        with isolated(seed):
            network = neural_nets.posterior_nn(
                "mdn", z_score_x="none", hidden_features=self.hidden, num_components=self.components
            )(*fitted_on)
        how = Training(self.max_epochs, self.batch_size, self.learning_rate, clip=self.clip)
        fit = train(network, loss, fitted_on, held_out, how, seed=seed)
        with isolated(seed), torch.no_grad():
            # Draws per sample of the posterior, since those outside the prior's box are rejected.
            count = 4 * self.samples
            drawn = network.sample((count,), condition=condition)[:, 0].double().numpy()
        # The network does not know the bounds of the prior: draws outside are rejected.
        inside = drawn[np.all((drawn >= 0) & (drawn <= 1), axis=1)][: self.samples]
        # Share of the samples; where fewer lie in the prior's box, draws are clipped to it instead.
        if len(inside) < 0.1 * self.samples:
            inside = drawn[: self.samples].clip(0.0, 1.0)
        return inside, min(fit.history["validation"])
