"""What Bayesian updating gives: draws of the parameters, and a twin that draws from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.faults import Fault
from retwin.trajectories import Channels, Trajectories
from retwin.twins.checks import ideal_outputs
from retwin.twins.parametric import ParametricTwin, ask_inside
from retwin.twins.protocol import Chunk, Limits, Progress, checked_seed, simulate_in_chunks
from retwin.updating.noise import Noise

__all__ = ["Posterior", "PosteriorTwin"]


@dataclass(frozen=True, eq=False)
class PosteriorTwin:
    """A twin with parameters, noise and discrepancy drawn from the posterior per trajectory.

    Parameters
    ----------
    twin: the twin; its values are the posterior mean, which gives the nominal output where the twin
        has none that is free of parameters.
    noise: law of the output error.
    samples: (s, k) of the parameters.
    logs: (s, q) of the scales' logarithms that belong to them.
    unit: (d_y,) physical units per unit of an error.
    stride: samples per reading of the sensor; between them errors are linear.
    emulated: whether the data it was fitted to were emulated.

    """

    twin: ParametricTwin
    noise: Noise
    samples: NDArray
    logs: NDArray
    unit: NDArray
    stride: int = 1
    emulated: bool = False

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        return self.twin.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        return self.twin.outputs

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.twin.rate

    @property
    def limits(self) -> Limits | None:
        """What commands must keep."""
        return self.twin.limits

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`; the output error comes last, on faulty trajectories too."""

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            key = (2, chunk.index.start)
            rng = np.random.default_rng(np.random.SeedSequence(checked_seed(seed), spawn_key=key))
            rows = np.arange(len(chunk.commands))
            drawn = rng.integers(len(self.samples), size=len(rows))
            values = dict(zip(self.twin.names, self.samples[drawn].T, strict=True))
            _, observed = ask_inside(self.twin, chunk, rows, seed=seed, parameters=values)
            observed = observed + self._error(rng, self.logs[drawn], observed.shape[1])
            if self.twin.nominal is not None:
                ideal = ideal_outputs(self.twin.nominal, chunk.commands, len(self.outputs))
            else:
                healthy: list[Fault | None] = [None] * len(rows)
                ideal, _ = ask_inside(self.twin, chunk, rows, None, healthy, seed=seed)
            return ideal, observed

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, emulated=self.emulated
        )

    def _error(self, rng: np.random.Generator, logs: NDArray, steps: int) -> NDArray:
        """Errors (n, steps, d_y) in output units, drawn at the sensor's rate."""
        time = np.arange(steps)
        before, share = time // self.stride, (time % self.stride / self.stride)[:, None]
        count, width = int(before[-1]) + 2, len(self.outputs)
        read = self.noise.draw(rng, logs, count, width, self.stride / self.rate)
        return self.unit * ((1 - share) * read[:, before] + share * read[:, before + 1])


@dataclass(frozen=True, eq=False)
class Posterior:
    """A twin with a posterior of its parameters, p(θ | y_obs, u).

    Attributes
    ----------
    twin: the updated twin; a `Twin` that draws θ, noise and discrepancy per trajectory.
    names: of the parameters.
    samples: (s, k) draws of the parameters.
    scales: draws (s,) by name of the noise's scales: "noise" and "discrepancy" in output units
        (relative to each output's standard deviation where units differ), "duration" in s.
    misspecified: share of prior predictive data that lie as far out as the measured ones. Near 0,
        no parameters and no noise that was thought possible make such data.
    twin_runs: trajectories simulated.
    seconds: that it took.
    figures: what the sampler tells of itself, and `rms_after` of the posterior mean.
    reason: how it ended, and what is in doubt.

    """

    twin: PosteriorTwin
    names: tuple[str, ...]
    samples: NDArray
    scales: dict[str, NDArray]
    misspecified: float
    twin_runs: int
    seconds: float
    figures: dict[str, float]
    reason: str

    @property
    def mean(self) -> dict[str, float]:
        """Posterior mean by name."""
        return dict(zip(self.names, self.samples.mean(axis=0).tolist(), strict=True))

    @property
    def deviation(self) -> dict[str, float]:
        """Posterior standard deviation by name."""
        return dict(zip(self.names, self.samples.std(axis=0).tolist(), strict=True))

    def interval(self, share: float = 0.9) -> dict[str, tuple[float, float]]:
        """The central interval that holds `share` of the posterior, by name."""
        ends = np.quantile(self.samples, [(1 - share) / 2, (1 + share) / 2], axis=0)
        return {n: (float(a), float(b)) for n, (a, b) in zip(self.names, ends.T, strict=True)}
