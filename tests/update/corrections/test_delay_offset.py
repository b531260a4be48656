from __future__ import annotations

import numpy as np
import pytest
import torch

import retwin as rt
from retwin import catalog
from retwin.cases.armpi_fpv.twin import KINEMATIC
from retwin.serialisation.configs import from_config, to_config
from retwin.update.corrections.commands.path_problem import PathProblem
from retwin.update.kernels import generation

KINDS = catalog.classes(catalog.CORRECTIONS)

pytestmark = pytest.mark.numerical


def context_of(exact, commands: np.ndarray) -> rt.Context:
    return rt.Context.of(exact, commands, rt.Segments.from_commands(commands), rate=100.0)


@pytest.fixture(scope="module")
def context(exact, case: rt.Case) -> rt.Context:
    return context_of(exact, case.sampler.sample(40, rng=np.random.default_rng(0)))


@pytest.fixture(scope="module")
def z(context: rt.Context) -> torch.Tensor:
    rng = np.random.default_rng(1)
    delay = rng.gamma(4, 1.2, (40, 5, 1))
    offset = rng.normal(0, 0.005, (40, 5, 3))
    return torch.tensor(np.concatenate([delay, offset], axis=2)).float()


def everything(observed: torch.Tensor) -> torch.Tensor:
    return torch.ones(observed.shape, dtype=torch.bool)


def test_no_discrepancy_changes_nothing(context: rt.Context) -> None:
    same = rt.DelayOffset().apply(context, torch.zeros(40, 5, 4))
    torch.testing.assert_close(same, context.path, atol=1e-6, rtol=0)


def test_movements_come_late_and_end_off(context: rt.Context) -> None:
    """With one delay and one offset for all, the path is the shifted path plus the offset."""
    z = torch.zeros(40, 5, 4)
    z[..., 0] = 7.0
    z[..., 1:] = torch.tensor([0.01, -0.02, 0.03])
    corrected = rt.DelayOffset().apply(context, z)
    shift = torch.tensor([0.01, -0.02, 0.03])
    torch.testing.assert_close(
        corrected[:, 300:], context.path[:, 293:-7] + shift, atol=1e-5, rtol=0
    )
    torch.testing.assert_close(corrected[:, :7], context.path[:, :1].expand(-1, 7, -1))


@pytest.mark.parametrize("delay", [-5.0, 0.3, 12.0, 30.0])
def test_the_path_stays_continuous(context: rt.Context, delay: float) -> None:
    rng = np.random.default_rng(2)
    z = torch.tensor(rng.normal(0, [5, 0.02, 0.02, 0.02], (40, 5, 4))).float()
    z[..., 0] += delay
    step = rt.DelayOffset().apply(context, z).diff(dim=1).abs().max()
    # The nominal path's own steps, sped up at most by how far neighbouring delays squeeze it.
    assert step < 6 * context.path.diff(dim=1).abs().max()


def test_known_z_is_recovered_from_clean_outputs(context: rt.Context, z: torch.Tensor) -> None:
    operator = rt.DelayOffset()
    observed = operator.apply(context, z)
    found = operator.infer(context, observed, everything(observed))
    error = (found.z - z).abs()
    assert found.identified.float().mean() > 0.97
    assert error[..., 0][found.identified[..., 0]].mean() < 0.1
    assert error[..., 1:].mean() < 1e-5


def test_intervals_are_honest_under_noise(context: rt.Context, z: torch.Tensor) -> None:
    operator = rt.DelayOffset()
    noise = torch.tensor(np.random.default_rng(3).normal(0, 5e-4, (40, 1000, 3)))
    observed = operator.apply(context, z) + noise
    found = operator.infer(context, observed, everything(observed))
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    inside = ((found.z - z).abs() <= 1.96 * deviation).float().mean((0, 1))
    assert (inside > 0.9).all(), inside


