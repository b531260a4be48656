"""The compiled kernels of generation give what the same functions give in torch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.nets.networks import MLP
from retwin.twins.commands.ramps import ramps_and_holds
from retwin.twins.compiled import commands as compiled_commands
from retwin.twins.faults.actuator_faults import ActuatorBias
from retwin.twins.faults.applied_faults import faulty_commands
from retwin.update.corrections import Context
from retwin.update.corrections.commands.effective_commands import effective_commands
from retwin.update.corrections.commands.path_problem import path_at
from retwin.update.corrections.commands.problem import CommandProblem
from retwin.update.corrections.sampled_sensor import SampledSensor
from retwin.update.kernels import generation
from retwin.update.piecewise_linear import evaluate_piecewise_linear
from retwin.update.surrogate import Surrogate

pytestmark = pytest.mark.skipif(generation.library() is None, reason="there is no C compiler")

STEPS, INPUTS, OUTPUTS = 211, 3, 2


@contextmanager
def slowly(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Without any kernel."""
    with monkeypatch.context() as patch:
        for module in (generation, compiled_commands):
            patch.setattr(module, "library", lambda: None)
        yield


@pytest.fixture(params=[(128, 128), (7,), (33, 20, 12)], ids=str)
def surrogate(request: pytest.FixtureRequest) -> Surrogate:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = Surrogate(
            MLP(request.param),
            inputs=rt.Channels.numbered("u", INPUTS),
            outputs=rt.Channels.numbered("y", OUTPUTS),
            rate=100.0,
        )
    made.before.mean.copy_(torch.tensor([500.0, 0.0, -3.0]))
    made.before.scale.copy_(torch.tensor([150.0, 1.0, 0.01]))
    made.after.mean.copy_(torch.tensor([0.3, -2.0]))
    made.after.scale.copy_(torch.tensor([0.1, 4.0]))
    return made.eval()


def ramped(rng: np.random.Generator, count: int = 9) -> np.ndarray:
    """Commands that ramp and hold, with onsets between samples, two of them without a sample."""
    onsets = np.array([20.3, 75.0, 140.7]) + rng.uniform(0, 9, size=(count, 3))
    levels = rng.normal(size=(count, 3, INPUTS))
    levels[:, 1, 0] = levels[:, 0, 0]
    unit, middle = np.array([150.0, 1.0, 0.01]), np.array([500.0, 0.0, -3.0])
    spans = rng.choice([8.0, 21.0, 33.0], size=levels.shape)
    start = middle + unit * rng.normal(size=(count, INPUTS))
    return ramps_and_holds(start, middle + unit * levels, spans, onsets, STEPS, dtype=np.float32)


def shaken(rng: np.random.Generator) -> np.ndarray:
    """Commands that are on no straight line."""
    noise = rng.normal(size=(5, STEPS, INPUTS)) * [150.0, 1.0, 0.01] + [500.0, 0.0, -3.0]
    return noise.astype(np.float32)


@pytest.mark.parametrize("drawn", [ramped, shaken])
@torch.no_grad()
def test_outputs_along_pieces_are_those_of_the_network(
    surrogate: Surrogate, drawn: Callable[[np.random.Generator], np.ndarray]
) -> None:
    commands = drawn(np.random.default_rng(0))
    found = generation.along_pieces(surrogate, commands)
    slow = evaluate_piecewise_linear(
        surrogate, torch.from_numpy(commands), surrogate.after.scale
    ).numpy()
    exact = Surrogate.__call__(surrogate.double(), torch.from_numpy(commands).double()).numpy()
    assert found is not None
    for reference in (slow, exact):
        assert np.max(np.abs(found - reference) / [0.1, 4.0]) < 1e-5


def test_jacobians_are_those_of_automatic_differentiation(surrogate: Surrogate) -> None:
    commands = torch.from_numpy(shaken(np.random.default_rng(1))).flatten(0, 1)[:70]
    found = generation.jacobians(surrogate, commands)
    inputs = commands.double().requires_grad_()
    columns = surrogate.double()(inputs).sum(dim=0)
    rows = [torch.autograd.grad(each, inputs, retain_graph=True)[0] for each in columns]
    exact = torch.stack(rows, dim=1)
    scale = torch.tensor([0.1, 4.0])[:, None] / torch.tensor([150.0, 1.0, 0.01])
    assert found is not None
    assert float(((found - exact) / scale).abs().max()) < 1e-5


def test_a_network_of_another_kind_is_left_to_torch(surrogate: Surrogate) -> None:
    commands = np.zeros((2, 5, INPUTS), np.float32)
    assert generation.along_pieces(surrogate.double(), commands) is None
    surrogate.float().network[1] = torch.nn.Tanh()
    assert generation.along_pieces(surrogate, commands) is None


def latent(rng: np.random.Generator, segments: rt.Segments, width: int) -> torch.Tensor:
    z = rng.normal(size=(*segments.start.shape, width))
    z[..., 0] *= 12.0  # so that some delays would change the order of segments
    return torch.from_numpy(z)


