"""`CommandSpace`: what z does to commands, and z from outputs alone where the truth is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

import retwin as rt
from retwin import catalog
from retwin.cases.armpi_fpv.emulator import _effective
from retwin.cases.armpi_fpv.twin import KINEMATIC, RATE, SENSOR_RATE
from retwin.errors import InputError
from retwin.serialisation.configs import from_config, to_config
from retwin.twins.faults.applied_faults import draw_faults, faulty_commands, frozen_from
from retwin.update.corrections.commands.effective_commands import effective_commands
from retwin.update.corrections.commands.offset_features import FIRST_OFFSET, OffsetFeatures
from retwin.update.corrections.commands.problem import CommandProblem

POLL = round(RATE / SENSOR_RATE)

pytestmark = pytest.mark.numerical

KINDS = catalog.classes(catalog.CORRECTIONS)

UNIT = 0.24  # degrees per command unit


def context_of(exact, commands: np.ndarray, faults: list | None = None) -> rt.Context:
    segments = rt.Segments.from_commands(commands)
    if faults is None:
        return rt.Context.of(exact, commands, segments, rate=100.0)
    drawn = draw_faults(faults, segments, 0, rate=RATE)
    faulty = faulty_commands(commands, drawn, segments, rate=RATE)
    frozen = frozen_from(drawn, *commands.shape[1:], rate=RATE)
    return rt.Context.of(
        exact, commands, segments, rate=100.0, faulty_commands=faulty, frozen=frozen
    )


def polled(n: int, steps: int = 1000) -> Tensor:
    """True where the arm was read: between readings there is nothing new."""
    mask = torch.zeros(n, steps, 3, dtype=torch.bool)
    mask[:, ::POLL] = True
    return mask


@pytest.fixture(scope="module")
def commands(case: rt.Case) -> np.ndarray:
    return case.sampler.sample(12, rng=np.random.default_rng(4))


def drawn(shape: tuple[int, int], *, missed: float = 0.05, seed: int = 0) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.tensor(
        np.concatenate(
            [
                rng.gamma(6, 0.8, (*shape, 1)),
                4 * rng.normal(size=(*shape, 4)),
                rng.random((*shape, 4)) < missed,
            ],
            axis=2,
        )
    )


def test_it_does_what_the_emulated_arm_does(commands: np.ndarray) -> None:
    """Against the emulator's own loop over segments, written apart."""
    segments = rt.Segments.from_commands(commands)
    z = drawn(segments.start.shape, missed=0.2)
    when = torch.arange(1000.0, dtype=torch.float64)
    effective = effective_commands(torch.tensor(commands, dtype=torch.float64), segments, z, when)
    parts = z.numpy()
    truth = {"delay": parts[..., 0], "offset": parts[..., 1:5], "missed": parts[..., 5:] > 0}
    np.testing.assert_allclose(effective.numpy(), _effective(commands, segments, truth), atol=1e-3)


def test_a_missed_movement_is_caught_up_with_the_next(exact) -> None:
    commands = np.full((1, 600, 4), 500.0)
    commands[0, :, 1] += 2 * np.clip(np.arange(600) - 50, 0, 60)
    commands[0, :, 1] += np.clip(np.arange(600) - 350, 0, 60)
    z = torch.zeros(1, 2, 9, dtype=torch.float64)
    z[0, 0, 5 + 1] = 1.0
    when = torch.tensor([0.0, 100, 300, 380, 500], dtype=torch.float64)
    segments = rt.Segments.from_commands(commands)
    effective = effective_commands(torch.tensor(commands), segments, z, when)
    np.testing.assert_allclose(effective[0, :, 1], [500, 500, 500, 590, 680], atol=1e-6)
    assert (effective[0, :, [0, 2, 3]] == 500).all()


def test_a_stuck_actuator_stays_where_z_had_brought_it(exact, commands: np.ndarray) -> None:
    context = context_of(exact, commands, [rt.Stuck(1)] * 12)
    z = drawn(context.segments.start.shape, missed=0.0)
    path = rt.CommandSpace().apply(context, z)
    never = replace(context, frozen=torch.full_like(context.frozen, 1000))
    free = rt.CommandSpace().apply(never, z)
    torch.testing.assert_close(path[:, :50], free[:, :50])
    assert (path[:, 200:] - free[:, 200:]).norm(dim=-1).max() > 0.02


