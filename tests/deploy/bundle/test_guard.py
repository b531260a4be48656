"""What no class explains is flagged, what some class explains is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from sklearn.metrics import roc_auc_score

import retwin as rt
from retwin.deploy.bundle.guard import Guard, fit_guard, implausible
from retwin.deploy.bundle.verdicts import CHECKS, Domain
from retwin.nets.training import Training

RNG = np.random.default_rng(0)
RANGES = Domain((0.0,), (100.0,), (5.0,), (-1.0,), (1.0,), (0.5,), mismatch=0.1, energy=2.0)


def toy(commands: list[float], observed: list[float]) -> rt.Trajectories:
    """One trajectory of one input and one output."""
    told, seen = (np.array(each, dtype=float)[None, :, None] for each in (commands, observed))
    return rt.Trajectories(commands=told, nominal=np.zeros_like(seen), observed=seen, rate=1.0)


def test_the_scores_are_multiples_of_what_is_usual() -> None:
    # Commands 4 beyond a range of 100, speed 10 over 5, an output 0.2 beyond a range of 2.
    odd = toy([98.0, 104.0, 94.0, 94.0], [0.0, 1.2, np.nan, 0.0])
    verdicts = RANGES.judge(odd, np.array([0.2]), np.array([2.0 + np.log(3.0)]))
    expected = [4 / 100 / 0.02, 5 / 5 / 0.02, 0.2 / 2 / 0.02, 2.0, 0.25 / 0.25, 3.0]
    np.testing.assert_allclose(verdicts.scores[0], expected, rtol=1e-6)
    assert verdicts.reason.tolist() == ["speed"]
    assert verdicts.verdict.tolist() == ["outside"]
    usual = RANGES.judge(toy([0.0, 5.0, 10.0], [0.0, 1.0, -1.0]), np.array([0.1]), np.array([2.0]))
    assert (usual.verdict.tolist(), usual.reason.tolist()) == (["ok"], [""])
    assert usual.suspicion.tolist() == [1.0]


def test_without_commands_it_says_so() -> None:
    bare = toy([0.0, 0.0], [0.0, 0.0]).replace(commands=np.zeros((1, 2, 0)), inputs=None)
    with pytest.raises(rt.InputError, match="without commands nothing says what is usual"):
        RANGES.judge(bare, np.zeros(1), np.zeros(1))


def test_ranges_take_in_all_that_was_seen() -> None:
    around = Domain.around(
        [toy([1.0, 4.0, 2.0], [0.5, np.nan, 2.0]), toy([0.0, 1.0], [np.nan, 1.0])]
    )
    assert (around.low, around.high, around.speed) == ((0.0,), (4.0,), (3.0,))
    assert (around.floor, around.ceiling, around.spread) == ((0.5,), (2.0,), (1.0,))


def test_implausible_outputs_keep_the_nominal_path() -> None:
    features = torch.randn(30, 20, 4, generator=torch.Generator().manual_seed(0))
    made, again = (implausible(features, torch.Generator().manual_seed(1)) for _ in range(2))
    torch.testing.assert_close(made, again)
    torch.testing.assert_close(made[..., :2], features[..., :2])
    assert ((made - features).abs().amax(dim=(1, 2)) > 0).all()


def fooled(kind: str, real: rt.Trajectories) -> rt.Trajectories:
    """Trajectories that are none: of the samples, of other trajectories, of another size."""
    observed = real.observed
    match kind:
        case "time":
            polls = observed[:, RNG.permutation(np.arange(0, real.steps, 10))]
            observed = np.repeat(polls, 10, axis=1)[:, : real.steps]
        case "trajectories":
            observed = np.roll(observed, 10, axis=0)
        case "channels":
            observed = np.roll(observed, 1, axis=2)
        case "larger":
            observed = 1.25 * observed
        case "smaller":
            observed = 0.8 * observed
        case "foreign":
            walk = RNG.normal(size=observed.shape).cumsum(axis=1)
            spread = observed.std(axis=(0, 1))
            observed = observed.mean(axis=(0, 1)) + walk / walk.std(axis=(0, 1)) * spread
    return real.replace(observed=observed.astype(np.float32))


@pytest.mark.parametrize(
    "kind", ["time", "trajectories", "channels", "larger", "smaller", "foreign"]
)
def test_what_is_none_is_told_from_what_is(
    kind: str, guard: Guard, ibg: rt.Surrogate, emulated: rt.Trajectories
) -> None:
    """Of six kinds two were among what the energy learned from."""
    good = guard.judge(ibg, emulated).suspicion
    bad = guard.judge(ibg, fooled(kind, emulated)).suspicion
    truth = np.repeat([0, 1], len(emulated))
    assert roc_auc_score(truth, np.concatenate([good, bad])) > 0.95


def test_what_some_class_explains_is_seldom_flagged(
    guard: Guard, updated: rt.CorrectedTwin, case: rt.Case, emulated: rt.Trajectories
) -> None:
    fresh = rt.generate(updated, case, per_class=20, seed=77)
    assert (guard.judge(updated.surrogate, fresh).verdict != "ok").mean() < 0.05
    # Faulty ones of the emulated robot, of which it has seen nothing.
    faulty = emulated[emulated.labels != "Healthy"]
    assert (guard.judge(updated.surrogate, faulty).verdict != "ok").mean() <= 0.05


def test_each_check_tells_its_reason(
    guard: Guard, ibg: rt.Surrogate, emulated: rt.Trajectories
) -> None:
    healthy = emulated.with_label("Healthy")
    commands = healthy.commands.copy()
    commands[:, 300:] += 600
    jumps = healthy.commands.copy()
    jumps[:, ::2] += 10
    shifted = healthy.nominal + np.float32(0.1)
    changes = {
        "commands": {"commands": commands},
        "speed": {"commands": jumps},
        "outputs": {"observed": healthy.observed + np.float32(3)},
        "nominal": {"nominal": shifted, "observed": healthy.observed + np.float32(0.1)},
        "missing": {"mask": np.zeros_like(healthy.mask)},
    }
    for name, change in changes.items():
        scores = guard.judge(ibg, healthy.replace(**change)).scores
        assert (scores[:, CHECKS.index(name)] > 1).all(), name
    with pytest.raises(rt.InputError, match=r"trajectories\.inputs"):
        guard.judge(ibg, healthy.replace(commands=np.zeros((len(healthy), 1000, 0)), inputs=None))


def test_the_same_seed_gives_the_same_guard(
    updated: rt.CorrectedTwin, case: rt.Case, emulated: rt.Trajectories
) -> None:
    short = Training(epochs=1, batch=32)
    one, two = (
        fit_guard(updated, case, emulated, seed=4, count=45, training=short) for _ in range(2)
    )
    assert one.domain == two.domain
    weights = zip(one.state_dict().values(), two.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in weights)


def test_it_needs_something_healthy(
    updated: rt.CorrectedTwin, case: rt.Case, emulated: rt.Trajectories
) -> None:
    stuck = emulated.with_label("Motor_1_Stuck")
    with pytest.raises(rt.InputError, match="at least one healthy trajectory"):
        fit_guard(updated, case, stuck, seed=0)
    with pytest.raises(rt.InputError, match="five generated ones per class"):
        fit_guard(updated, replace(case), emulated, seed=0, count=20)
