"""The posterior of Bayesian identification: its draws, and a twin that draws from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.arrays import interpolated
from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, save_model
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Chunk, simulate_in_chunks
from retwin.twins.wrappers.noisy import sensor_sample_count
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.randomised import simulate_with_parameters
from retwin.twins.wrappers.wrapper import TwinWrapper, chunk_generator
from retwin.update.identification.problem import Noise

KIND = "posterior"
"""Kind of the saved model."""


@dataclass(frozen=True, eq=False)
class PosteriorTwin(TwinWrapper):
    """A twin with parameters, noise and discrepancy drawn from the posterior per trajectory.

    Parameters
    ----------
    twin : ParametricTwin
        The twin at the posterior mean, which gives the nominal output if that depends on the
        parameters.
    noise : Noise
        Distribution of the output error.
    samples : NDArray
        (s, k), draws of the parameters.
    logs : NDArray
        (s, q), logarithms of the scales of the same draws.
    unit : NDArray
        (d_y,), physical units per unit of an error.
    stride : int
        Samples of the record per sample of the sensor; errors are linear in between.
    emulated : bool
        Whether the data that it was fitted to were emulated.

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
        """See `Twin.simulate`; the output error is added last, to faulty trajectories too."""

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
        """Errors (n, steps, d_y) in output units, drawn at the sensor's rate and interpolated."""
        count = sensor_sample_count(steps, self.stride)
        read = self.noise.draw(rng, logs, count, len(self.outputs), self.stride / self.rate)
        return self.unit * interpolated(read, np.arange(steps), self.stride)

    def save(self, folder: str | Path) -> None:
        """Write the draws and the names of the parameters; the twin itself is not written."""
        about = {
            "names": self.twin.names,
            "values": self.twin.values,
            "units": [each.unit for each in self.twin.parameters],
            "noise": to_config(self.noise, (Noise,)),
            "stride": int(self.stride),
            "emulated": self.emulated,
        }
        drawn = {"samples": self.samples, "logs": self.logs, "unit": self.unit}
        save_model(folder, KIND, about, {k: torch.tensor(v) for k, v in drawn.items()})

    @classmethod
    def load(cls, folder: str | Path, twin: ParametricTwin) -> PosteriorTwin:
        """Read what `save` wrote, for the same twin at any values.

        Raises InputError if the folder holds no posterior, is damaged, or has other parameters.
        """
        about, drawn = read_model(folder, KIND)
        same = tuple(about["names"]) == twin.names
        expected = f"one with the parameters {', '.join(about['names'])}"
        remedy = "give the twin whose posterior it is"
        require(same, "twin", expected=expected, got=", ".join(twin.names), remedy=remedy)
        samples, values = drawn["samples"].numpy(), np.array(about["values"])
        return cls(
            twin.with_values(values),
            from_config(about["noise"], (Noise,)),
            samples=samples,
            **{name: drawn[name].numpy() for name in ("logs", "unit")},
            stride=about["stride"],
            emulated=about["emulated"],
        )


@dataclass(frozen=True, eq=False)
class Posterior:
    """A twin with a posterior of its parameters, p(θ | y_obs, u).

    Attributes
    ----------
    twin : PosteriorTwin
        The updated twin, which draws θ, noise and discrepancy per trajectory.
    names : tuple of str
        Names of the parameters.
    samples : NDArray
        (s, k), draws of the parameters.
    scales : dict of str to NDArray
        Draws (s,) of the scales of the noise: "noise" and "discrepancy" in output units (relative
        to each output's standard deviation where units differ), "duration" in s.
    misspecified : float
        Prior predictive p-value of the measured data. Near 0, no parameters and noise within the
        prior give such data.
    twin_runs : int
        Trajectories simulated.
    seconds : float
        Duration of the identification.
    figures : dict of str to float
        Diagnostics of the method, and `rms_before` and `rms_after` of the posterior mean.
    reason : str
        How many samples were drawn, and the warnings.

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
        """The central credible interval of probability `share`, by name."""
        ends = np.quantile(self.samples, [(1 - share) / 2, (1 + share) / 2], axis=0)
        return {n: (float(a), float(b)) for n, (a, b) in zip(self.names, ends.T, strict=True)}
