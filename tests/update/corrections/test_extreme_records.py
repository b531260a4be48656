"""Records at the limits of what z can be inferred from: a single segment, units of any size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import retwin as rt
from retwin.inference.noise import Noise, StudentT
from retwin.update.corrections.commands.offset_features import OffsetFeatures
from retwin.update.corrections.commands.problem import COMMON_ERROR, CommandProblem

RATE = 50.0
OPERATORS = (rt.DelayOffset, rt.CommandSpace)


class Plane(torch.nn.Module):
    """Two outputs of two actuators, without memory, in units of any size."""

    memoryless = True
    rate = RATE
    inputs = rt.Channels(("u", "v"), ("V", "V"))

    def __init__(self, sizes: tuple[float, float] = (1.0, 1.0)) -> None:
        super().__init__()
        self.matrix = torch.tensor([[1.0, 0.4], [-0.5, 0.8]]).double()
        self.matrix = self.matrix * torch.tensor(sizes).double()[:, None]
        units = ("m", "m") if sizes[0] == sizes[1] else ("m", "Pa")
        self.outputs = rt.Channels(("x", "y"), units)

    def forward(self, commands: torch.Tensor) -> torch.Tensor:
        return (commands.double() @ self.matrix.T).to(commands.dtype)

    def predict(self, commands: NDArray) -> NDArray:
        return self(torch.tensor(commands, dtype=torch.float32)).numpy()


def commands_of(count: int, *, segments: int = 4, seed: int = 0) -> NDArray:
    """Ramps and holds."""
    sampler = rt.twins.RampSampler((-1, -1), (1, 1), RATE, 1.5 * segments, segments=segments)
    return sampler.sample(count, rng=np.random.default_rng(seed))


def measured(
    twin: Plane, commands: NDArray, *, noise: float = 0.005
) -> tuple[rt.Context, torch.Tensor, torch.Tensor]:
    """The context, z of `CommandSpace` and outputs: delays of about 4 samples, and offsets."""
    rng = np.random.default_rng(1)
    context = rt.Context.of(twin, commands, rt.Segments.from_commands(commands), rate=RATE)
    shape = context.segments.start.shape
    parts = rng.normal(4, 0.2, (*shape, 1)), rng.normal(0, 0.03, (*shape, 2)), np.zeros((*shape, 2))
    z = torch.tensor(np.concatenate(parts, axis=-1))
    outputs = rt.CommandSpace().apply(context, z).double()
    size = twin.matrix.norm(dim=1)
    return context, z, outputs + noise * size * torch.tensor(rng.normal(size=outputs.shape))


@pytest.mark.parametrize("count", [1, 5])
def test_actuators_with_one_target_have_finite_hyperparameters(count: int) -> None:
    """All segments end at the same target, as that of a record with a single one does."""
    commands = np.repeat(commands_of(1, segments=1), count, axis=0)
    context, z, outputs = measured(Plane(), commands)
    found = rt.CommandSpace().infer(context, outputs, torch.ones(outputs.shape).bool())
    assert torch.isfinite(found.covariance).all()
    assert found.identified[..., 1:3].all()
    torch.testing.assert_close(found.z[..., 1:3], z[..., 1:3], rtol=0, atol=0.005)


@pytest.mark.parametrize("operator", OPERATORS)
def test_units_of_a_twin_in_place_of_a_surrogate_do_not_matter(operator: type) -> None:
    """Without the unit that a surrogate has, outputs of different units weigh the same."""
    found, sizes = [], torch.tensor([1e-6, 1e6]).double()
    for twin in (Plane(), Plane((1e-6, 1e6))):
        context, _, outputs = measured(twin, commands_of(5))
        found.append(operator().infer(context, outputs, torch.ones(outputs.shape).bool()))
    one, other = (each.covariance.diagonal(dim1=-2, dim2=-1).sqrt() for each in found)
    if operator is rt.DelayOffset:
        other[..., 1:] /= sizes
    torch.testing.assert_close(other[..., :3], one[..., :3], rtol=0.35, atol=0)


@pytest.mark.slow
def test_outputs_that_never_change_identify_no_delay() -> None:
    context, _, outputs = measured(Plane(), commands_of(5))
    found = rt.CommandSpace().infer(context, 0 * outputs + 1, torch.ones(outputs.shape).bool())
    assert torch.isfinite(found.covariance).all()
    assert torch.isfinite(found.z).all()
    assert not found.identified[..., 0].any()


def test_outputs_that_never_follow_need_no_delay_beyond_the_trajectory() -> None:
    """Delays of single segments may then be anything, but an operator takes what it chose."""
    sampler = rt.twins.RampSampler((-1, -1), (1, 1), RATE, 8.0, segments=1)
    commands = sampler.sample(4, rng=np.random.default_rng(0))
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Plane(), commands, segments, rate=RATE)
    noise = torch.tensor(np.random.default_rng(0).normal(0, 0.005, context.nominal.shape))
    outputs, mask = context.nominal[:, :1] + noise, torch.ones(noise.shape).bool()
    made = rt.DelayOffset().completed(context, outputs, mask)
    assert np.abs(made.delay_range).max() <= 8.0
    assert made.completed(context, outputs, mask) == made


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
@pytest.mark.parametrize("operator", OPERATORS)
def test_intervals_of_rounded_outputs_cover(operator: type, noise: float) -> None:
    """At rest all samples are rounded the same way: many are no more certain than one."""
    commands, step, rng = commands_of(10), 0.05, np.random.default_rng(2)
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Plane(), commands, segments, rate=RATE)
    shape = segments.start.shape
    z = np.concatenate([rng.normal(4, 0.3, (*shape, 1)), rng.normal(0, 0.1, (*shape, 2))], axis=-1)
    if operator is rt.CommandSpace:
        z = np.concatenate([z, np.zeros((*shape, 2))], axis=-1)
    outputs = operator().apply(context, torch.tensor(z)).double()
    rounded = (
        step * ((outputs + noise * torch.tensor(rng.normal(size=outputs.shape))) / step).round()
    )
    found = operator().infer(context, rounded, torch.ones(outputs.shape).bool())
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    covered = (found.z - torch.tensor(z)).abs() <= 1.645 * deviation
    known = found.identified[..., 1:3]
    assert known.double().mean() > 0.9
    assert covered[..., 1:3][known].double().mean() > 0.8
    assert deviation[..., 1:3].max() < step, "no wider than what rounding leaves"


@pytest.mark.slow
def test_few_samples_do_not_pass_for_exact_ones() -> None:
    """With hardly more measured values than components of z, residuals are z's, not the noise."""
    context, z, outputs = measured(Plane(), commands_of(12), noise=0.02)
    covered, scales = [], []
    for every in (1, 20):
        mask = torch.zeros(outputs.shape).bool()
        mask[:, ::every] = True
        found = rt.CommandSpace().infer(context, outputs, mask)
        deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()[..., 1:3]
        covered.append(((found.z - z)[..., 1:3].abs() <= 1.645 * deviation).double().mean())
        scales.append(found.noise.mean())
    assert min(covered) > 0.8
    assert scales[1] > 0.8 * scales[0]


