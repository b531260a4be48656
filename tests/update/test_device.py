"""Records that are made on a torch device are those of `CorrectedTwin.simulate`.

Here the device is the processor. What would not be on another device is found by a tensor that is
made without one: in one test it has no data, and cannot be joined with those of the device.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode

import retwin as rt
from retwin.nets.networks import LSTM
from retwin.twins.commands.ramps import ramps_and_holds
from retwin.twins.commands.range import CommandRange
from retwin.twins.faults.actuator_faults import ActuatorBias, Fault, Stuck
from retwin.twins.faults.system_faults import ActuatorGain, SensorBias
from retwin.update import Additive, DeviceTwin, OutsideTrainingWarning, SequenceResidual
from retwin.update import device as made_on
from retwin.update.kernels import generation
from retwin.update.residual import Density

STEPS, INPUTS, OUTPUTS = 260, 3, 2
RATE = 100.0
UNIT = torch.tensor([0.1, 4.0])
SENSOR = rt.SampledSensor(
    period=0.1,
    phases=(0.0, 0.03),
    noise=((-0.001, 0.0, 0.002), (-0.02, 0.0, 0.02)),
    glitch_probability=0.01,
    glitch_size=(0.1, 3.0),
)
FAULTS: tuple[Fault | None, ...] = (
    None,
    Stuck(0, 1.2),
    ActuatorBias(1, (0.2, 0.4)),
    ActuatorGain(actuator=2, size=-0.3, onset=0.8),
    SensorBias(output=1, size=2.0, onset=1.0),
)


def commands_of(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    onsets = np.array([20.3, 95.0, 170.7]) + rng.uniform(0, 9, size=(count, 3))
    levels, spans = rng.normal(size=(count, 3, INPUTS)), rng.choice([8.0, 21.0, 33.0], (count, 3))
    start = rng.normal(size=(count, INPUTS))
    spans = spans[..., None].repeat(INPUTS, axis=2)
    return ramps_and_holds(start, levels, spans, onsets, STEPS, dtype=np.float32)


def surrogate_of(network: Any) -> rt.Surrogate:
    channels = rt.Channels.numbered("u", INPUTS), rt.Channels.numbered("y", OUTPUTS)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = rt.Surrogate(network, inputs=channels[0], outputs=channels[1], rate=RATE)
    made.after.mean.copy_(torch.tensor([0.3, -2.0]))
    made.after.scale.copy_(UNIT)
    return made.eval()


def segmentwise(correction: Any, density: Density, degrees: float = np.inf) -> rt.ResidualModel:
    """A residual model with random weights, delays of some samples, and all that it can have."""
    surrogate = surrogate_of(rt.MLP((8,)))
    with torch.random.fork_rng():
        torch.manual_seed(1)
        made = rt.ResidualModel(
            correction, density, inputs=surrogate.inputs, outputs=surrogate.outputs
        )
    made.bounds.fill_(20.0)
    made.scale.copy_(torch.linspace(2.0, 0.1, len(made.latent)))
    made.persistence.fill_(0.3)
    made.spread.fill_(1.2)
    made.degrees = [degrees] * len(made.sizes)
    return made.eval()


def samplewise() -> SequenceResidual:
    surrogate = surrogate_of(rt.MLP((8,)))
    density = rt.SequenceMixture(network=LSTM(8), members=2)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        made = SequenceResidual(
            Additive(), density, inputs=surrogate.inputs, outputs=surrogate.outputs
        )
    made.persistence.fill_(0.7)
    made.bounds.fill_(5.0)
    return made.eval()


WAYS: dict[str, Callable[[], rt.CorrectedTwin]] = {
    "command space, sensor": lambda: rt.CorrectedTwin(
        surrogate_of(rt.MLP((16, 16))),
        segmentwise(rt.Chain(rt.CommandSpace(), SENSOR), rt.Mixture()),
    ),
    "command space, memory": lambda: rt.CorrectedTwin(
        surrogate_of(LSTM(8)), segmentwise(rt.Chain(rt.CommandSpace(), SENSOR), rt.Mixture(), 4.0)
    ),
    "outputs": lambda: rt.CorrectedTwin(
        surrogate_of(rt.MLP((16, 16))), segmentwise(rt.DelayOffset(), rt.Mixture(), 4.0)
    ),
    "flow": lambda: rt.CorrectedTwin(
        surrogate_of(rt.MLP((16, 16))), segmentwise(rt.Chain(rt.DelayOffset(), SENSOR), rt.Flow())
    ),
    "chain": lambda: rt.CorrectedTwin(
        surrogate_of(rt.MLP((16, 16))),
        segmentwise(rt.Chain(rt.CommandSpace(), rt.DelayOffset()), rt.Mixture()),
    ),
    "each sample": lambda: rt.CorrectedTwin(surrogate_of(rt.MLP((16, 16))), samplewise()),
    "mean": lambda: rt.CorrectedTwin(
        surrogate_of(rt.MLP((16, 16))),
        segmentwise(rt.DelayOffset(), rt.Mixture()),
        random=False,
    ),
}


class NoData(TorchFunctionMode):
    """Tensors that are made without a device are on "meta", which has no data."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        made = func in CONSTRUCTORS and not (args and isinstance(args[0], torch.Tensor))
        return func(*args, **({"device": "meta"} if made else {}) | (kwargs or {}))


