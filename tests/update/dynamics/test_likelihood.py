"""The likelihood of variants of a record: the kernel agrees with the filter in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update.dynamics import DynamicsTwin
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.filter import likelihood
from retwin.update.dynamics.filter.likelihood import Record, Variants

SAMPLES, COUNT = 60, 11
RNG = np.random.default_rng(0)
ONSETS = RNG.integers(0, SAMPLES + 1, COUNT)
"""Samples from which on each variant differs from the record; one may never do."""


def motor(interpolation: str) -> StateTwin:
    """A motor with dry friction, of which the speed and the current are measured."""
    return StateTwin(
        (State("speed", "rad/s", 0.0), State("current", "A", 0.5, low=0.0, high=1.0)),
        lambda x, u, p: (x.speed, x.current * p.gain),
        rt.Channels(("voltage",), ("V",)),
        rt.Channels(("speed", "current"), ("rad/s", "A")),
        20.0,
        derivative=lambda x, u, p: (
            10 * x.current - p.friction * torch.tanh(x.speed),
            5 * u.voltage - 8 * x.current - 2 * x.speed,
        ),
        parameters=(
            Parameter("friction", "1/s", 0.0, 5.0, 1.0),
            Parameter("gain", "1", 0, 2, 1.0),
            Parameter("dead", "s", 0.0, 1.0, 0.17),
        ),
        delays={"voltage": "dead"},
        substeps=2,
        interpolation=interpolation,
    )


def record(interpolation: str = "hold", proportional: float = 0.0) -> Record:
    equations = motor(interpolation)
    twin = DynamicsTwin(
        equations,
        values=equations.values(None, 1)[0],
        factor=np.diag([0.1, 0.05, 0.01, 0.0, 0.1])[:, [0, 1, 2, 4]],
        start_deviation=np.zeros(2),
        process=np.array([1e-3, 1e-4]),
        proportional=np.full(2, proportional),
        free_process=np.array([1e-3, 1e-4]),
        noise=np.array([0.01, 0.02]),
        widening=np.ones(2),
        constant=np.zeros(2),
        domain=Domain(np.full(3, -3.0), np.full(3, 3.0), np.ones(3), np.ones(2)),
        corrected=("speed", "current"),
    )
    rng = np.random.default_rng(1)
    commands = np.repeat(rng.uniform(-1, 1, (SAMPLES // 10, 1)), 10, axis=0)
    outputs = equations.steps().run(commands[None], twin.values[None])[0][0]
    seen = rng.random(outputs.shape) < 0.8
    measured = np.where(seen, outputs + 0.1 * rng.normal(size=outputs.shape), 0.0)
    return Record(twin, commands, measured, seen, known_start=True)


def variants(of: Record, kind: str) -> Variants:
    """Each differs from the record from its onset on."""
    late = np.arange(SAMPLES) >= ONSETS[:, None]
    size = np.random.default_rng(2).uniform(0.1, 0.5, (COUNT, 1))
    if kind == "commands":
        return Variants(commands=of.commands * (1 + size * late)[..., None])
    if kind == "measured":
        return Variants(measured=of.measured + (size * late)[..., None] * of.seen)
    if kind == "seen":
        return Variants(seen=of.seen & ~(late[..., None] & np.array([True, False])))
    return Variants(change=size * late, parameter=0) if kind == "change" else Variants()


@pytest.mark.parametrize("proportional", [0.0, 0.01])
@pytest.mark.parametrize("interpolation", ["hold", "spline"])
@pytest.mark.parametrize("kind", ["none", "commands", "measured", "seen", "change"])
def test_the_kernel_agrees_with_the_filter(
    kind: str, interpolation: str, proportional: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = record(interpolation, proportional)
    given = variants(own, kind)
    slopes = own.twin.filter.slopes(own.commands[None], own.measured[None], own.seen[None])[0]
    noises = ((0.0, 0.0), (np.array([1e-3, 0.0]), 0.0), (0.0, np.array([0.02, 0.01])))
    made = [own.log_density(given, slopes, more) for more in noises]
    monkeypatch.setattr(likelihood, "_library", lambda model: None)
    expected = [own.log_density(given, slopes, more) for more in noises]
    assert len(made[0]) == (1 if kind == "none" else COUNT)
    np.testing.assert_allclose(made, expected, rtol=1e-9)


def test_the_likelihood_is_that_of_parameters_that_are_drawn() -> None:
    """The mean over the posterior is that of many draws, where predictions are linear."""
    own = record()
    slopes = 0.3 * own.twin.filter.slopes(own.commands[None], own.measured[None], own.seen[None])[0]
    mean, covariance, _ = own.filtered(Variants())
    draws = np.random.default_rng(3).normal(size=(20_000, slopes.shape[2]))
    errors = np.where(own.seen, own.measured - mean[0], 0.0) - np.where(
        own.seen[..., None], slopes, 0.0
    ).dot(draws.T).transpose(2, 0, 1)
    root = likelihood.root_of(covariance, own.seen[None])
    white = np.linalg.solve(root, errors[..., None])[..., 0]
    logs = np.log(np.diagonal(root[0], axis1=1, axis2=2)).sum()
    each = -0.5 * np.sum(white**2, axis=(1, 2)) - logs - own.seen.sum() * np.log(2 * np.pi) / 2
    expected = np.logaddexp.reduce(each) - np.log(len(each))
    assert abs(own.log_density(Variants(), slopes)[0] - expected) < 0.05


def test_the_likelihood_of_nearly_exact_outputs_is_right_to_all_digits() -> None:
    """Without process noise, each factor of the noise adds as much to its logarithm."""
    own = record()
    outputs = own.twin.equations.steps().run(own.commands[None], own.twin.values[None])[0][0]
    own = replace(own, measured=outputs, seen=np.ones(outputs.shape, dtype=bool))

    def logs(noise: float) -> np.ndarray:
        twin = replace(own.twin, noise=np.full(2, noise), process=np.zeros(2))
        exact = replace(own, twin=twin)
        return exact.log_density(variants(exact, "seen"), np.zeros((SAMPLES, 2, 0)))

    first, second, third = logs(1e-8), logs(1e-16), logs(1e-24)
    np.testing.assert_allclose(third - second, second - first, rtol=1e-7)


def test_a_variant_with_which_the_filter_diverges_has_no_likelihood() -> None:
    own = record()
    change = np.zeros((3, SAMPLES))
    change[1, 20:] = np.nan
    made = own.log_density(Variants(change=change), np.zeros((SAMPLES, 2, 0)))
    assert np.isfinite(made[[0, 2]]).all()
    assert made[1] == -np.inf