@pytest.mark.slow
def test_delays_that_no_output_shows_stay_within_their_range() -> None:
    """A machine that stands still: the common delay has no likelihood, but limits."""
    sampler = rt.twins.RampSampler((-1, -1), (1, 1), RATE, 8.0, segments=1)
    commands = sampler.sample(4, rng=np.random.default_rng(0))
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Plane(), commands, segments, rate=RATE)
    noise = torch.tensor(np.random.default_rng(0).normal(0, 0.005, context.nominal.shape))
    outputs = context.nominal[:, :1] + noise
    for limits in ((0.0, 0.2), None):
        operator = rt.CommandSpace(delay_range=limits)
        found = operator.infer(context, outputs, torch.ones(noise.shape).bool())
        width = RATE * (0.2 if limits else 16.0)
        assert torch.isfinite(found.z).all()
        assert found.covariance[..., 0, 0].sqrt().max() < width
        assert not found.identified[..., 0].any()


def delayed_and_offset(noise: float, seed: int) -> tuple[rt.Context, torch.Tensor, torch.Tensor]:
    """The context, z of `DelayOffset` and outputs; the first segment begins at the first sample."""
    commands, rng = commands_of(10, seed=seed), np.random.default_rng(seed)
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Plane(), commands, segments, rate=RATE)
    assert segments.start[:, 0].max() < 0.01
    shape = segments.start.shape
    z = np.concatenate([rng.normal(4, 0.3, (*shape, 1)), rng.normal(0, 0.03, (*shape, 2))], axis=-1)
    outputs = rt.DelayOffset().apply(context, torch.tensor(z)).double()
    return context, torch.tensor(z), outputs + noise * torch.tensor(rng.normal(size=outputs.shape))