@pytest.mark.parametrize("memoryless", [True, False])
def test_some_samples_are_those_of_the_whole(exact, commands: np.ndarray, memoryless: bool) -> None:
    """Also of a surrogate that depends on all earlier commands."""

    class Twin:
        asked = 0

        def __call__(self, commands: Tensor) -> Tensor:
            return exact(commands) if memoryless else exact(commands).cumsum(dim=1)

        def predict(self, commands: np.ndarray) -> np.ndarray:
            self.asked += 1
            return self(torch.tensor(commands)).numpy()

    twin = Twin()
    twin.memoryless = memoryless  # type: ignore[attr-defined]
    context = context_of(twin, commands, [rt.Stuck(1), rt.ActuatorBias(2, (10.0, 50.0)), None] * 4)
    z = drawn(context.segments.start.shape)
    when = torch.randint(1000, (12, 30), generator=torch.Generator().manual_seed(0))
    some = rt.CommandSpace().at(context, z, when)
    whole = rt.CommandSpace().apply(context, z)
    torch.testing.assert_close(some, whole[torch.arange(12)[:, None], when])
    assert twin.asked == 1, "nobody asked what the outputs would be without z"


def joint_delay(angles: np.ndarray, commands: np.ndarray, segments: rt.Segments) -> np.ndarray:
    """Delay of the joints, (n, M) in samples, measured on themselves; NaN where none moved.

    A joint's delay is the area between the shares of its way that were commanded and covered;
    joints count by the square of their way, as in least squares.
    """
    delay = np.full(segments.start.shape, np.nan)
    for i, m in np.argwhere(segments.valid):
        begin, stop = int(segments.start[i, m]), int(np.ceil(segments.stop[i, m]))
        path, command = angles[i, begin:stop], commands[i, begin:stop].astype(float)
        way, meant = path[-1] - path[0], command[-1] - command[0]
        moved = np.minimum(np.abs(way), np.abs(meant)) > 20
        if moved.any():
            behind = ((command - command[0])[:, moved] / meant[moved]).sum(axis=0)
            behind -= ((path - path[0])[:, moved] / way[moved]).sum(axis=0)
            delay[i, m] = np.average(behind, weights=way[moved] ** 2)
    return delay


def test_the_ruler_of_delays_is_straight(case: rt.Case, commands: np.ndarray) -> None:
    """Where servos have neither dead zone nor play, joints are delayed as was drawn."""
    hidden: dict[str, np.ndarray] = {}
    tight = replace(case.emulator, dead_zone=0.0, backlash=0.0, missed=0.0)
    tight.simulate(commands, seed=3, hidden=hidden)
    delay = joint_delay(hidden["angles"], commands, rt.Segments.from_commands(commands))
    drawn_delay = RATE * (hidden["delay"] + KINEMATIC.lag.seconds)
    np.testing.assert_allclose(delay, drawn_delay, atol=0.05)


@pytest.fixture(scope="module", params=[0.0, 0.5], ids=["random", "repeating"])
def understood(exact, case: rt.Case, request: pytest.FixtureRequest) -> dict[str, np.ndarray]:
    """z* of 100 emulated trajectories beside the truth; offsets may repeat with the pose."""
    commands = case.sampler.sample(100, rng=np.random.default_rng(11))
    hidden: dict[str, np.ndarray] = {}
    robot = replace(case.emulator, repeatable=request.param)
    made = robot.simulate(commands, seed=3, hidden=hidden)
    context = context_of(exact, commands)
    observed = torch.as_tensor(made.observed.copy())
    found = rt.CommandSpace().infer(context, observed, polled(100))
    each, segments = np.arange(100)[:, None], context.segments
    reached = hidden["angles"][each, np.ceil(segments.stop).astype(int) - 1]
    targets = commands[each, np.ceil(segments.settle).astype(int).clip(max=999)]
    z = found.z.numpy()
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt().numpy()
    good = ~hidden["missed"] & (z[..., 5:] < 0.5)
    whole, error = good.all(axis=-1), z[..., 1:5] - (reached - targets)
    covariance = found.covariance[..., 1:5, 1:5].numpy()[whole]
    scaled = np.linalg.solve(covariance, error[whole][..., None])[..., 0]
    return {
        "squared distance": (error[whole] * scaled).sum(axis=-1),
        "missed": hidden["missed"],
        "found": z[..., 5:] > 0.5,
        "offset error": error[good],
        "offset": (reached - targets)[good],
        "offset deviation": deviation[..., 1:5][good],
        "delay error": z[..., 0] - joint_delay(hidden["angles"], commands, segments),
        "delay": RATE * hidden["delay"],
        "delay deviation": deviation[..., 0],
    }


