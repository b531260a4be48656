"""What Bayesian updating gives: draws of the parameters, and a twin that draws from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model
from retwin.twins.faults import Fault
from retwin.twins.noisy import interpolate_samples, sensor_sample_count
from retwin.twins.parametric import ParametricTwin
from retwin.twins.randomised import simulate_with_parameters
from retwin.twins.twin import Chunk, simulate_in_chunks
from retwin.twins.wrapper import TwinWrapper, chunk_generator
from retwin.update.identification.noise import Noise

__all__ = ["Posterior", "PosteriorTwin"]

KIND = "posterior"


@dataclass(frozen=True, eq=False)
class PosteriorTwin(TwinWrapper):
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
            rng = chunk_generator(seed, chunk, 2)
            drawn = rng.integers(len(self.samples), size=len(chunk.commands))
            ideal, observed = simulate_with_parameters(
                self.twin, chunk, self.samples[drawn], seed=seed
            )
            return ideal, observed + self._error(rng, self.logs[drawn], observed.shape[1])

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, emulated=self.emulated
        )

    def _error(self, rng: np.random.Generator, logs: NDArray, steps: int) -> NDArray:
        """Errors (n, steps, d_y) in output units, drawn at the sensor's rate."""
        count = sensor_sample_count(steps, self.stride)
        read = self.noise.draw(rng, logs, count, len(self.outputs), self.stride / self.rate)
        return self.unit * interpolate_samples(read, self.stride, steps)

    def save(self, folder: str | Path) -> None:
        """Write the draws and what they are of; the twin itself is not written."""
        about = {
            "names": self.twin.names,
            "values": self.twin.values,
            "noise": to_config(self.noise, (Noise,)),
            "stride": int(self.stride),
            "emulated": self.emulated,
        }
        drawn = {"samples": self.samples, "logs": self.logs, "unit": self.unit}
        with write_model(folder, KIND, about, {k: torch.tensor(v) for k, v in drawn.items()}):
            pass

    @classmethod
    def load(cls, folder: str | Path, twin: ParametricTwin) -> PosteriorTwin:
        """Read what `save` wrote, for the same twin at whatever values.

        Raises InputError when it is no posterior, damaged, or one of other parameters.
        """
        about, drawn = read_model(folder, KIND)
        if tuple(about["names"]) != twin.names:
            raise InputError(
                "twin",
                expected=f"one with the parameters {', '.join(about['names'])}",
                got=", ".join(twin.names),
                remedy="give the twin whose posterior it is",
            )
        return cls(
            twin.with_values(about["values"]),
            from_config(about["noise"], (Noise,)),
            **{name: drawn[name].numpy() for name in ("samples", "logs", "unit")},
            stride=about["stride"],
            emulated=about["emulated"],
        )


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
