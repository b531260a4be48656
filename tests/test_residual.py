"""Truth tests of the residual model: a gap whose law is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

import retwin as rt
from retwin.mixture import Blocks, GaussianMixture
from retwin.training import Training

STEPS = 60


def toy_commands(n: int, rng: np.random.Generator) -> np.ndarray:
    """One movement of a random height."""
    height = rng.uniform(-1, 1, n)
    ramp = np.clip((np.arange(STEPS) - 5) / 20, 0, 1)
    return (height[:, None] * ramp)[..., None]


def law(height: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights, means and deviations (n, 2) of the offset: bimodal and heteroscedastic."""
    weight = 0.25 + 0.5 * (height + 1) / 2
    deviation = 0.02 + 0.03 * np.abs(height)
    mean = 0.2 + 0.1 * height
    return (
        np.stack([weight, 1 - weight], -1),
        np.stack([mean, -mean], -1),
        np.stack([deviation, deviation], -1),
    )


def toy(n: int, seed: int) -> tuple[rt.Trajectories, np.ndarray]:
    rng = np.random.default_rng(seed)
    commands = toy_commands(n, rng)
    height = commands[:, -1, 0]
    weights, means, deviations = law(height)
    mode = (rng.random(n) > weights[:, 0]).astype(int)
    row = np.arange(n)
    offset = means[row, mode] + deviations[row, mode] * rng.normal(size=n)
    # Read as DelayOffset applies it, with a delay of 2 samples.
    late = toy_commands(n, np.random.default_rng(seed))
    late = np.concatenate([late[:, :1], late[:, :1], late[:, :-2]], axis=1)
    ramp = np.clip((np.arange(STEPS) - 7) / 20, 0, 1)
    observed = late + (offset[:, None] * ramp)[..., None]
    made = rt.Trajectories(
        commands=commands,
        nominal=commands,
        observed=observed,
        rate=10.0,
        labels=np.array(["Healthy"] * n),
    )
    return made, offset


def true_log_density(height: np.ndarray, offset: np.ndarray) -> np.ndarray:
    weights, means, deviations = law(height)
    return np.log((weights * stats.norm.pdf(offset[:, None], means, deviations)).sum(-1))


@pytest.fixture(scope="module")
def identity() -> rt.Surrogate:
    """A surrogate of the twin y = u."""
    commands = toy_commands(400, np.random.default_rng(9))
    twin = rt.Trajectories(commands=commands, nominal=commands, observed=commands, rate=10.0)
    return rt.fit_surrogate(
        twin, rt.MLP((32,)), seed=0, training=Training(epochs=40, batch=128, rate=1e-2)
    )


LEARN = Training(epochs=250, batch=256, rate=5e-3, decay="cosine", patience=60)


@pytest.fixture(scope="module")
def fitted(identity: rt.Surrogate) -> dict[int, rt.ResidualModel]:
    calibration, _ = toy(2500, seed=1)
    return {
        k: rt.fit_residual(
            identity,
            calibration,
            rt.DelayOffset(),
            rt.Mixture(components=k, hidden=(32, 32), dropout=0.0, smoothness=0.0, training=LEARN),
            seed=0,
        )
        for k in (1, 3)
    }


def offset_law(
    model: rt.ResidualModel, identity: rt.Surrogate, test: rt.Trajectories
) -> GaussianMixture:
    context, _ = rt.infer_discrepancy(identity, test, rt.DelayOffset())
    with torch.no_grad():
        told = model(context)
    assert isinstance(told, Blocks)
    return told.blocks[1]


def test_a_bimodal_heteroscedastic_law_is_recovered(
    fitted: dict[int, rt.ResidualModel], identity: rt.Surrogate
) -> None:
    test, offset = toy(1500, seed=2)
    told = offset_law(fitted[3], identity, test)
    value = torch.tensor(offset)[:, None, None].float()
    log_density = told.log_prob(value)[:, 0].numpy()
    truth = true_log_density(test.commands[:, -1, 0], offset)
    assert abs(truth.mean() - log_density.mean()) < 0.05
    pit = told.marginal_cdf(value)[:, 0, 0].numpy()
    assert stats.kstest(pit, "uniform").pvalue > 0.01


def test_it_beats_a_single_gaussian(
    fitted: dict[int, rt.ResidualModel], identity: rt.Surrogate
) -> None:
    test, offset = toy(500, seed=3)
    value = torch.tensor(offset)[:, None, None].float()
    scores = {
        k: offset_law(m, identity, test).log_prob(value).mean().item() for k, m in fitted.items()
    }
    assert scores[3] > scores[1] + 0.3


def test_draws_follow_the_law_and_the_bounds(
    fitted: dict[int, rt.ResidualModel], identity: rt.Surrogate
) -> None:
    test, offset = toy(1500, seed=4)
    context, _ = rt.infer_discrepancy(identity, test, rt.DelayOffset())
    generator = torch.Generator().manual_seed(0)
    drawn = fitted[3].sample(context, generator=generator)
    assert stats.ks_2samp(drawn[:, 0, 1].numpy(), offset).pvalue > 0.01
    tight = rt.fit_residual(identity, toy(60, seed=5)[0], seed=0, bounds=np.array([1.0, 0.1]))
    assert tight.sample(context, generator=generator).abs().amax((0, 1)).tolist() == pytest.approx(
        [1.0, 0.1]
    )