@pytest.mark.slow
def test_emulated_arm_is_understood_from_outputs_alone(understood: dict) -> None:
    """Offsets within 0.25 degrees, delays within 0.3 samples, missed movements found."""
    assert UNIT * np.abs(understood["offset error"]).mean() <= 0.25
    assert UNIT * np.abs(understood["offset"]).mean() > 0.7, "what knowing nothing would give"
    assert np.abs(understood["delay error"]).mean() <= 0.3
    truth, found = understood["missed"], understood["found"]
    assert 2 * (truth & found).sum() / (truth.sum() + found.sum()) >= 0.95


@pytest.mark.slow
def test_intervals_of_offsets_cover(understood: dict) -> None:
    """Nine in ten true offsets lie in their 90 % intervals."""
    inside = np.abs(understood["offset error"]) < 1.645 * understood["offset deviation"]
    assert 0.85 <= inside.mean() <= 0.95


@pytest.mark.slow
def test_regions_of_all_offsets_of_a_segment_cover(understood: dict) -> None:
    """Nine in ten times the offsets of all joints together lie in their 90 % ellipsoid."""
    inside = understood["squared distance"] < chi2.ppf(0.9, df=4)
    assert 0.85 <= inside.mean() <= 0.95


@pytest.mark.slow
def test_intervals_of_delays_cover(understood: dict) -> None:
    """Nine in ten delays lie in their 90 % intervals, and these say more than the prior."""
    inside = np.abs(understood["delay error"]) < 1.645 * understood["delay deviation"]
    assert 0.85 <= inside.mean() <= 0.95
    assert understood["delay deviation"].mean() < 0.5 * understood["delay"].std()


@pytest.mark.slow
def test_what_the_outputs_do_not_tell_is_said(exact, commands: np.ndarray) -> None:
    """Three outputs, four joints: not all offsets of the planar joints can be known."""
    context = context_of(exact, commands)
    z = drawn(context.segments.start.shape, missed=0.0)
    noise = torch.tensor(np.random.default_rng(1).normal(0, 5e-4, context.path.shape))
    observed = rt.CommandSpace().apply(context, z).double() + noise
    found = rt.CommandSpace().infer(context, observed, polled(12))
    share = found.identified[..., 1:5].double().mean(dim=(0, 1))
    assert share[0] > 0.95, "the yaw is seen, but where the record ends with the motion"
    assert share[1:].min() < 1.0, "one of the others is not, somewhere"
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    # Near its own axis the tip hardly shows the yaw: of some segments alone.
    assert deviation[..., 4].median() > 3 * deviation[..., 1].median()


@pytest.mark.slow
def test_a_fault_does_not_pass_for_a_discrepancy(exact, commands: np.ndarray) -> None:
    """The bias of a faulty motor is its severity, and leaves the offsets alone."""
    faults = [rt.ActuatorBias(0, bias=(30.0, -20.0, 40.0, -35.0, 25.0)), *[None] * 11]
    truth = context_of(exact, commands, faults)
    z = drawn(truth.segments.start.shape, missed=0.0)
    observed = rt.CommandSpace().apply(truth, z).double()
    # The class is known, its severity is not: any bias on motor 1 stands for it.
    guess = [rt.ActuatorBias(0, bias=(1.0,) * 5), *[None] * 11]
    found = rt.CommandSpace().infer(context_of(exact, commands, guess), observed, polled(12))
    assert found.severity is not None
    bias = found.severity[0, :, 0].numpy() + 1.0 - z[0, :, 1].numpy()
    np.testing.assert_allclose(bias, [30.0, -20.0, 40.0, -35.0, 25.0], atol=3.0)
    # Outputs cannot separate the discrepancy from the fault: the prior stands.
    width = found.covariance[0, :, 1, 1].sqrt()
    assert (width > 0.5 * z[1:, :, 1].std()).all()
    assert (found.z[0, :, 1].abs() < 2 * width).all()
    assert not found.identified[0, :, 1].any()
    assert (found.severity[1:] == 0).all()
    error = (found.z - z)[..., 1:5]
    assert error[0, :, 1:].abs().mean() < 2 * error[1:, :, 1:].abs().mean()