@pytest.mark.parametrize("seed", range(3))
def test_intervals_of_exact_outputs_cover(seed: int) -> None:
    """Residuals are the rounding of single precision, and offsets are not as small as they are."""
    context, z, outputs = delayed_and_offset(0.0, seed)
    found = rt.DelayOffset().infer(context, outputs, torch.ones(outputs.shape).bool())
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    known = found.identified
    assert known.double().mean() > 0.9
    covered = (found.z - z).abs() <= 1.645 * deviation
    assert covered[known].double().mean() > 0.9
    assert (found.z - z)[known].abs().max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "share"), [(0.05, (0.8, 1.0)), (1.0, (0.0, 0.4)), (4.0, (0, 0))])
def test_delays_that_noise_could_have_made_are_not_identified(
    noise: float, share: tuple[float, float]
) -> None:
    """Offsets of noise are a step between any two segments, and a step has a place."""
    known, covered = [], []
    for seed in range(4):
        context, z, outputs = delayed_and_offset(noise, seed)
        found = rt.DelayOffset().infer(context, outputs, torch.ones(outputs.shape).bool())
        identified = found.identified[..., 0]
        inside = (found.z - z)[..., 0].abs() <= 1.645 * found.covariance[..., 0, 0].sqrt()
        known.append(identified.double().mean())
        covered.append(inside[identified])
    assert share[0] <= torch.stack(known).mean() <= share[1]
    # With 20 of 160 or more, 0.8 has a probability above 0.01 where 0.9 is true.
    if share[1]:
        assert torch.cat(covered).double().mean() >= 0.8


@pytest.mark.parametrize("walks", [False, True])
def test_the_mean_of_a_rest_errs_by_what_actuators_creep(walks: bool) -> None:
    """A walk of n steps of variance q ends away from its mean by a variance of q n / 3."""
    context, _, outputs = measured(Plane(), commands_of(100))
    mask = torch.ones(outputs.shape).bool()
    problem = CommandProblem.of(context, outputs, mask, delay_range=(0.0, 8.0), max_samples=400)
    rest = problem.inside * (problem.group == 0)[:, None]
    steps = torch.tensor(np.random.default_rng(5).normal(size=outputs.shape))
    residual, counts = torch.zeros_like(outputs), rest.sum(dim=-1)
    for i, m in counts.nonzero().tolist():
        inside = rest[i, m] > 0
        values = steps[i, inside].cumsum(dim=0) if walks else steps[i, inside]
        residual[i, inside] = values - values.mean(dim=0)
    scale = residual[rest.sum(dim=1) > 0].std(correction=0)
    noise = Noise(scale.expand(2, 1), torch.ones(2).double(), StudentT(1e6))
    count = counts[counts > 0].mean()
    error = noise.scale[0, 0] ** 2 * problem.creep(noise, residual) / count
    independent = scale**2 * (1 / count + COMMON_ERROR)
    np.testing.assert_allclose(error, count / 3 if walks else independent, rtol=0.25)


def test_replicates_count_once_where_they_err_alike() -> None:
    """A path between two levels is the same in all four of them, and so is the surrogate's error.

    Noise at rest is not. The surrogate's variance bounds what a segment, or all its
    replicates together, tell.
    """
    count, precision = [], []
    for copies in (1, 4):
        context, _, outputs = measured(Plane(), commands_of(5).repeat(copies, axis=0))
        mask = torch.ones(outputs.shape).bool()
        problem = CommandProblem.of(context, outputs, mask, delay_range=(0.0, 8.0), max_samples=400)
        noise = Noise(torch.ones(2, 1).double(), torch.ones(2).double(), StudentT(1e6))
        error = torch.full((*problem.valid.shape, 2), 1e4 * problem.unit.square().mean())
        unsure = CommandProblem.of(
            replace(context, surrogate_variance=error * problem.valid[..., None]),
            outputs,
            mask,
            delay_range=(0.0, 8.0),
            max_samples=400,
        )
        replicates = OffsetFeatures.of(problem).replicates(problem)
        assert (replicates[problem.valid] == copies).all()
        each = noise.count(problem.counted_once(replicates))
        count.append([float(each[problem.group == k].sum()) for k in (0, 1)])
        bounded = unsure.counted_once(replicates)
        total = noise.precision(bounded, torch.zeros_like(problem.observed))[..., 0]
        precision.append(float((problem.inside[:, 0] * total).sum()))
    np.testing.assert_allclose(np.divide(count[1], count[0]), [4.0, 1.0])
    np.testing.assert_allclose(precision[1] / precision[0], 1.0, rtol=0.01)
