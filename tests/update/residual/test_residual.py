"""Truth tests of the residual model: a discrepancy of known distribution."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

import retwin as rt
from retwin.nets.flows import FlowHead
from retwin.nets.mixtures import Blocks, GaussianMixture, MixtureHead
from retwin.nets.student import Student
from retwin.nets.training import Training, isolated
from retwin.scores.energy import energy_score
from retwin.update.residual.loading import load_residual
from retwin.update.residual.refining import refine

pytestmark = pytest.mark.numerical

STEPS = 60


def toy_commands(n: int, rng: np.random.Generator) -> np.ndarray:
    """One segment of a random height."""
    height = rng.uniform(-1, 1, n)
    ramp = np.clip((np.arange(STEPS) - 5) / 20, 0, 1)
    return (height[:, None] * ramp)[..., None]


def true_mixture(height: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
    weights, means, deviations = true_mixture(height)
    mode = (rng.random(n) > weights[:, 0]).astype(int)
    row = np.arange(n)
    offset = means[row, mode] + deviations[row, mode] * rng.normal(size=n)
    # The output as DelayOffset gives it, with a delay of 2 samples.
    delayed = toy_commands(n, np.random.default_rng(seed))
    delayed = np.concatenate([delayed[:, :1], delayed[:, :1], delayed[:, :-2]], axis=1)
    ramp = np.clip((np.arange(STEPS) - 7) / 20, 0, 1)
    observed = delayed + (offset[:, None] * ramp)[..., None]
    made = rt.Trajectories(
        commands=commands,
        nominal=commands,
        observed=observed,
        rate=10.0,
        labels=np.array(["Healthy"] * n),
    )
    return made, offset


def true_log_density(height: np.ndarray, offset: np.ndarray) -> np.ndarray:
    weights, means, deviations = true_mixture(height)
    return np.log((weights * stats.norm.pdf(offset[:, None], means, deviations)).sum(-1))


def true_distribution(height: np.ndarray, offset: np.ndarray) -> np.ndarray:
    weights, means, deviations = true_mixture(height)
    return (weights * stats.norm.cdf(offset[:, None], means, deviations)).sum(-1)


@pytest.fixture(scope="module")
def identity() -> rt.Surrogate:
    """A surrogate of the twin y = u."""
    commands = toy_commands(400, np.random.default_rng(9))
    twin = rt.Trajectories(commands=commands, nominal=commands, observed=commands, rate=10.0)
    return rt.fit_surrogate(
        twin,
        rt.MLP((32,)),
        seed=0,
        training=Training(max_epochs=40, batch_size=128, learning_rate=1e-2),
    )


LEARN = Training(max_epochs=250, batch_size=256, learning_rate=5e-3, decay="cosine", patience=60)


def learned(identity: rt.Surrogate, count: int, components: int) -> rt.ResidualModel:
    """A mixture fitted to `count` trajectories."""
    density = rt.Mixture(
        components=components, hidden=(32, 32), dropout=0.0, smoothness=0.0, training=LEARN
    )
    return rt.fit_residual(identity, toy(count, seed=1)[0], rt.DelayOffset(), density, seed=0)


@pytest.fixture(scope="module")
def fitted(identity: rt.Surrogate) -> dict[int, rt.ResidualModel]:
    return {components: learned(identity, 400, components) for components in (1, 3)}


def offset_distribution(
    model: rt.ResidualModel, identity: rt.Surrogate, test: rt.Trajectories
) -> Student:
    context, _ = rt.infer_discrepancy(identity, test, rt.DelayOffset())
    with torch.no_grad():
        distribution = model(context)
    assert isinstance(distribution, Blocks)
    return distribution.blocks[1]


@pytest.mark.slow
def test_a_bimodal_heteroscedastic_distribution_is_recovered(identity: rt.Surrogate) -> None:
    """Density and distribution function of each trajectory, compared with the true ones.

    Over 12 retrainings the mean log densities differ by 0.018, standard deviation
    0.005, the distributions on average by 0.023, standard deviation 0.001.
    """
    test, offset = toy(1500, seed=2)
    predicted = offset_distribution(learned(identity, 2500, 3), identity, test)
    value = torch.tensor(offset)[:, None, None].float()
    log_density = predicted.log_prob(value)[:, 0].numpy()
    height = test.commands[:, -1, 0]
    assert abs(true_log_density(height, offset).mean() - log_density.mean()) < 0.08
    pit = stats.norm.cdf(predicted.normal_scores(value)[:, 0, 0].numpy())
    assert np.abs(pit - true_distribution(height, offset)).mean() < 0.05


def test_it_beats_a_single_gaussian(
    fitted: dict[int, rt.ResidualModel], identity: rt.Surrogate
) -> None:
    test, offset = toy(500, seed=3)
    value = torch.tensor(offset)[:, None, None].float()
    scores = {
        k: offset_distribution(m, identity, test).log_prob(value).mean().item()
        for k, m in fitted.items()
    }
    assert scores[3] > scores[1] + 0.3


@pytest.fixture(scope="module")
def flow(identity: rt.Surrogate) -> rt.ResidualModel:
    calibration, _ = toy(2500, seed=1)
    density = rt.Flow(hidden=(32, 32), dropout=0.0, smoothness=0.0, training=LEARN)
    return rt.fit_residual(identity, calibration, rt.DelayOffset(), density, seed=0)


@pytest.mark.long
def test_a_flow_recovers_the_distribution_too(
    flow: rt.ResidualModel, identity: rt.Surrogate, tmp_path: Path
) -> None:
    """As of the mixture, beside what a flow inverts.

    Over 3 retrainings the mean log densities differ by 0.036, standard deviation 0.0028,
    the distributions on average by 0.022, standard deviation 0.0008.
    """
    test, offset = toy(1500, seed=2)
    flow.save(tmp_path / "flow")
    predicted = offset_distribution(rt.ResidualModel.load(tmp_path / "flow"), identity, test)
    value = torch.tensor(offset)[:, None, None].float()
    with torch.no_grad():
        log_density = predicted.log_prob(value)[:, 0].numpy()
        scores = predicted.normal_scores(value)[:, 0, 0].numpy()
        # The noise before the factor of deviations, which many trajectories leave near 1.
        noise = predicted.block.normal_scores(value)
        drawn = predicted.block.from_noise(value, noise)
        mean = predicted.mean[:, 0, 0].numpy()
    height = test.commands[:, -1, 0]
    assert abs(true_log_density(height, offset).mean() - log_density.mean()) < 0.1
    distribution = stats.norm.cdf(scores)
    assert np.abs(distribution - true_distribution(height, offset)).mean() < 0.05
    torch.testing.assert_close(drawn, value, atol=1e-3, rtol=0)
    weights, means, _ = true_mixture(height)
    assert np.abs(mean - (weights * means).sum(axis=-1)).mean() < 0.04


@pytest.mark.parametrize("outliers", [0, 2, 12])
def test_a_mixture_starts_with_one_component_as_wide_as_most_examples(outliers: int) -> None:
    """Clusters would give components to the outliers, and the rest would share the last one."""
    values = np.random.default_rng(0).normal(size=(300, 3)) * [0.5, 1.0, 1.0] + [0.0, 0.0, 1.0]
    values[:outliers] *= 10
    with isolated(0):
        head = MixtureHead(4, 3, 3)
    head.initialise(values, seed=0)
    start = head(torch.zeros(4), torch.zeros(3), torch.ones(3))
    drawn = start.sample((20_000,)).numpy()
    levels = [0.1, 0.25, 0.5, 0.75, 0.9]
    found, expected = (np.quantile(each, levels, axis=0) for each in (drawn, values))
    assert np.abs(found - expected).max() < 0.25


def test_a_mixture_starts_at_groups_that_lie_apart() -> None:
    values = np.random.default_rng(0).normal(size=(300, 2)) + 4 * np.sign(
        np.arange(300)[:, None] % 3 - 1
    )
    with isolated(0):
        head = MixtureHead(4, 2, 3)
    head.initialise(values, seed=0)
    start = head(torch.zeros(4), torch.zeros(2), torch.ones(2))
    at = torch.as_tensor([[-4.0, -4.0], [0.0, 0.0], [4.0, 4.0], [2.0, 2.0]])
    expected = np.log(
        np.mean([stats.multivariate_normal([m, m]).pdf(at) for m in (-4, 0, 4)], axis=0)
    )
    np.testing.assert_allclose(start.log_prob(at).detach().numpy(), expected, atol=0.5)


def test_a_mixture_starts_from_a_single_example() -> None:
    with isolated(0):
        head = MixtureHead(4, 2, 3)
    head.initialise(np.array([[0.5, -1.0]]), seed=0)
    start = head(torch.zeros(4), torch.zeros(2), torch.ones(2))
    torch.testing.assert_close(start.mean.detach(), torch.tensor([0.5, -1.0]), atol=1e-3, rtol=0)
    assert bool((start.variance > 0).all())


def test_a_flow_starts_as_a_normal_distribution_in_any_unit() -> None:
    with isolated(0):
        head = FlowHead(4, 3, transforms=2, bins=6)
    head.initialise(np.zeros((1, 3)), seed=0)
    shift, scale = torch.tensor([1.0, -2.0, 0.0]), torch.tensor([0.1, 5.0, 1.0])
    drawn = head(torch.randn(7, 4, generator=torch.Generator().manual_seed(0)), shift, scale)
    value = shift + scale * torch.tensor([0.3, -1.2, 2.0])
    expected = stats.norm.logpdf(value.numpy(), shift.numpy(), scale.numpy()).sum()
    np.testing.assert_allclose(drawn.log_prob(value).detach(), expected, atol=1e-4)
    torch.testing.assert_close(drawn.mean[0].detach(), shift, atol=0.1, rtol=0)
    torch.testing.assert_close(drawn.variance[0].detach().sqrt(), scale, atol=0, rtol=0.2)


@pytest.mark.slow
def test_draws_follow_the_distribution_and_the_bounds(
    fitted: dict[int, rt.ResidualModel], identity: rt.Surrogate
) -> None:
    """Draws are distributed as their own model says, so its distribution of them is uniform.

    That holds for any weights: the test of Kolmogorov and Smirnov errs with probability 1e-6.
    """
    test, _ = toy(1500, seed=4)
    context, _ = rt.infer_discrepancy(identity, test, rt.DelayOffset())
    generator = torch.Generator().manual_seed(0)
    drawn = fitted[3].sample(context, generator=generator)
    offset = fitted[3](context).blocks[1]
    with torch.no_grad():
        scores = offset.normal_scores(drawn[..., 1:])[:, 0, 0].numpy()
    assert stats.kstest(scores, "norm").pvalue > 1e-6
    brief, bounds = rt.Mixture(training=Training(max_epochs=3)), np.array([1.0, 0.1])
    with pytest.warns(UserWarning, match="bands of 90 % hold"):
        tight = rt.fit_residual(identity, toy(60, seed=5)[0], density=brief, seed=0, bounds=bounds)
    assert tight.sample(context, generator=generator).abs().amax((0, 1)).tolist() == pytest.approx(
        [1.0, 0.1]
    )


def test_a_correction_that_cannot_express_the_discrepancy_is_named(identity: rt.Surrogate) -> None:
    """Noise of each sample is no delay and no offset: bands of 90 % hold a third of the samples."""
    real, _ = toy(12, seed=6)
    rng = np.random.default_rng(0)
    noisy = real.replace(observed=real.observed + 0.5 * rng.normal(size=real.observed.shape))
    brief = rt.Mixture(training=Training(max_epochs=3))
    with pytest.warns(UserWarning, match="DelayOffset cannot express.*SampledSensor"):
        model = rt.fit_residual(identity, noisy, density=brief, seed=0)
    assert model.fitted.figures["coverage90_y1"] < 0.7


def test_bands_hold_what_the_correction_expresses(fitted: dict[int, rt.ResidualModel]) -> None:
    assert fitted[3].fitted.figures["coverage90_y1"] > 0.75, "without noise, an eighth is exact"


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


@pytest.mark.slow
def test_calibrates_on_healthy_by_default(ibg: rt.Surrogate, emulated: rt.Trajectories) -> None:
    brief, half = rt.Mixture(training=Training(max_epochs=3, batch_size=64)), emulated[::2]
    few = rt.fit_residual(ibg, half, density=brief, seed=0)
    assert few.fitted.figures["trajectories"] == 5
    every = rt.fit_residual(ibg, half, density=brief, seed=0, calibrate_on="all")
    assert every.fitted.figures["trajectories"] == 45
    assert every.scale[1:].max() > 1.5 * few.scale[1:].max(), "the offset absorbs the faults"


@pytest.mark.slow
def test_six_healthy_trajectories_are_enough(ibg: rt.Surrogate, emulated: rt.Trajectories) -> None:
    model = rt.fit_residual(ibg, emulated.with_label("Healthy")[:6], seed=0)
    context, _ = rt.infer_discrepancy(ibg, emulated.with_label("Healthy"), rt.DelayOffset())
    drawn = model.sample(context, generator=torch.Generator().manual_seed(0))
    assert torch.isfinite(drawn).all()
    assert 2 < drawn[..., 0].median() < 9


def test_too_few_to_validate_is_a_warning(ibg: rt.Surrogate, emulated: rt.Trajectories) -> None:
    brief = rt.Mixture(training=Training(max_epochs=3))
    with pytest.warns(UserWarning, match="2 trajectories to calibrate on, at least three"):
        model = rt.fit_residual(ibg, emulated.with_label("Healthy")[:2], density=brief, seed=0)
    assert model.fitted.history["validation"] == []


def test_nothing_to_calibrate_on_is_refused(ibg: rt.Surrogate, emulated: rt.Trajectories) -> None:
    with pytest.raises(rt.InputError, match="at least one trajectory labelled 'Healthy'"):
        rt.fit_residual(ibg, emulated.with_label("Motor_1_Stuck"), seed=0)
    with pytest.raises(rt.InputError, match="'healthy', 'all', or a mapping"):
        rt.fit_residual(ibg, emulated, seed=0, calibrate_on="some")
    still = emulated.replace(commands=np.full_like(emulated.commands, 500))
    with pytest.raises(rt.InputError, match="commands that never change"):
        rt.fit_residual(ibg, still, seed=0)


def test_trajectories_without_a_measurement_are_named(identity: rt.Surrogate) -> None:
    real, _ = toy(12, seed=6)
    mask = np.ones_like(real.mask)
    mask[3] = False
    brief = rt.Mixture(training=Training(max_epochs=3))
    with pytest.warns(UserWarning, match="nothing was measured in 00003"):
        model = rt.fit_residual(identity, real.replace(mask=mask), density=brief, seed=0)
    assert "nothing was measured in 00003" in model.fitted.reason


@pytest.mark.parametrize("value", [3.4e38, 1e19, -1e12])
def test_a_sentinel_is_refused_by_name(
    value: float, ibg: rt.Surrogate, emulated: rt.Trajectories
) -> None:
    few = emulated.with_label("Healthy")[:3]
    observed = few.observed.copy()
    observed[1, 40, 2] = value
    match = rf"calibration.observed: .*{few.outputs.names[2]} in {few.ids[1]}.*by NaN"
    with pytest.raises(rt.InputError, match=match):
        rt.fit_residual(ibg, few.replace(observed=observed), seed=0)


def test_saved_and_loaded_is_the_same(
    rg: rt.ResidualModel, ibg: rt.Surrogate, emulated: rt.Trajectories, tmp_path: Path
) -> None:
    rg.save(tmp_path / "rg")
    back = rt.ResidualModel.load(tmp_path / "rg")
    context, _ = rt.infer_discrepancy(ibg, emulated[:4], back.correction)
    draws = [m.sample(context, generator=torch.Generator().manual_seed(1)) for m in (rg, back)]
    assert torch.equal(*draws)
    assert back.fitted == rg.fitted
    assert back.degrees == rg.degrees
    np.testing.assert_array_equal(back.timing, rg.timing)


def test_damaged_degrees_are_refused(rg: rt.ResidualModel, tmp_path: Path) -> None:
    rg.save(tmp_path / "rg")
    file = tmp_path / "rg" / "model.json"
    about = json.loads(file.read_text())
    degrees = about["degrees"]
    for damaged in ([0.5, *degrees[1:]], degrees[1:], ["1", *degrees[1:]]):
        file.write_text(json.dumps(about | {"degrees": damaged}))
        with pytest.raises(rt.InputError):
            load_residual(tmp_path / "rg")


def test_calibration_data_must_be_of_the_same_system(
    ibg: rt.Surrogate, emulated: rt.Trajectories
) -> None:
    with pytest.raises(rt.InputError, match=r"calibration.rate: expected .* 100.0, got 50.0"):
        rt.fit_residual(ibg, emulated.replace(rate=50.0), seed=0)
    millimetres = rt.Channels(("x", "y", "z"), ("mm",) * 3)
    with pytest.raises(rt.InputError, match=r"calibration.outputs"):
        rt.fit_residual(ibg, emulated.replace(outputs=millimetres), seed=0)
    with pytest.raises(rt.InputError, match="one positive bound for each of delay, offset_x"):
        rt.fit_residual(ibg, emulated, seed=0, bounds=np.ones(3))
    with pytest.raises(rt.InputError, match=r"components: expected .* at least 1, got 0"):
        rt.Mixture(components=0)


def test_what_was_calibrated_on_emulated_data_is_marked(
    rg: rt.ResidualModel, updated: rt.CorrectedTwin, case: rt.Case, tmp_path: Path
) -> None:
    assert rg.emulated
    updated.save(tmp_path / "twin")
    back = rt.CorrectedTwin.load(tmp_path / "twin")
    assert rt.generate(back, case, per_class=1, seed=0).emulated


@pytest.mark.slow
def test_refinement_helps_a_poor_model_on_trajectories_it_never_saw(
    identity: rt.Surrogate,
) -> None:
    """Its offsets are 0.5 ± 0.1, where the true ones are about ±0.2: the weights are given.

    Over 10 refinements the energy of held-out trajectories falls by 0.383, standard deviation
    0.006, and that of others by 0.1866, standard deviation below 0.0001.
    """
    with isolated(0):
        density = rt.Mixture(components=1, hidden=(8,), dropout=0.0)
        channels = {"inputs": identity.inputs, "outputs": identity.outputs}
        before = rt.ResidualModel(rt.DelayOffset(), density, **channels).eval()
    for name, values in {"shift": (2, 0.5), "scale": (0.5, 0.1), "bounds": (6, 1.5)}.items():
        getattr(before, name).copy_(torch.tensor(values))
    calibration, _ = toy(60, seed=4)
    context, _ = rt.infer_discrepancy(identity, calibration, rt.DelayOffset())
    observed = torch.tensor(calibration.observed)
    rows = {"fitted": torch.arange(45), "held_out": torch.arange(45, 60)}
    how = rt.Refinement(
        training=Training(max_epochs=100, batch_size=16, learning_rate=1e-2, patience=100)
    )
    after = copy.deepcopy(before)
    figures = refine(after, context, observed, observed == observed, **rows, how=how, seed=0)
    assert figures["refined"] == 1.0
    assert figures["energy before"] - figures["energy after"] > 0.3
    test, _ = toy(300, seed=5)
    scores = []
    for model in (before, after.eval()):
        twin = rt.CorrectedTwin(identity, model)
        draws = [twin.simulate(test.commands, seed=seed).observed for seed in range(20)]
        pairs = zip(np.stack(draws, axis=1), test.observed, strict=True)
        scores.append(np.mean([energy_score(*pair) for pair in pairs]))
    assert scores[0] - scores[1] > 0.15


@pytest.mark.slow
def test_refinement_that_does_not_help_changes_nothing(identity: rt.Surrogate) -> None:
    calibration, _ = toy(30, seed=6)
    wild = rt.Refinement(
        draws=2, training=Training(max_epochs=1, batch_size=30, learning_rate=50.0, decay="step")
    )
    models = [
        rt.fit_residual(
            identity,
            calibration,
            rt.DelayOffset(),
            rt.Mixture(training=Training(max_epochs=20), refinement=how),
            seed=0,
        )
        for how in (None, wild)
    ]
    assert models[1].fitted.figures["refined"] == 0.0
    one, other = (model.state_dict() for model in models)
    assert all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.slow
def test_faulty_trajectories_calibrate_without_their_fault_in_the_discrepancy(
    exact, emulated: rt.Trajectories, case: rt.Case
) -> None:
    """All nine classes, faults named: offsets as small as those of healthy ones alone.

    Inferred with the twin itself, since a surrogate's error would be part of them.
    """
    some = emulated[np.flatnonzero(np.arange(len(emulated)) % 10 < 3)]
    healthy = some.with_label("Healthy")
    named = [case.faults[label] for label in some.labels]
    size = {}
    for name, used, faults in (
        ("healthy", healthy, None),
        ("named", some, named),
        ("all", some, None),
    ):
        context, found = rt.infer_discrepancy(exact, used, case.correction, faults=faults)
        free = torch.tensor(context.segments.start)[..., None] < context.frozen[:, None]
        free = free & (context.faulty_commands == context.commands).all(dim=1)[:, None]
        size[name] = found.z[..., 1:5][free].square().mean().sqrt()
    assert size["named"] < 1.3 * size["healthy"]
    assert size["all"] > 1.3 * size["named"]


@pytest.mark.slow
def test_what_is_calibrated_on_faulty_trajectories_counts_them(
    ibg: rt.Surrogate, emulated: rt.Trajectories, case: rt.Case
) -> None:
    brief = rt.Mixture(training=Training(max_epochs=3))
    fitted = rt.fit_residual(
        ibg, emulated[::10], case.correction, brief, seed=0, calibrate_on=case.faults
    )
    assert fitted.fitted.figures["trajectories"] == 9
