"""Which trajectories to record next: information against closed forms, and the public function."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from test_readme import python_of

import retwin as rt
from retwin.errors import InputError
from retwin.evaluation.experiments.propose import Proposal, _joined
from retwin.evaluation.experiments.segments import _regression
from retwin.inference.design import Knowledge, chosen


def knowledge(unknowns: int = 4, predictions: int = 6) -> Knowledge:
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(unknowns, unknowns, generator=generator, dtype=torch.float64)
    rows = torch.randn(predictions, unknowns, generator=generator, dtype=torch.float64)
    return Knowledge(root @ root.mT, rows, torch.linspace(0.5, 2, predictions).double())


def experiments(count: int, unknowns: int = 4) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(count, 2, unknowns, generator=generator, dtype=torch.float64)


def test_information_is_that_of_gaussians_in_closed_form() -> None:
    known, roots = knowledge(), experiments(5)
    for root, gain in zip(roots, known.gains(roots), strict=True):
        after = torch.linalg.inv(torch.linalg.inv(known.covariance) + root.mT @ root)
        torch.testing.assert_close(known.after(root).covariance, after)
        rows = known.predictions
        left = known.scatter + ((rows @ after) * rows).sum(dim=1)
        assert float(gain) == pytest.approx(float(0.5 * (known.variance / left).log().mean()))


def test_each_choice_accounts_for_those_before() -> None:
    known, roots = knowledge(), experiments(6)
    picked, after = chosen(known, roots, 6)
    assert sorted(picked) == list(range(6))
    assert picked[0] == int(known.gains(roots).argmax())
    rest = after[0].gains(roots)
    rest[picked[0]] = -1.0
    assert picked[1] == int(rest.argmax())
    excess = [known.excess, *(each.excess for each in after)]
    assert all(a > b > 0 for a, b in pairwise(excess))


def test_commands_of_different_numbers_of_segments_are_compared() -> None:
    known, roots = knowledge(), experiments(6)
    parts = [roots[:2, :1], roots[2:]]
    gains = torch.cat([known.gains(part) for part in parts])
    torch.testing.assert_close(known.gains(_joined(parts)), gains)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::retwin.update.OutsideTrainingWarning")
def test_trajectories_may_differ_in_their_number_of_segments(
    updated: rt.CorrectedTwin, emulated: rt.Trajectories, case: rt.Case
) -> None:
    """Candidates of one part had fewer segments than those of another: a RuntimeError."""

    class Resting:
        rate = case.sampler.rate

        def sample(self, count: int, *, rng: np.random.Generator) -> np.ndarray:
            made = case.sampler.sample(count, rng=rng).copy()
            rests = np.linspace(300, made.shape[1] - 1, count).astype(int)
            for commands, at in zip(made, rests, strict=True):
                commands[at:] = commands[at]
            return made

    made = rt.next_experiments(updated, emulated, Resting(), seed=3, count=1, candidates=20)
    assert made.gains[0] > 0


def test_what_moves_no_prediction_earns_nothing() -> None:
    first = torch.tensor([[1.0, 0.0]]).double()
    known = Knowledge(torch.eye(2).double(), first, torch.ones(1).double())
    roots = torch.tensor([[[0.0, 5.0]], [[0.1, 0.0]]], dtype=torch.float64)
    gains = known.gains(roots)
    assert float(gains[0]) == pytest.approx(0.0, abs=1e-12)
    assert float(gains[1]) > 0


def test_the_regression_finds_a_known_mean_and_its_scatter() -> None:
    rng = np.random.default_rng(0)
    design = torch.as_tensor(np.column_stack([np.ones(400), rng.normal(size=(400, 3))]))
    truth = torch.tensor([[1.0, 2.0, 0.0, -1.0], [0.0, 0.0, 0.5, 0.0]]).double()
    root = torch.tensor([[0.5, 0.0], [0.3, 0.4]]).double()
    noise = torch.as_tensor(rng.normal(size=(400, 2))) @ root.mT
    error = 0.01 * torch.eye(2).double().expand(400, 2, 2)
    measured = design @ truth.mT + noise
    scatter, mean, covariance = _regression(design, measured, error)
    deviation = covariance.diagonal().sqrt().view(2, 4)
    assert float(((mean - truth) / deviation).abs().max()) < 4
    # The covariance of z given outputs is that of z's posterior: it adds to the spread of z*.
    expected = root @ root.mT + error[0]
    torch.testing.assert_close(scatter, expected, rtol=0.3, atol=0.02)
    # A segment whose outputs do not determine z gives no information.
    blind = scatter.expand(400, 2, 2)
    _, _, wide = _regression(design, measured, torch.cat([error[:200], blind[200:]]))
    assert float(wide.diagonal().mean()) > float(covariance.diagonal().mean())


@pytest.fixture(scope="module")
def proposal(updated: rt.CorrectedTwin, emulated: rt.Trajectories, case: rt.Case) -> Proposal:
    return propose(updated, emulated, case)


def propose(
    updated: rt.CorrectedTwin, emulated: rt.Trajectories, case: rt.Case, **how: object
) -> Proposal:
    given = {"seed": 3, "count": 2, "candidates": 20, **how}
    return rt.next_experiments(updated, emulated, case.sampler, **given)  # type: ignore[arg-type]


@pytest.mark.slow
def test_proposals_are_commands_of_the_sampler_and_narrow_more_than_random_ones(
    proposal: Proposal, case: rt.Case
) -> None:
    assert proposal.commands.shape == (2, case.sampler.steps, 4)
    drawn = case.sampler.sample(200, rng=np.random.default_rng(0))
    assert proposal.commands.min() >= drawn.min() - 60
    assert proposal.commands.max() <= drawn.max() + 60
    assert proposal.gains[0] >= proposal.gains[1] > 0
    assert proposal.gains[0] > proposal.random_gain
    widths = [each.excess[0] for each in proposal.ahead]
    assert widths[0] > widths[1] > widths[2] > 0
    assert proposal.ahead[2].excess[0] < proposal.ahead_random[2].excess[0]
    recalls = [each.recall[0] for each in proposal.ahead]
    assert 0 < recalls[0] < recalls[2] < 1
    low, high = proposal.ahead_random[2].excess[1:]
    assert low < proposal.ahead_random[2].excess[0] < high


@pytest.mark.slow
def test_the_learning_curve_falls_on_trajectories_that_were_left_out(proposal: Proposal) -> None:
    first, last = proposal.curve[0], proposal.curve[-1]
    assert (first.trajectories, last.trajectories) == (2, 9)
    assert first.error[0] > last.error[0] > 0
    for each in proposal.curve:
        assert each.error[1] <= each.error[0] <= each.error[2]


@pytest.mark.slow
def test_it_says_when_to_stop(
    proposal: Proposal, updated: rt.CorrectedTwin, emulated: rt.Trajectories, case: rt.Case
) -> None:
    now = proposal.ahead[0].excess[0]
    easy = propose(updated, emulated, case, tolerance=1.1 * now)
    assert easy.enough
    assert (easy.needed, easy.needed_random) == (0, 0)
    again = propose(updated, emulated, case, tolerance=0.999 * now)
    assert not again.enough
    assert again.needed == 1
    np.testing.assert_array_equal(again.commands, proposal.commands)


@pytest.mark.parametrize(
    ("how", "message"),
    [({"count": 0}, "count"), ({"candidates": 1}, "candidates"), ({"tolerance": 0.0}, "tolerance")],
)
def test_wrong_numbers_are_named(
    how: dict, message: str, updated: rt.CorrectedTwin, emulated: rt.Trajectories, case: rt.Case
) -> None:
    with pytest.raises(InputError, match=message):
        propose(updated, emulated, case, **how)


def test_too_few_healthy_trajectories_are_refused(
    updated: rt.CorrectedTwin, emulated: rt.Trajectories, case: rt.Case
) -> None:
    with pytest.raises(InputError, match="at least 3 healthy"):
        propose(updated, emulated[emulated.labels == "Motor_1_Stuck"], case)


@pytest.mark.slow
def test_the_actuators_posterior_is_that_of_the_inference(
    ibg: rt.Surrogate, emulated: rt.Trajectories, case: rt.Case
) -> None:
    healthy = emulated[np.flatnonzero(emulated.labels == "Healthy")]
    residual = rt.fit_residual(ibg, healthy, case.correction, seed=0)
    made = propose(rt.CorrectedTwin(ibg, residual), healthy, case)
    assert made.ahead[0].excess[0] > made.ahead[1].excess[0] > 0
    assert made.gains[0] > made.random_gain > 0


@pytest.mark.slow
def test_the_code_of_the_page_runs() -> None:
    code = "".join(python_of("correct", "Which experiment next, and are these enough?"))
    found: dict = {}
    exec(compile(code, "docs/correct.md", "exec"), found)
    assert found["made"].commands.shape[0] == 3