def test_delays_of_fast_motions_between_samples_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a sample of a fast motion is more than ten standard deviations of the others' noise.

    With weights that vanish there, 2 to 4 % of the delays were wrong by samples, and which of them
    depended on the last digits of the path.
    """
    rng = np.random.default_rng(7)
    levels = rng.uniform(-1, 1, (30, 6, 1, 2))
    ramp = np.clip((np.arange(60) - 20) / 15, 0, 1)[:, None]
    steps = levels[:, :-1] + ramp * np.diff(levels, axis=1)
    commands = steps.reshape(30, -1, 2).astype(np.float32)
    surrogate = rt.Surrogate(
        rt.MLP(()),
        inputs=rt.Channels.numbered("u", 2),
        outputs=rt.Channels.numbered("y", 2),
        rate=100.0,
    ).eval()
    with torch.no_grad():
        surrogate.network[0].weight.copy_(torch.eye(2))
        surrogate.network[0].bias.fill_(0.0)
    context = context_of(surrogate, commands)
    z = torch.tensor(rng.normal([6, 0.05, 0.05], [1, 0.05, 0.05], (30, 5, 3)))
    noise = 0.002 * torch.tensor(rng.normal(size=context.path.shape))
    observed = rt.DelayOffset().apply(context, z) + noise
    found = rt.DelayOffset().infer(context, observed, everything(observed))
    assert float((found.z - z)[..., 0].abs().max()) < 0.3
    assert found.identified.all()
    # Without compiled kernels the last digits of the path are others.
    monkeypatch.setattr(generation, "library", lambda: None)
    again = rt.DelayOffset().infer(context_of(surrogate, commands), observed, everything(observed))
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert float(((again.z - found.z).abs() / deviation).max()) < 0.01


def test_the_jacobian_is_that_of_the_path_also_before_it_begins(context: rt.Context) -> None:
    """A first segment may begin at the first sample, before which the path is held."""
    rng, path, segments = np.random.default_rng(0), context.path[:3].double(), context.segments[:3]
    assert segments.start[:, 0].max() < 1e-3
    problem = PathProblem.of(segments, path, path, everything(path), (-5.0, 30.0))
    x = torch.tensor(rng.normal([4, 0.01, 0.01, 0.01], 0.01, (3, 5, 4))).flatten(1)
    jacobian = problem.linearised(x)[1]
    for column in range(x.shape[1]):
        step = torch.zeros_like(x)
        step[:, column] = 1e-6
        difference = (problem.residual(x - step) - problem.residual(x + step)) / 2e-6
        torch.testing.assert_close(jacobian[..., column], difference, rtol=1e-5, atol=1e-7)


def test_glitches_do_not_move_z(context: rt.Context, z: torch.Tensor) -> None:
    operator = rt.DelayOffset()
    rng = np.random.default_rng(4)
    clean = operator.apply(context, z) + torch.tensor(rng.normal(0, 2e-4, (40, 1000, 3)))
    spiked = clean.clone()
    for i, at in enumerate(rng.integers(20, 980, 40)):
        spiked[i, at - 10 : at + 10] += 0.3 * torch.hann_window(20)[:, None]
    before = operator.infer(context, clean, everything(clean)).z
    after = operator.infer(context, spiked, everything(spiked)).z
    assert (after - before)[..., 0].abs().median() < 0.05
    assert (after - before)[..., 1:].abs().quantile(0.99) < 2e-4


def test_missing_samples_do_not_count(context: rt.Context, z: torch.Tensor) -> None:
    operator = rt.DelayOffset()
    noise = torch.tensor(np.random.default_rng(5).normal(0, 2e-4, (40, 1000, 3)))
    observed = operator.apply(context, z) + noise
    mask = everything(observed)
    mask[:, 400:600] = False
    broken = torch.where(mask, observed, 99.0)
    found = operator.infer(context, broken, mask)
    others = [0, 1, 3, 4]
    assert (found.z - z)[:, others, 1:].abs().mean() < 5e-5
    assert not found.identified[:, 2, 0].any(), "nothing of the third movement was seen"


def test_a_movement_too_small_to_time_is_told(exact, case: rt.Case) -> None:
    commands = np.full((1, 400, 4), 500.0, dtype=np.float32)
    commands[0, :, 1] += np.clip(np.arange(400) - 50, 0, 60)
    commands[0, :, 1] += 0.02 * np.clip(np.arange(400) - 250, 0, 60)
    context = context_of(exact, commands)
    noise = torch.tensor(np.random.default_rng(0).normal(0, 1e-3, (1, 400, 3)))
    found = rt.DelayOffset().infer(context, context.path + noise, everything(noise))
    assert found.identified[0, :, 0].tolist() == [True, False]


def test_emulated_robot_is_understood(exact, case: rt.Case) -> None:
    """Delay MAE <= 1 sample, offset MAE <= 0.5 mm where no joint missed a movement."""
    commands = case.sampler.sample(60, rng=np.random.default_rng(11))
    hidden: dict[str, np.ndarray] = {}
    healthy = case.emulator.simulate(commands, seed=11, hidden=hidden)
    context = context_of(exact, healthy.commands)
    found = rt.DelayOffset().infer(
        context, torch.tensor(healthy.observed), torch.tensor(healthy.mask)
    )
    parts = context.segments
    each = np.arange(60)[:, None]
    targets = commands[each, np.ceil(parts.settle).astype(int)].astype(float)
    reached = hidden["angles"][each, np.ceil(parts.stop).astype(int) - 1]
    offset = KINEMATIC.position(reached) - KINEMATIC.position(targets)
    # On top of a movement's delay comes the servo's own, about two samples.
    delay = 100 * (hidden["delay"] + KINEMATIC.lag.seconds)
    missed = hidden["missed"].any(axis=2)
    beside = missed.copy()
    beside[:, 1:] |= missed[:, :-1]
    good = ~beside & parts.valid
    assert good.mean() > 0.8
    z = found.z.numpy()
    timed = good & found.identified[..., 0].numpy()
    assert np.abs(z[..., 0] - delay)[timed].mean() <= 1.0
    assert np.abs(z[..., 1:] - offset)[good].mean() <= 5e-4


def test_apply_is_differentiable(context: rt.Context) -> None:
    z = torch.full((40, 5, 4), 0.5, requires_grad=True)
    rt.DelayOffset().apply(context, z).square().sum().backward()
    assert torch.isfinite(z.grad).all()
    assert (z.grad != 0).any(dim=0).all()


def test_names_units_and_config() -> None:
    operator = rt.DelayOffset()
    plane = rt.Channels(("x", "y"), ("m", "m"))
    latent = operator.latent(rt.Channels(("u",), ("V",)), plane)
    assert latent.names == ("delay", "offset_x", "offset_y")
    assert latent.units == ("samples", "m", "m")
    assert from_config(to_config(operator, KINDS), KINDS) == operator
    assert isinstance(operator, rt.Correction)


def test_what_is_drawn_for_movements_that_do_not_exist_is_not_applied(exact) -> None:
    """Trajectories have different numbers of movements; z has room for the most."""
    ramp = np.clip(np.arange(200) - 20, 0, 60)
    second = np.clip(np.arange(200) - 120, 0, 40)
    commands = np.full((3, 200, 4), 500.0)
    commands[..., 1] += np.stack([ramp + second, ramp, 0 * ramp])
    context = context_of(exact, commands)
    z = torch.zeros(3, 2, 4)
    z[:2, 0] = torch.tensor([4.0, 0.01, 0.0, -0.01])
    wild = z.clone()
    wild[1, 1], wild[2] = -9.0, 9.0
    operator = rt.DelayOffset()
    torch.testing.assert_close(operator.apply(context, wild), operator.apply(context, z))
    torch.testing.assert_close(operator.apply(context, wild)[2], context.path[2])


def test_single_channels_may_be_missing(context: rt.Context, z: torch.Tensor) -> None:
    """Half of all channels at random: few samples are whole, yet z is found as before."""
    operator = rt.DelayOffset()
    noise = torch.tensor(np.random.default_rng(5).normal(0, 2e-4, (40, 1000, 3)))
    observed = operator.apply(context, z) + noise
    mask = torch.tensor(np.random.default_rng(6).random((40, 1000, 3)) < 0.5)
    found = operator.infer(context, torch.where(mask, observed, 99.0), mask)
    assert (found.z - z)[..., 1:].abs().mean() < 5e-5
    assert (found.z - z)[..., 0].abs().median() < 0.2


def test_no_movement_no_correction(exact) -> None:
    context = context_of(exact, np.full((2, 50, 4), 400.0))
    operator = rt.DelayOffset()
    assert torch.equal(operator.apply(context, torch.zeros(2, 0, 4)), context.path)
    found = operator.infer(context, context.path, everything(context.path))
    assert found.z.shape == (2, 0, 4)
