"""The compiled form of a model: its compiler and its threads."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np
import pytest
import torch

import retwin as rt
from retwin import compiler
from retwin.twins import State, StateTwin
from retwin.workers import threads as divided

LAG = StateTwin(
    (State("level", "V"),),
    lambda x, u: x.level,
    rt.Channels(("pump",), ("V",)),
    rt.Channels(("level",), ("V",)),
    10.0,
    derivative=lambda x, u: (u.pump - torch.sin(x.level),),
)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, used = np.random.default_rng(0), []
    commands, kicks = rng.normal(size=(5, 40, 1)), 0.1 * rng.normal(size=(5, 40, 1))
    measured = rng.normal(size=(5, 40, 1)), rng.random((5, 40, 1)) < 0.8
    theta, spread = rng.normal(size=(5, 1)), np.ones((5, 1, 1))
    variances = np.ones(1), np.ones(1)
    pool = divided.ThreadPoolExecutor
    made_by = lambda n, **options: (used.append(n), pool(n, **options))[1]  # noqa: E731
    monkeypatch.setattr(divided, "ThreadPoolExecutor", made_by)

    def made(count: int) -> list[bytes]:
        torch.set_num_threads(count)
        steps = LAG.steps()
        arrays = (
            *steps.run(commands, theta, kicks),
            *steps.sensitivities(commands, theta),
            *steps.filter(commands, theta, measured, spread, variances),
        )
        return [each.tobytes() for each in arrays]

    assert made(1) == made(2) == made(8)
    assert used == [2] * 3 + [5] * 3


def test_a_compiler_that_does_not_know_the_processor_is_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(compiler, "NATIVE", "-march=unheard-of")
    compiler.compiled.cache_clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compiler.compiled(LAG.model.source) is not None
    compiler.compiled.cache_clear()
