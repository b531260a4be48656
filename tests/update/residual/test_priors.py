"""What some machines have shown, as the prior of another: a hierarchy of known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.errors import InputError
from retwin.inference.hyperprior import Variances
from retwin.update.corrections.commands.machines import OtherMachines

pytestmark = pytest.mark.numerical

KNOWN = 1e-4
"""Variance of what a machine has shown, where it is known almost exactly."""


def machine(offset: float, scatter: float = 1.0, variance: float = KNOWN) -> dict:
    """What a machine with two actuators has shown; logarithms of variances are 2 log scatter."""
    log = [2 * np.log(scatter), variance]
    return {
        "delay": [[0.02, KNOWN]],
        "offset": [[offset, variance], [-offset, variance]],
        "log_total": [log] * 4,
        "missed": [[1.0, 50.0]],
    }


def deviation(machines: list[dict], kind: str = "offset") -> float:
    return float(np.sqrt(OtherMachines.of(machines).values[kind][1][0]))


def test_one_machine_is_wide_and_several_equal_ones_are_narrow() -> None:
    one, several = deviation([machine(2.0)]), deviation([machine(2.0)] * 12)
    assert one > 2.0  # as large as the offset itself
    assert several < 0.5 * one
    assert deviation([machine(2.0)], "log_total") > 2 * deviation([machine(2.0)] * 12, "log_total")


def test_machines_that_differ_are_wide() -> None:
    rng = np.random.default_rng(0)
    differ = [machine(x) for x in rng.normal(0.0, 3.0, 12)]
    assert 2.0 < deviation(differ) < 4.5
    assert deviation(differ) > 3 * deviation([machine(1.0, 1.0)] * 12) / 1.5


@pytest.mark.slow
@pytest.mark.parametrize("between", [0.3, 1.0, 4.0])
def test_a_further_machine_is_as_far_away_as_predicted(between: float) -> None:
    """Of a known hierarchy, 90 % intervals of a further machine hold 90 %."""
    rng, inside = np.random.default_rng(1), []
    for _ in range(200):
        truth = 3.0 + between * rng.normal(size=9)
        shown = [machine(x + 0.2 * rng.normal(), variance=0.04) for x in truth[:8]]
        mean, variance = (each[0] for each in OtherMachines.of(shown).values["offset"])
        inside.append(abs(truth[8] - mean) < 1.645 * np.sqrt(variance))
    assert 0.84 < np.mean(inside) <= 1.0


def test_variances_have_the_logarithms_that_were_shown() -> None:
    mean, variance = torch.tensor([0.5, -1.0]).double(), torch.tensor([0.2, 1.5]).double()
    found = Variances.of_logarithm(mean, variance)
    rng = np.random.default_rng(2)
    draws = found.count.numpy() * found.expected.numpy() / rng.chisquare(found.count, (100_000, 2))
    np.testing.assert_allclose(np.log(draws).mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose(np.log(draws).var(axis=0), variance, rtol=0.03)


VOLTS, ANGLE = rt.Channels(("voltage",), ("V",)), rt.Channels(("angle",), ("rad",))
QUICK = rt.Mixture(components=1, training=rt.Training(max_epochs=3))


def runs(count: int, bias: float, seed: int, inputs: rt.Channels = VOLTS) -> rt.Trajectories:
    """A machine that stops `bias` V away from its targets, on average."""
    rng = np.random.default_rng(seed)
    ramp = np.clip((np.arange(60) - 10) / 15, 0, 1)
    levels = rng.uniform(-1, 1, (count, 5, 1))
    steps = np.diff(levels, axis=1)
    commands = (levels[:, :-1] + ramp * steps).reshape(count, -1, 1)
    ends = levels + bias + 0.02 * rng.normal(size=levels.shape)
    ends[:, 0] = levels[:, 0]
    actual = (ends[:, :-1] + ramp * np.diff(ends, axis=1)).reshape(count, -1, 1)
    observed = 2 * actual + 0.002 * rng.normal(size=actual.shape)
    nominal = 2 * commands
    return rt.Trajectories(
        commands, nominal, observed, 50.0, labels=["Healthy"] * count, inputs=inputs, outputs=ANGLE
    )


def twin(inputs: rt.Channels = VOLTS) -> rt.Surrogate:
    """angle = 2 u, exactly."""
    surrogate = rt.Surrogate(rt.MLP(()), inputs=inputs, outputs=ANGLE, rate=50.0)
    with torch.no_grad():
        surrogate.network[0].weight.fill_(2.0)
        surrogate.network[0].bias.fill_(0.0)
    return surrogate.eval()


def fitted(count: int, bias: float, seed: int, **more) -> rt.ResidualModel:
    return rt.fit_residual(
        twin(), runs(count, bias, seed), rt.CommandSpace(), QUICK, seed=0, **more
    )


@pytest.fixture(scope="module")
def good() -> rt.ResidualModel:
    return fitted(4, 0.1, 0)


@pytest.mark.slow
def test_models_of_other_machines_are_the_prior(good, tmp_path: Path) -> None:
    """A folder or a model, or several; the record states from how many machines it came."""
    assert good.learned["offset"][0][0] == pytest.approx(0.1, abs=0.03)
    good.save(tmp_path / "one")
    assert rt.ResidualModel.load(tmp_path / "one").learned == good.learned
    with pytest.warns(UserWarning, match="1 trajectories to calibrate on"):
        found = fitted(1, 0.1, 9, prior=[tmp_path / "one", good])
    assert "prior from 2 other machines" in found.fitted.reason
    assert found.learned["offset"][0][0] == pytest.approx(0.1, abs=0.03)


def test_a_prior_that_cannot_be_one_is_refused(good, tmp_path: Path) -> None:
    good.save(tmp_path / "damaged")
    (tmp_path / "damaged" / "weights.safetensors").write_bytes(b"damaged")
    current = rt.Channels(("current",), ("A",))
    names = {"inputs": current, "outputs": ANGLE}
    other = rt.ResidualModel(rt.CommandSpace(), QUICK, **names, segmentation="commands")
    names["inputs"] = VOLTS
    outputs = rt.ResidualModel(rt.DelayOffset(), QUICK, **names, segmentation="commands")
    old = rt.ResidualModel(rt.CommandSpace(), QUICK, **names, segmentation="commands")
    for prior in (other, outputs, old, tmp_path / "damaged", tmp_path / "none", [], 3):
        with pytest.raises(InputError) as error:
            fitted(1, 0.1, 1, prior=prior)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="CommandSpace"):
        rt.fit_residual(twin(), runs(3, 0.1, 0), rt.DelayOffset(), QUICK, seed=0, prior=good)