def test_a_density_integrates_to_one() -> None:
    generator = torch.Generator().manual_seed(0)
    factor = torch.randn(3, 2, 2, generator=generator).tril(-1) + torch.diag_embed(
        torch.rand(3, 2, generator=generator) + 0.5
    )
    mixture = GaussianMixture(
        torch.randn(3, generator=generator), torch.randn(3, 2, generator=generator), factor
    )
    axis = torch.linspace(-12, 12, 600)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1)
    volume = mixture.log_prob(grid).exp().sum() * (axis[1] - axis[0]) ** 2
    assert volume == pytest.approx(1.0, abs=1e-3)
    marginal = mixture.marginal_cdf(torch.tensor([0.3, -0.2]))
    below = (grid[..., 0] <= 0.3) * mixture.log_prob(grid).exp()
    assert marginal[0] == pytest.approx((below.sum() * (axis[1] - axis[0]) ** 2).item(), abs=1e-2)


def test_draws_from_noise_have_the_mixture_s_moments() -> None:
    mixture = GaussianMixture(
        torch.tensor([0.0, 1.0]),
        torch.tensor([[0.0, 1.0], [3.0, -1.0]]),
        torch.tensor([[[1.0, 0], [0.5, 0.2]], [[0.3, 0], [0, 2.0]]]),
    )
    both = Blocks([mixture, mixture])
    drawn = both.sample((40_000,), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn.mean(0), both.mean, atol=0.05, rtol=0)
    torch.testing.assert_close(drawn.var(0), both.variance, atol=0.1, rtol=0.05)
    again = both.sample((40_000,), generator=torch.Generator().manual_seed(0))
    assert torch.equal(drawn, again)


def test_calibrates_on_healthy_by_default(ibg: rt.Surrogate, emulated: rt.Trajectories) -> None:
    brief = rt.Mixture(training=Training(epochs=3, batch=64))
    few = rt.fit_residual(ibg, emulated, mixture=brief, seed=0)
    assert few.fitted.figures["trajectories"] == 10
    every = rt.fit_residual(ibg, emulated, mixture=brief, seed=0, calibrate_on="all")
    assert every.fitted.figures["trajectories"] == 90
    assert every.scale[1:].max() > 1.5 * few.scale[1:].max(), "the offset absorbs the faults"


def test_six_healthy_trajectories_are_enough(ibg: rt.Surrogate, emulated: rt.Trajectories) -> None:
    model = rt.fit_residual(ibg, emulated.with_label("Healthy")[:6], seed=0)
    context, _ = rt.infer_discrepancy(ibg, emulated.with_label("Healthy"), rt.DelayOffset())
    drawn = model.sample(context, generator=torch.Generator().manual_seed(0))
    assert torch.isfinite(drawn).all()
    assert 2 < drawn[..., 0].median() < 9


def test_too_few_to_validate_is_a_warning(ibg: rt.Surrogate, emulated: rt.Trajectories) -> None:
    brief = rt.Mixture(training=Training(epochs=3))
    with pytest.warns(UserWarning, match="2 trajectories to calibrate on, at least three"):
        model = rt.fit_residual(ibg, emulated.with_label("Healthy")[:2], mixture=brief, seed=0)
    assert model.fitted.history["validation"] == []


def test_nothing_to_calibrate_on_is_refused(ibg: rt.Surrogate, emulated: rt.Trajectories) -> None:
    with pytest.raises(rt.InputError, match="at least one trajectory labelled 'Healthy'"):
        rt.fit_residual(ibg, emulated.with_label("Motor_1_Stuck"), seed=0)
    with pytest.raises(rt.InputError, match="'healthy' or 'all'"):
        rt.fit_residual(ibg, emulated, seed=0, calibrate_on="some")
    still = emulated.replace(commands=np.full_like(emulated.commands, 500))
    with pytest.raises(rt.InputError, match="commands that never change"):
        rt.fit_residual(ibg, still, seed=0)


def test_saved_and_loaded_is_the_same(
    rg: rt.ResidualModel, ibg: rt.Surrogate, emulated: rt.Trajectories, tmp_path: Path
) -> None:
    rg.save(tmp_path / "rg")
    back = rt.ResidualModel.load(tmp_path / "rg")
    context, _ = rt.infer_discrepancy(ibg, emulated[:4], back.correction)
    draws = [m.sample(context, generator=torch.Generator().manual_seed(1)) for m in (rg, back)]
    assert torch.equal(*draws)
    assert back.fitted == rg.fitted
    np.testing.assert_array_equal(back.timing, rg.timing)


def test_calibration_data_must_speak_of_the_same_system(
    ibg: rt.Surrogate, emulated: rt.Trajectories
) -> None:
    with pytest.raises(rt.InputError, match=r"calibration.rate: expected .* 100.0, got 50.0"):
        rt.fit_residual(ibg, emulated.replace(rate=50.0), seed=0)
    millimetres = rt.Channels(("x", "y", "z"), ("mm",) * 3)
    with pytest.raises(rt.InputError, match=r"calibration.outputs"):
        rt.fit_residual(ibg, emulated.replace(outputs=millimetres), seed=0)
    with pytest.raises(rt.InputError, match="one positive bound for each of delay, offset_x"):
        rt.fit_residual(ibg, emulated, seed=0, bounds=np.ones(3))
    with pytest.raises(rt.InputError, match="0 components"):
        rt.Mixture(components=0)


def test_what_was_calibrated_on_emulated_data_says_so(
    rg: rt.ResidualModel, updated: rt.CorrectedTwin, case: rt.Case, tmp_path: Path
) -> None:
    assert rg.emulated
    updated.save(tmp_path / "twin")
    back = rt.CorrectedTwin.load(tmp_path / "twin")
    assert rt.generate(back, case, per_class=1, seed=0).emulated