@torch.no_grad()
def test_effective_commands_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    commands = ramped(rng)
    commands[0] = commands[0, 0]  # a trajectory without segments
    segments = rt.Segments.from_commands(commands)
    z = latent(rng, segments, 1 + 2 * INPUTS)
    z[..., 1 + INPUTS :] = torch.from_numpy(rng.random(z[..., 1 + INPUTS :].shape) < 0.3).double()
    frozen = torch.from_numpy(rng.choice([STEPS, 30, 90, 0], size=(len(commands), INPUTS)))
    reference = torch.from_numpy(commands).double()
    times = torch.arange(0, STEPS, 7)
    fast = effective_commands(reference, segments, z, times, frozen)
    with slowly(monkeypatch):
        slow = effective_commands(reference, segments, z, times, frozen)
    assert float((fast - slow).abs().max()) < 1e-9 * 650


@pytest.mark.parametrize("own_delays", [False, True])
@torch.no_grad()
def test_linearised_outputs_are_the_same(
    surrogate: Surrogate, monkeypatch: pytest.MonkeyPatch, own_delays: bool
) -> None:
    rng = np.random.default_rng(7)
    commands = ramped(rng)
    mask = rng.random((len(commands), STEPS, 1)) < 0.6
    context = Context.of(
        surrogate,
        commands,
        rt.Segments.from_commands(commands),
        rate=100.0,
        frozen=rng.choice([STEPS, 30, 90, 0], size=(len(commands), INPUTS)),
    )
    problem = CommandProblem.of(
        context,
        context.nominal + 0.01,
        torch.from_numpy(mask).expand(-1, -1, OUTPUTS),
        delay_range=(-5.0, 30.0),
        max_samples=60,
    )
    missed = torch.from_numpy(rng.random(problem.missed.shape) < 0.3).double()
    problem = replace(problem, own_delays=own_delays).with_missed(missed)
    x = torch.from_numpy(rng.normal(size=problem.zero.shape))
    problem.per_segment(x)[..., 0] *= 12.0
    fast = problem.linearised(x)
    with slowly(monkeypatch):
        slow = problem.linearised(x)
    for found, expected in zip(fast, slow, strict=True):
        assert float((found - expected).abs().max() / expected.abs().max()) < 1e-5


@torch.no_grad()
def test_delayed_paths_are_the_same() -> None:
    rng = np.random.default_rng(3)
    commands = ramped(rng)
    segments = rt.Segments.from_commands(commands)
    z, path = latent(rng, segments, 1 + INPUTS).float(), torch.from_numpy(commands) / 500
    fast = generation.delayed_path(segments, path, z)
    assert fast is not None
    assert float((fast - path_at(segments, path, z)).abs().max()) < 1e-5


@pytest.mark.parametrize("phases", [(0.0,), (0.0, 0.03, 0.06)])
def test_records_are_the_same(monkeypatch: pytest.MonkeyPatch, phases: tuple[float, ...]) -> None:
    sensor = SampledSensor(0.07, phases, glitch_probability=0.0)
    outputs = torch.from_numpy(np.random.default_rng(4).normal(size=(6, STEPS, 2))).float()
    fast = sensor.read(outputs, torch.Generator().manual_seed(0), 100.0)
    with slowly(monkeypatch):
        slow = sensor.read(outputs, torch.Generator().manual_seed(0), 100.0)
    assert float((fast - slow).abs().max()) < 1e-6


def test_ramps_and_biased_references_have_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    def made() -> tuple[bytes, bytes]:
        commands = ramped(np.random.default_rng(5))
        segments = rt.Segments.from_commands(commands)
        faults = [None, *(ActuatorBias(i % INPUTS, bias=(3.0, -1.0)) for i in range(8))]
        biased = faulty_commands(commands, faults, segments, rate=100.0)
        assert not np.array_equal(biased[1:], commands[1:])
        return commands.tobytes(), biased.tobytes()

    fast = made()
    with slowly(monkeypatch):
        assert made() == fast


@pytest.mark.parametrize("threads", [2, 3])
def test_results_do_not_depend_on_threads(surrogate: Surrogate, threads: int) -> None:
    commands, before = ramped(np.random.default_rng(6)), torch.get_num_threads()

    def made(count: int) -> Any:
        torch.set_num_threads(count)
        return generation.along_pieces(surrogate, commands)

    try:
        assert np.array_equal(made(1), made(threads))
    finally:
        torch.set_num_threads(before)


def test_kept_libraries_of_others_are_not_loaded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    from retwin import compiler

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = "int answer(void) { return 42; }\n"
    for content in (None, b"damaged", b"damaged and open to others"):
        compiler.compiled.cache_clear()
        for kept in tmp_path.rglob("*.so"):
            kept.write_bytes(content or b"")
            kept.chmod(0o666 if content and b"others" in content else 0o600)
        library = compiler.compiled(source)
        assert library is not None
        assert library.answer() == 42
        assert len(list(tmp_path.rglob("*.so"))) == 1
    compiler.compiled.cache_clear()