CONSTRUCTORS = {
    *(torch.arange, torch.empty, torch.full, torch.hann_window, torch.linspace, torch.ones),
    *(torch.rand, torch.randint, torch.randn, torch.tensor, torch.tril_indices, torch.zeros),
    torch.as_tensor,
}


@pytest.mark.parametrize("way", WAYS)
def test_records_are_those_of_simulate(way: str) -> None:
    twin, commands = WAYS[way](), commands_of(150)
    faults = [FAULTS[i % len(FAULTS)] for i in range(150)]
    expected = twin.simulate(commands, faults=faults, seed=3)
    found = DeviceTwin(twin, "cpu").records(commands, faults=faults, seed=3, chunk=128)
    for made, reference in zip(found, (expected.nominal, expected.observed), strict=True):
        assert made.dtype == torch.float32
        # The splines of a flow, and a slope, enlarge what rounding does.
        assert np.max(np.abs(made.numpy() - reference) / UNIT.numpy()) < 1e-4


@pytest.mark.parametrize("way", WAYS)
def test_every_tensor_is_made_on_the_device(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    twin = DeviceTwin(WAYS[way](), "cpu")
    commands, faults = torch.from_numpy(commands_of(6)), [*FAULTS, None]
    monkeypatch.setattr(generation, "library", lambda: None)  # they serve the processor alone
    expected = twin.records(commands, faults=faults, seed=3)
    with NoData():
        found = twin.records(commands, faults=faults, seed=3)
    for one, other in zip(expected, found, strict=True):
        assert torch.equal(one, other)


def test_the_same_seed_and_chunk_give_the_same_records() -> None:
    twin, commands = DeviceTwin(WAYS["outputs"](), "cpu"), commands_of(20)
    one, same = (twin.records(commands, seed=1).observed for _ in range(2))
    assert torch.equal(one, same)
    assert not torch.equal(one, twin.records(commands, seed=2).observed)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("way", WAYS)
def test_records_of_a_gpu_have_the_same_mean(way: str) -> None:
    twin = WAYS[way]()
    commands = commands_of(1).repeat(2000, axis=0)
    found = DeviceTwin(twin, "cuda").records(commands, seed=0)
    reference = twin.simulate(commands, seed=1)
    assert found.observed.is_cuda
    np.testing.assert_allclose(found.nominal.cpu(), reference.nominal, atol=1e-4)
    draws = found.observed.cpu().numpy(), reference.observed
    error = np.abs(draws[0].mean(axis=0) - draws[1].mean(axis=0))
    standard = np.sqrt((draws[0].var(axis=0) + draws[1].var(axis=0)) / 2000)
    assert np.quantile(error / (standard + 1e-5), 0.99) < 4


@pytest.mark.parametrize("kind", ["ramps", "shaken", "still"])
def test_segments_are_those_of_the_processor(kind: str) -> None:
    commands = commands_of(40)
    if kind == "shaken":
        commands += np.random.default_rng(1).normal(size=commands.shape).astype(np.float32)
    if kind == "still":
        commands = np.zeros_like(commands)
    expected, found = (
        rt.Segments.from_commands(commands),
        made_on.segments_of(torch.from_numpy(commands)),
    )
    for name in ("start", "settle", "stop", "valid"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_the_range_of_commands_is_found_on_the_device() -> None:
    training, others = commands_of(200), commands_of(60, seed=9)
    trained = CommandRange.of(training, RATE)
    time = np.arange(STEPS)[:, None] / RATE
    judged = []
    for factor in (0.5, 1.0, 1.5, 4.0):
        for shake in (0.0, 0.3):
            for i in range(0, 60, 6):
                some = factor * others[i : i + 6] + shake * np.sin(250 * time).astype(np.float32)
                expected = bool((trained.scores(some, RATE) > 1).any())
                found = made_on.may_be_outside(trained, torch.from_numpy(some), RATE)
                assert found == expected
                judged.append(found)
    assert 0.1 < np.mean(judged) < 0.9


def test_commands_outside_the_training_range_are_a_warning() -> None:
    twin = WAYS["outputs"]()
    training = commands_of(100)
    assert isinstance(twin.surrogate, rt.Surrogate)
    twin.surrogate.trained = CommandRange.of(training, RATE)
    made = DeviceTwin(twin, "cpu")
    made.records(training, seed=0)
    with pytest.warns(OutsideTrainingWarning, match="u1 is .* in 3 of 3"):
        made.records(training[:3] + 10, seed=0)


def test_what_cannot_be_simulated_is_refused() -> None:
    twin = WAYS["outputs"]()
    for device in ("nowhere", "meta", None):
        with pytest.raises(rt.InputError, match=rf"device: expected a device .* got {device}"):
            DeviceTwin(twin, device)  # type: ignore[arg-type]
    with pytest.raises(rt.InputError, match=r"twin: .*CorrectedTwin"):
        DeviceTwin(twin.surrogate, "cpu")  # type: ignore[arg-type]
    made, commands = DeviceTwin(twin, "cpu"), commands_of(2)
    wrong = torch.from_numpy(commands.copy())
    wrong[1, 5] = torch.nan
    for given in (
        wrong,
        wrong.numpy(),
        commands[..., :2],
        torch.zeros(2, 9, 3).long(),
        commands[0],
    ):
        with pytest.raises(rt.InputError, match="commands: expected"):
            made.records(given, seed=0)
    with pytest.raises(rt.InputError, match="chunk"):
        made.records(commands, seed=0, chunk=0)
    few: tuple[list[Fault | None], ...] = ([None], [], [Stuck(9, 1.0), None])
    for faults in few:
        with pytest.raises(rt.InputError, match="faults"):
            made.records(commands, faults=faults, seed=0)
    with pytest.raises(rt.InputError, match="seed"):
        made.records(commands, seed=-1)


def test_outputs_that_are_not_finite_are_refused() -> None:
    twin = WAYS["outputs"]()
    assert isinstance(twin.surrogate, rt.Surrogate)
    twin.surrogate.after.scale.fill_(1e38)
    commands = 30 * commands_of(3)
    with pytest.raises(rt.InputError, match=r"NaN or an infinite output in [1-3] of 3"):
        DeviceTwin(twin, "cpu").records(commands, seed=0)