@pytest.mark.slow
def test_a_surrogate_with_memory_gives_the_same(exact, commands: np.ndarray) -> None:
    class Remembering:
        def __call__(self, values: Tensor) -> Tensor:
            return exact(values)

        predict = staticmethod(exact.predict)

    half = commands[:4, :500]
    plain = context_of(exact, half)
    z = drawn(plain.segments.start.shape, missed=0.0)
    measured = rt.CommandSpace().apply(plain, z).double(), polled(4, 500)
    one = rt.CommandSpace().infer(plain, *measured)
    other = rt.CommandSpace().infer(replace(plain, surrogate=Remembering()), *measured)
    assert (one.z - other.z)[..., 1:5].abs().mean() < 0.2
    assert (one.z - other.z)[..., 0].abs().mean() < 0.1
    spread = [found.covariance[..., 0, 0].sqrt() for found in (one, other)]
    torch.testing.assert_close(spread[0], spread[1], rtol=0.1, atol=0.02)


PERIOD, SHIFT = 6, 3
"""Polling period and the second polling phase, in samples. There are 167 polls of 1000 samples, so
that only two phases together exceed `CommandSpace.max_samples`."""


@pytest.fixture(scope="module")
def two_phases(exact, commands: np.ndarray) -> tuple[rt.Context, Tensor, Tensor]:
    """Six trajectories polled at phase 0, then the same ones later by `SHIFT`, polled as late."""
    first = context_of(exact, commands[:6])
    z = drawn(first.segments.start.shape, missed=0.0)
    noise = np.random.default_rng(1).normal(0, 5e-4, first.path.shape)
    early = rt.CommandSpace().apply(first, z).double().numpy() + noise
    both, observed = (
        np.concatenate([a, np.concatenate([a[:, :1].repeat(SHIFT, 1), a[:, :-SHIFT]], axis=1)])
        for a in (commands[:6], early)
    )
    mask = torch.zeros(12, 1000, 3, dtype=torch.bool)
    mask[:6, :990:PERIOD] = True
    mask[6:, SHIFT : 990 + SHIFT : PERIOD] = True
    return context_of(exact, both), torch.tensor(observed), mask


@pytest.mark.parametrize("max_samples", [200, 50])
def test_polling_phases_do_not_compete_for_samples(
    two_phases: tuple[rt.Context, Tensor, Tensor], max_samples: int
) -> None:
    """Of a batch, each trajectory contributes the very samples that it contributes alone."""
    context, observed, mask = two_phases
    settings = {"delay_range": (-5.0, 30.0), "max_samples": max_samples}
    batch = CommandProblem.of(context, observed, mask, **settings)
    assert (batch.measured.sum(dim=1) <= max_samples).all()
    for i in range(12):
        one = slice(i, i + 1)
        alone = CommandProblem.of(context[one], observed[one], mask[one], **settings)
        used = batch.sample[i, batch.measured[i] > 0]
        assert len(used) > max_samples / 2
        assert used.equal(alone.sample[0])
        assert mask[i, used].all()


