"""Proposals for corrected dynamics, compared with the posterior in closed form."""

from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.errors import InputError
from retwin.evaluation.experiments.dynamics import DynamicsKnowledge
from retwin.evaluation.experiments.propose import next_experiments
from retwin.inference.design import chosen
from retwin.twins import Parameter, State, StateTwin
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.twin import DynamicsTwin

NOISE, POSTERIOR = 0.01, np.diag([0.2, 0.3, 0.0])


def learned(posterior: np.ndarray = POSTERIOR) -> DynamicsTwin:
    """x' = a u1 + b u2 with a known start: outputs are linear in both unknowns."""
    equations = StateTwin(
        (State("x", "m", 0.0),),
        lambda x, u: x,
        rt.Channels(("u1", "u2"), ("V", "V")),
        rt.Channels(("y",), ("m",)),
        1.0,
        step=lambda x, u, p: (p.a * u.u1 + p.b * u.u2,),
        parameters=(Parameter("a", "m/V", -5.0, 5.0, 1.0), Parameter("b", "m/V", -5.0, 5.0, 2.0)),
    )
    nothing, domain = np.zeros(1), Domain(*np.array([[-9.0] * 3, [9.0] * 3, [0.0] * 3]), np.ones(1))
    return DynamicsTwin(
        equations, np.array([1.0, 2.0, 0.0]), posterior, nothing, nothing, nothing, nothing,
        np.array([NOISE]), np.ones(1), np.zeros(1), domain, (),
    )  # fmt: skip


class Sampler:
    """Commands of which every tenth drives the second actuator as well."""

    rate, steps = 1.0, 12

    def sample(self, count: int, *, rng: np.random.Generator, onsets: object = None) -> np.ndarray:
        made = rng.uniform(-1, 1, (count, self.steps, 2))
        made[..., 1] *= (np.arange(count) % 10 == 0)[:, None]
        return made


def test_information_is_that_of_a_linear_regression() -> None:
    known = DynamicsKnowledge.of(learned())
    commands = np.random.default_rng(0).uniform(-1, 1, (3, 12, 2))
    roots = known.roots(commands).numpy()
    # y[k] is a u1[k-1] + b u2[k-1], in units of the posterior deviations.
    design = commands[:, :-1] * np.diag(POSTERIOR)[:2]
    expected = np.einsum("nti,ntj->nij", design, design) / NOISE
    np.testing.assert_allclose(np.einsum("nki,nkj->nij", roots, roots), expected, rtol=1e-6)
    now = known.knowledge(commands)
    variance = 1 + np.concatenate([0 * design[:, :1], design], axis=1).reshape(-1, 2) ** 2 @ [
        1 / NOISE, 1 / NOISE,
    ]  # fmt: skip
    np.testing.assert_allclose(now.variance.numpy(), variance, rtol=1e-6)


def test_it_proposes_what_drives_the_unknown_actuator() -> None:
    twin, sampler = learned(np.diag([1e-3, 0.3, 0.0])), Sampler()
    real = twin.simulate(sampler.sample(1, rng=np.random.default_rng(1)), seed=0)
    made = next_experiments(twin, real, sampler, seed=0, count=2, candidates=40)
    assert (np.abs(made.commands[..., 1]).max(axis=1) > 0).all()
    assert made.gains[0] > 2 * made.random_gain > 0
    assert made.ahead[0].excess[0] > made.ahead[1].excess[0] > 0
    assert made.curve == ()
    again = next_experiments(twin, real, sampler, seed=0, count=2, candidates=40)
    np.testing.assert_array_equal(again.commands, made.commands)


def test_choices_account_for_those_before() -> None:
    known = DynamicsKnowledge.of(learned())
    first, second = np.zeros((2, 4, 12, 2))
    first[..., 0] = second[..., 1] = 1.0
    commands = np.concatenate([first, second])
    picked = chosen(known.knowledge(commands), known.roots(commands), 2)[0]
    assert len({index // 4 for index in picked}) == 2


def test_certain_equations_are_refused() -> None:
    with pytest.raises(InputError, match="certain"):
        DynamicsKnowledge.of(learned(np.zeros((3, 1))))
