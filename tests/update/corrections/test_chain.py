"""`Chain`: operators in series, and a record at the end."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import retwin as rt
from retwin import catalog
from retwin.cases.armpi_fpv.twin import RATE, SENSOR_RATE
from retwin.serialisation.configs import from_config, to_config
from retwin.update.corrections import fit_correction, measured_outputs, sample_mask

POLL = round(RATE / SENSOR_RATE)

KINDS = catalog.classes(catalog.CORRECTIONS)

pytestmark = pytest.mark.numerical

ROBOT = rt.Chain(rt.CommandSpace(), rt.SampledSensor())


@pytest.fixture(scope="module")
def measured(case: rt.Case) -> rt.Trajectories:
    commands = case.sampler.sample(12, rng=np.random.default_rng(4))
    return case.emulator.simulate(commands, seed=2)


def context_of(exact, made: rt.Trajectories) -> rt.Context:
    segments = rt.Segments.from_commands(made.commands)
    return rt.Context.of(exact, made.commands, segments, rate=made.rate)


def arrays(made: rt.Trajectories) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor(made.observed), torch.tensor(made.mask)


@pytest.mark.slow
def test_between_readings_a_record_tells_nothing(exact, measured: rt.Trajectories) -> None:
    """The chain finds the samples itself: the same as if their places were given."""
    context = context_of(exact, measured)
    observed, mask = arrays(measured)
    sampled = mask.clone()
    sampled[:] = False
    sampled[:, ::POLL] = mask[:, ::POLL]
    found, truth = (
        ROBOT.infer(context, observed, mask),
        rt.CommandSpace().infer(context, observed, sampled),
    )
    torch.testing.assert_close(found.z, truth.z)
    torch.testing.assert_close(found.covariance, truth.covariance)
    assert sample_mask(ROBOT, observed, mask, context.rate).equal(sampled)


@pytest.mark.slow
def test_the_sensor_is_fitted_with_z(exact, measured: rt.Trajectories) -> None:
    """Real noise is a unit or so of a joint, tenths of a millimetre; a glitch is much more."""
    context = context_of(exact, measured)
    chain, found = fit_correction(ROBOT, context, *arrays(measured))
    sensor = chain.second
    assert sensor.timing(context.rate) == (POLL, (0,))
    assert sensor.glitch_probability < 0.02
    assert 1e-5 < sensor.noise[0][-4] < 3e-3
    outputs = chain.apply(context, found.z)
    record = measured_outputs(chain, context, found.z, torch.Generator().manual_seed(0))
    # Between readings nothing was computed, and nothing is missing.
    whole = sensor.read(outputs, torch.Generator().manual_seed(0), context.rate)
    torch.testing.assert_close(record, whole, rtol=0, atol=1e-6)
    off = (record - outputs)[:, ::POLL].abs()
    assert 1e-5 < off.mean() < 2e-3
    torch.testing.assert_close(chain.apply(context, 0 * found.z), context.path)


def test_an_operator_without_a_sensor_is_recorded_as_it_is(
    exact, measured: rt.Trajectories
) -> None:
    context = context_of(exact, measured)
    z = torch.randn(*context.segments.start.shape, 4, generator=torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(0)
    record = measured_outputs(rt.DelayOffset(), context, z, generator)
    assert record.equal(rt.DelayOffset().apply(context, z))
    assert generator.get_state().equal(torch.Generator().manual_seed(0).get_state())


@pytest.mark.slow
def test_the_second_operator_explains_what_the_first_leaves(exact, case: rt.Case) -> None:
    """An error off what the arm can reach: the joints cannot explain it, an offset can."""
    commands = case.sampler.sample(10, rng=np.random.default_rng(5))
    context = rt.Context.of(exact, commands, rt.Segments.from_commands(commands), rate=100.0)
    chain = rt.Chain(rt.CommandSpace(), rt.DelayOffset())
    assert len(chain.latent(case.inputs, case.outputs)) == 9 + 4
    z = torch.zeros(*context.segments.start.shape, 13, dtype=torch.float64)
    z[..., 0] = 4.0
    z[..., 12] = 0.01  # every output a centimetre higher than the joints say
    observed = chain.apply(context, z)
    one = rt.CommandSpace().infer(context, observed, observed == observed)
    both = chain.infer(context, observed, observed == observed)
    torch.testing.assert_close(both.z[..., :9], one.z)
    assert not both.posterior
    assert both.covariance.shape == (*z.shape, 13)
    left = (chain.apply(context, both.z.to(z)) - observed).square().mean().sqrt()
    alone = (rt.CommandSpace().apply(context, one.z) - observed).square().mean().sqrt()
    assert left <= alone


def test_chains_are_checked_and_survive_json() -> None:
    assert from_config(to_config(ROBOT, KINDS), KINDS) == ROBOT
    nested = rt.Chain(rt.Chain(rt.CommandSpace(), rt.DelayOffset()), rt.SampledSensor(period=0.04))
    assert from_config(to_config(nested, KINDS), KINDS) == nested
    assert nested.pools
    assert nested.severities
    for bad in ((rt.SampledSensor(), rt.DelayOffset()), (ROBOT, rt.SampledSensor())):
        with pytest.raises(rt.InputError, match="sensor being last"):
            rt.Chain(*bad)