@pytest.mark.slow
@pytest.mark.parametrize("max_samples", [200, 50])
def test_the_polling_phase_does_not_change_z(
    two_phases: tuple[rt.Context, Tensor, Tensor], max_samples: int
) -> None:
    """The same trajectory, earlier or later, has the same z*; so it has with one phase only.

    A batch with everything twice has replicates of all conditions, with the same noise, which no
    replicate has: the prior and the noise that it shows are a little different.
    """
    context, observed, mask = two_phases
    operator = rt.CommandSpace(max_samples=max_samples)
    both = operator.infer(context, observed, mask)
    torch.testing.assert_close(both.z[6:], both.z[:6], rtol=0, atol=1e-3)
    early, late = (
        operator.infer(context[half], observed[half], mask[half]).z
        for half in (slice(0, 6), slice(6, 12))
    )
    torch.testing.assert_close(late, early, rtol=0, atol=1e-3)
    difference = (both.z[:6] - early).abs()
    assert difference[..., 0].mean() < 0.1
    deviation = both.covariance[:6].diagonal(dim1=-2, dim2=-1).sqrt()
    assert difference[..., 1:5].mean() < 0.25 * deviation[..., 1:5].mean()


def test_rows_with_fewer_samples_are_not_filled_with_evidence(exact, commands: np.ndarray) -> None:
    """A short record in a batch of long ones counts each of its samples once."""
    context = context_of(exact, commands[:2])
    mask = polled(2)
    mask[1, 300:] = False
    observed = context.path.double()
    batch = CommandProblem.of(context, observed, mask, delay_range=(-5.0, 30.0), max_samples=200)
    assert batch.measured.sum(dim=1).tolist() == [100, 30]
    assert batch.sample[1, :30].tolist() == list(range(0, 300, POLL))
    assert (batch.sample[1, 30:] == 290).all()
    assert (batch.inside[1, :, 30:] == 0).all()


@pytest.mark.parametrize("split", [False, True])
def test_a_trajectory_without_a_usable_sample_is_named(
    exact, commands: np.ndarray, split: bool
) -> None:
    """Without any measurement, or with outputs that are never measured at the same sample."""
    context = context_of(exact, commands)
    mask = polled(12)
    mask[7] = False
    if split:
        mask[7, ::10, 0], mask[7, 5::10, 1:] = True, True
    with pytest.raises(InputError, match=r"^mask: .*all outputs.* trajectory 7; leave it out"):
        rt.CommandSpace().infer(context, context.path.double(), mask)
    mask[9] = False
    with pytest.raises(InputError, match="trajectories 7, 9; leave them out"):
        rt.CommandSpace().infer(context, context.path.double(), mask)


@pytest.mark.parametrize(
    ("units", "pooled"), [(("deg",) * 4, [0, 1, 2, 3]), (("deg", "m", "deg", "1"), [0, 2])]
)
def test_offsets_of_actuators_of_one_unit_are_expected_to_be_alike(
    exact, commands: np.ndarray, units: tuple[str, ...], pooled: list[int]
) -> None:
    """An actuator that a program hardly moves is not expected to be more exact than others."""
    sent = commands.copy()
    sent[..., 2] = 500.0 + 0.1 * (sent[..., 2] - 500.0)
    context = context_of(exact, sent)
    arm = SimpleNamespace(inputs=rt.Channels(KINEMATIC.inputs.names, units), memoryless=True)
    problem = CommandProblem.of(
        context,
        context.nominal,
        polled(len(sent)),
        delay_range=(0.0, 20.0),
        max_samples=100,
    )
    own = OffsetFeatures.of(replace(problem, surrogate=arm))
    expected = own.spread.clone()
    expected[pooled] = own.spread[pooled].square().mean().sqrt()
    assert own.spread[2] < 0.2 * own.spread[1]
    torch.testing.assert_close(own.unit, FIRST_OFFSET * expected)


def test_names_units_and_config() -> None:
    operator = rt.CommandSpace()
    inputs, outputs = rt.Channels(("a", "b"), ("V", "A")), rt.Channels(("x",), ("m",))
    latent = operator.latent(inputs, outputs)
    assert latent.names == ("delay", "offset_a", "offset_b", "missed_a", "missed_b")
    assert latent.units == ("samples", "V", "A", "1", "1")
    assert [head.kind for head in operator.heads(inputs, outputs)] == [
        "mixture",
        "mixture",
        "bernoulli",
    ]
    assert from_config(to_config(operator, KINDS), KINDS) == operator
    assert isinstance(operator, rt.Correction)
