"""Scores of simulated records, of twins whose distribution is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import retwin as rt
from retwin.evaluation import record_means, simulate_records, simulation_scores

CHANNELS = rt.Channels(("u",), ("1",)), rt.Channels(("y",), ("V",))


@dataclass(frozen=True)
class Gaussian:
    """The command plus noise, which may be absent at the first sample."""

    deviation: float
    known_start: bool = False
    inputs, outputs = CHANNELS
    rate = 10.0

    def simulate(self, commands, *, faults=None, seed, progress=None):
        noise = np.random.default_rng(seed).normal(scale=self.deviation, size=commands.shape)
        if self.known_start:
            noise[:, 0] = 0.0
        inputs, outputs = CHANNELS
        made = {"commands": commands, "nominal": commands, "observed": commands + noise}
        return rt.Trajectories(**made, rate=self.rate, inputs=inputs, outputs=outputs)


def scores(twin: Gaussian, missing: int = 0) -> dict[str, float]:
    commands = np.random.default_rng(0).normal(size=(3, 400, 1))
    records = Gaussian(0.5).simulate(commands, seed=1)
    mask = np.ones(commands.shape, dtype=bool)
    mask[:, :missing] = False
    records = records.replace(mask=mask)
    found = simulate_records(twin, records, draws=400, seed=2)
    return {
        name: float(each)
        for name, each in simulation_scores(record_means(found.per_sample()), records).items()
    }


def test_the_negative_log_density_is_that_of_the_distribution() -> None:
    exact = scores(Gaussian(0.5))
    assert exact["nll"] == pytest.approx(0.5 * np.log(2 * np.pi * np.e * 0.25), abs=0.05)
    assert exact["nll"] < min(scores(Gaussian(deviation))["nll"] for deviation in (0.35, 0.7))


def test_a_source_without_spread_at_a_measured_sample_has_none() -> None:
    assert np.isnan(scores(Gaussian(0.0))["nll"])
    assert np.isnan(scores(Gaussian(0.5, known_start=True))["nll"])
    assert np.isfinite(scores(Gaussian(0.5, known_start=True), missing=1)["nll"])
    assert np.isfinite(scores(Gaussian(0.0))["crps"])
