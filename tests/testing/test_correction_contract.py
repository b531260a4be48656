"""All corrections satisfy the same contract, and every check of it can fail."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from test_readme import python_of
from torch import Tensor

import retwin as rt
from retwin.testing import CORRECTION_CHECKS, CorrectionSubject, check_correction
from retwin.update.corrections import Head


def short(exact, case: rt.Case, count: int) -> rt.Context:
    sampler = replace(case.sampler, movements=2, duration=4.0, period=2.0)
    commands = sampler.sample(count, rng=np.random.default_rng(0))
    return rt.Context.of(exact, commands, rt.Segments.from_commands(commands), rate=100.0)


@pytest.fixture(scope="module")
def context(exact, case: rt.Case) -> rt.Context:
    return short(exact, case, 3)


@pytest.fixture(scope="module")
def several(exact, case: rt.Case) -> rt.Context:
    return short(exact, case, 10)


def delays_and_offsets(context: rt.Context) -> Tensor:
    rng = np.random.default_rng(1)
    shape = context.segments.start.shape
    delay, offset = rng.gamma(4, 1.2, (*shape, 1)), rng.normal(0, 0.005, (*shape, 3))
    return torch.tensor(np.concatenate([delay, offset], axis=2)).float()


def offsets_of_joints(context: rt.Context) -> Tensor:
    rng = np.random.default_rng(2)
    shape = context.segments.start.shape
    delay, offset = rng.gamma(4, 1.2, (*shape, 1)), rng.normal(0, 4, (*shape, 4))
    missed = np.zeros((*shape, 4))
    missed[[0, 3, 5, 8], [0, 0, 0, 1], [0, 1, 2, 3]] = 1.0
    return torch.tensor(np.concatenate([delay, offset * (1 - missed), missed], axis=2)).float()


CORRECTIONS: dict[str, tuple[rt.Correction, Callable[[rt.Context], Tensor], str]] = {
    "delay and offset": (rt.DelayOffset((-0.05, 0.3)), delays_and_offsets, "context"),
    # Its prior is learned from all trajectories, so it needs more than a few.
    "command space": (rt.CommandSpace(), offsets_of_joints, "several"),
    "chain": (
        rt.Chain(rt.DelayOffset((-0.05, 0.3)), rt.SampledSensor()),
        delays_and_offsets,
        "context",
    ),
    "chain of command space": (
        rt.Chain(rt.CommandSpace(), rt.SampledSensor()),
        offsets_of_joints,
        "several",
    ),
}
# Its operators keep the contract one by one, and "chain" has one that infers quickly.
SLOW = {"chain of command space": pytest.mark.slow}


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=SLOW.get(name, ())) for name in CORRECTIONS],
)
def subject(request: pytest.FixtureRequest) -> CorrectionSubject:
    correction, draw, name = CORRECTIONS[request.param]
    context = request.getfixturevalue(name)
    return CorrectionSubject(correction, context, draw(context))


@pytest.mark.slow
@pytest.mark.parametrize("check", CORRECTION_CHECKS, ids=lambda check: check.__name__)
def test_correction(subject: CorrectionSubject, check: Callable) -> None:
    check(subject)


@dataclass(frozen=True)
class Modified:
    """`DelayOffset` with parts replaced."""

    resolution: str = "segment"
    latent: Callable = rt.DelayOffset((-0.05, 0.3)).latent
    heads: Callable = rt.DelayOffset((-0.05, 0.3)).heads
    apply: Callable = rt.DelayOffset((-0.05, 0.3)).apply
    infer: Callable = rt.DelayOffset((-0.05, 0.3)).infer


GOOD = rt.DelayOffset((-0.05, 0.3))


def heads_that_overlap(inputs: rt.Channels, outputs: rt.Channels) -> tuple[Head, ...]:
    return Head("delay", 2), Head("offset", len(outputs))


def adds_a_constant(context: rt.Context, z: Tensor) -> Tensor:
    return GOOD.apply(context, z) + 0.01


def forgets_the_last_output(context: rt.Context, z: Tensor) -> Tensor:
    return GOOD.apply(context, z * torch.tensor([1.0, 1.0, 1.0, 0.0]))


def forgets_the_gradient(context: rt.Context, z: Tensor) -> Tensor:
    return GOOD.apply(context, z.detach())


def mixes_trajectories(context: rt.Context, z: Tensor) -> Tensor:
    return GOOD.apply(context, z + (z.mean(dim=0) - z.mean(dim=0).mean()) * (len(z) - 1))


def identifies_every_segment(context: rt.Context, observed: Tensor, mask: Tensor):
    found = GOOD.infer(context, observed, mask)
    return replace(found, identified=torch.ones_like(found.identified))


def has_a_negative_variance(context: rt.Context, observed: Tensor, mask: Tensor):
    found = GOOD.infer(context, observed, mask)
    return replace(found, covariance=found.covariance.flip(-1))


def finds_half(context: rt.Context, observed: Tensor, mask: Tensor):
    found = GOOD.infer(context, observed, mask)
    return replace(found, z=found.z / 2)


def ignores_the_mask(context: rt.Context, observed: Tensor, mask: Tensor):
    return GOOD.infer(context, observed, torch.ones_like(mask))


def changes_its_argument(context: rt.Context, observed: Tensor, mask: Tensor):
    observed += 0.001
    return GOOD.infer(context, observed, mask)


def draws_from_the_global_generator(context: rt.Context, observed: Tensor, mask: Tensor):
    torch.rand(1)
    return GOOD.infer(context, observed, mask)


BROKEN = [
    ("check_protocol", SimpleNamespace(resolution="segment", apply=GOOD.apply)),
    ("check_protocol", Modified(resolution="sometimes")),
    ("check_latent", Modified(heads=heads_that_overlap)),
    ("check_zero", Modified(apply=adds_a_constant)),
    ("check_apply", Modified(apply=forgets_the_last_output)),
    ("check_gradient", Modified(apply=forgets_the_gradient)),
    ("check_batch", Modified(apply=mixes_trajectories)),
    ("check_no_segment", Modified(infer=identifies_every_segment)),
    ("check_discrepancy", Modified(infer=has_a_negative_variance)),
    ("check_recovery", Modified(infer=finds_half)),
    ("check_mask", Modified(infer=ignores_the_mask)),
    ("check_arguments_kept", Modified(infer=changes_its_argument)),
    ("check_arguments_kept", Modified(infer=draws_from_the_global_generator)),
]


@pytest.mark.parametrize(("name", "broken"), BROKEN)
def test_a_broken_correction_is_caught(name: str, broken, context: rt.Context) -> None:
    check = {check.__name__: check for check in CORRECTION_CHECKS}[name]
    with pytest.raises(AssertionError):
        check(CorrectionSubject(broken, context, delays_and_offsets(context)))


def test_every_check_can_fail() -> None:
    assert {check.__name__ for check in CORRECTION_CHECKS} == {name for name, _ in BROKEN}


def test_all_that_is_broken_is_listed(context: rt.Context) -> None:
    z = delays_and_offsets(context)
    check_correction(Modified(), context, z)
    worse = Modified(heads=heads_that_overlap, infer=finds_half)
    with pytest.raises(AssertionError, match=r"Modified breaks(.|\n)*check_latent(.|\n)*check_rec"):
        check_correction(worse, context, z)
    with pytest.raises(rt.InputError, match="z: expected shape"):
        check_correction(Modified(), context, z[:1])


def test_the_operator_of_the_docs_satisfies_it(context: rt.Context) -> None:
    (code,) = python_of("correct", "An operator of your own")
    # A dataclass needs its module in sys.modules.
    module = ModuleType("shown")
    sys.modules["shown"] = module
    try:
        exec(compile(code, "docs/correct.md", "exec"), vars(module))
        z = delays_and_offsets(context)[..., 1:]
        check_correction(module.SteadyOffset(), context, z)
    finally:
        del sys.modules["shown"]
