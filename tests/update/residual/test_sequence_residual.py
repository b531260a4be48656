"""The RG per sample on a toy of known distribution: a filtered input plus an autoregression."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import retwin as rt
from retwin.nets.mixtures import GaussianMixture
from retwin.nets.networks import LSTM, TCN
from retwin.nets.training import Training
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Additive
from retwin.update.residual import SequenceMixture, SequenceResidual, fit_residual, load_residual
from retwin.update.residual.sequence import shrunk
from retwin.update.residual.sequence_fitting import held_out_parts

STEPS = 800
PERSISTENCE, SPREAD = 0.8, 0.2
SMALL = SequenceMixture(
    network=LSTM(8),
    components=1,
    members=3,
    block=40,
    window=120,
    burn_in=30,
    dropout=0.0,
    training=Training(max_epochs=40, batch_size=6, learning_rate=1e-2),
)


def commands_of(n: int, seed: int) -> np.ndarray:
    white = np.random.default_rng(seed).normal(size=(n, STEPS, 1))
    return lfilter([0.5], [1, -0.85], white, axis=1).astype(np.float32)


def true_discrepancy(commands: np.ndarray) -> np.ndarray:
    """What the toy's twin lacks: a lag of the input, (n, T, 1)."""
    return lfilter([0.3], [1, -0.7], commands, axis=1)


def measured(twin: rt.Surrogate, n: int, seed: int) -> rt.Trajectories:
    commands = commands_of(n, seed)
    white = np.random.default_rng(seed + 1).normal(size=(n, STEPS, 1))
    noise = SPREAD * lfilter([np.sqrt(1 - PERSISTENCE**2)], [1, -PERSISTENCE], white, axis=1)
    made = twin.simulate(commands, seed=0)
    return made.replace(
        observed=made.nominal + (true_discrepancy(commands) + noise).astype(np.float32)
    )


@pytest.fixture(scope="module")
def twin() -> rt.Surrogate:
    """y = u, exactly."""
    channels = rt.Channels(("u",), ("1",)), rt.Channels(("y",), ("1",))
    surrogate = rt.Surrogate(rt.MLP(()), inputs=channels[0], outputs=channels[1], rate=1.0)
    with torch.no_grad():
        surrogate.network[0].weight.fill_(1.0)
        surrogate.network[0].bias.fill_(0.0)
    return surrogate.eval()


@pytest.fixture(scope="module")
def record(twin: rt.Surrogate) -> rt.Trajectories:
    return measured(twin, 1, 10)


@pytest.fixture(scope="module")
def rg(twin: rt.Surrogate, record: rt.Trajectories) -> SequenceResidual:
    return fit_residual(twin, record, Additive(), SMALL, seed=0)


def test_one_record_teaches_the_discrepancy(twin: rt.Surrogate, rg: SequenceResidual) -> None:
    """On inputs it has not seen, its error is below a quarter of the discrepancy.

    Over 12 retrainings the ratio is 0.130, standard deviation 0.007.
    """
    commands = commands_of(5, 99)
    z = rg.mean(rg.context(twin, commands)).numpy()
    error = np.sqrt(np.square(z - true_discrepancy(commands)).mean())
    assert error < 0.25 * true_discrepancy(commands).std()
    assert float(rg.trust) > 0.9


def test_draws_have_the_distribution_and_the_autocorrelation_of_the_noise(
    twin: rt.Surrogate, rg: SequenceResidual
) -> None:
    """The limits are eight standard deviations away from what 12 retrainings give.

    The spread is 0.202 with a standard deviation of 0.009; the autocorrelation, drawn as well as
    fitted, 0.767 with one of 0.010.
    """
    commands = np.repeat(commands_of(1, 98), 300, axis=0)
    context = rg.context(twin, commands)
    draws = rg.sample(context, generator=torch.Generator().manual_seed(0)).numpy()[..., 0]
    centred = draws - draws.mean(axis=0)
    assert centred.std() == pytest.approx(SPREAD, rel=0.35)
    alike = (centred[:, 1:] * centred[:, :-1]).mean() / np.square(centred).mean()
    assert alike == pytest.approx(PERSISTENCE, abs=0.12)
    assert float(rg.persistence) == pytest.approx(PERSISTENCE, abs=0.12)


def test_bands_hold_records_it_has_not_seen(twin: rt.Surrogate, rg: SequenceResidual) -> None:
    """Over 12 retrainings the coverage is 0.880, standard deviation 0.0135: limits at six of them.

    On held-out parts it is 0.909, standard deviation 0.007.
    """
    fresh = measured(twin, 5, 50)
    inside = []
    for i in range(len(fresh)):
        context = rg.context(twin, np.repeat(fresh.commands[[i]], 200, axis=0))
        draws = rg.sample(context, generator=torch.Generator().manual_seed(i)).numpy()
        low, high = np.quantile(draws, [0.05, 0.95], axis=0)
        z = fresh.residual[i]
        inside.append((low <= z) & (z <= high))
    assert 0.80 < np.mean(inside) < 0.96
    assert 0.82 < rg.fitted.figures["coverage90"] < 0.98


@pytest.mark.slow
def test_a_discrepancy_that_the_past_does_not_predict_is_not_trusted(twin: rt.Surrogate) -> None:
    """One slow wave beside the input: members learn it by heart, and it holds nowhere else."""
    made = twin.simulate(commands_of(1, 20), seed=0)
    wave = np.sin(np.arange(STEPS) / 60)[None, :, None].astype(np.float32)
    quick = replace(SMALL, members=4, block=100, margin=50)
    rg = fit_residual(twin, made.replace(observed=made.nominal + wave), Additive(), quick, seed=0)
    figures = rg.fitted.figures
    assert float(rg.trust) == figures["trust_residual_y"] < 0.6
    assert figures["rmse_residual_y"] <= figures["rmse_residual_y/constant"] + 1e-6
    z = rg.mean(rg.context(twin, commands_of(5, 99)))
    assert z.std() < 0.4 * wave.std()


def test_trust_shrinks_the_mean_and_leaves_the_shape() -> None:
    mixture = GaussianMixture(
        torch.tensor([0.0, 0.0]), torch.tensor([[1.0], [5.0]]), torch.ones(2, 1, 1)
    )
    (half,) = shrunk([mixture], [torch.tensor([1.0])], [torch.tensor([0.5])])
    torch.testing.assert_close(half.mean, torch.tensor([2.0]))
    torch.testing.assert_close(half.means, mixture.means - 1.0)
    torch.testing.assert_close(half.variance, mixture.variance)


def test_each_output_is_widened_by_its_own_factor(tmp_path: Path) -> None:
    torch.manual_seed(0)
    channels = rt.Channels(("u",), ("1",)), rt.Channels(("y", "w"), ("1", "m"))
    rg = SequenceResidual(Additive(), SMALL, inputs=channels[0], outputs=channels[1]).eval()
    features = torch.randn(2, 40, 3)
    with torch.no_grad():
        before = rg.distributions(features)[0]
        rg.spread.copy_(torch.tensor([2.0, 5.0]))
        after = rg.distributions(features)[0]
    assert before.factor[..., 1, 0].abs().max() > 1e-3, "outputs that are correlated"
    ratio = after.component_distribution.stddev / before.component_distribution.stddev
    torch.testing.assert_close(ratio, rg.spread.expand_as(ratio))
    rg.save(tmp_path / "rg")
    torch.testing.assert_close(load_residual(tmp_path / "rg").spread, rg.spread)


def test_without_persistence_draws_are_white(twin: rt.Surrogate, record: rt.Trajectories) -> None:
    quick = replace(
        SMALL,
        persistent=False,
        members=2,
        refit=False,
        training=Training(max_epochs=2, batch_size=6),
    )
    rg = fit_residual(twin, record, Additive(), quick, seed=0)
    context = rg.context(twin, np.repeat(record.commands, 200, axis=0))
    draws = rg.sample(context, generator=torch.Generator().manual_seed(0)).numpy()[..., 0]
    # Members differ from draw to draw: their means are no noise.
    fresh = np.diff(draws - draws.mean(axis=0), axis=1)
    assert np.mean(fresh[:, 1:] * fresh[:, :-1]) / np.square(fresh).mean() < -0.35
    assert not rg.persistence.any()


def test_the_distribution_is_a_density(twin: rt.Surrogate, rg: SequenceResidual) -> None:
    distribution = rg(rg.context(twin, commands_of(1, 5)[:, :50]))
    grid = torch.linspace(-8, 8, 4001)
    total = (
        torch.stack([distribution.log_prob(v.expand(1, 50, 1)) for v in grid]).exp().sum(0)
        * 16
        / 4000
    )
    torch.testing.assert_close(total, torch.ones(1, 50), atol=1e-3, rtol=0)


def test_it_is_causal(twin: rt.Surrogate, rg: SequenceResidual) -> None:
    commands = commands_of(1, 7)
    other = commands.copy()
    other[:, 400:] += 1.0
    one, two = (rg.mean(rg.context(twin, each)) for each in (commands, other))
    torch.testing.assert_close(one[:, :400], two[:, :400], atol=1e-6, rtol=0)
    assert (one[:, 401:] != two[:, 401:]).any()


def test_what_is_not_measured_does_not_count(twin: rt.Surrogate, record: rt.Trajectories) -> None:
    quick = replace(SMALL, members=2, training=Training(max_epochs=2, batch_size=6))
    mask = np.random.default_rng(0).random(record.mask.shape) > 0.2
    fits = [
        fit_residual(
            twin,
            record.replace(observed=np.where(mask, record.observed, value), mask=mask),
            Additive(),
            quick,
            seed=0,
        )
        for value in (0.0, 50.0)
    ]
    context = fits[0].context(twin, record.commands)
    torch.testing.assert_close(fits[0].mean(context), fits[1].mean(context))


def test_parts_are_held_out_once_and_by_whole_records_where_there_are_enough() -> None:
    one = held_out_parts(torch.ones(1, 1000, dtype=torch.bool), SequenceMixture())
    assert (one.sum(dim=0) == 1).all()
    assert one.flatten(1).any(dim=1).all()
    every = torch.ones(12, 100, dtype=torch.bool)
    several = held_out_parts(every, SequenceMixture(members=4))
    assert (several.all(dim=2) == several.any(dim=2)).all()
    assert (several.any(dim=2).sum(dim=1) == 3).all()


def test_the_corrected_twin_takes_it(
    twin: rt.Surrogate, rg: SequenceResidual, tmp_path: Path
) -> None:
    """It simulates, comes back from disk, and gives the same bytes for the same seed."""
    updated = CorrectedTwin(twin, rg)
    commands = commands_of(3, 3)
    first = updated.simulate(commands, seed=4)
    updated.save(tmp_path / "model")
    again = CorrectedTwin.load(tmp_path / "model").simulate(commands, seed=4)
    assert first.observed.tobytes() == again.observed.tobytes()
    assert first.observed.tobytes() != updated.simulate(commands, seed=5).observed.tobytes()
    assert load_residual(tmp_path / "model" / "residual").fitted == rg.fitted
    mean = replace(updated, random=False).simulate(commands, seed=4)
    np.testing.assert_allclose(mean.residual, rg.mean(rg.context(twin, commands)), atol=1e-6)


def test_its_fidelity_is_measured(twin: rt.Surrogate, rg: SequenceResidual) -> None:
    """Over 12 retrainings: coverage 0.903, standard deviation 0.011; CRPS 0.287 below, 0.003."""
    found = rt.measure_fidelity(CorrectedTwin(twin, rg), measured(twin, 3, 70), draws=40, seed=0)
    assert 0.75 < found.figures["coverage90"].value <= 1.0
    assert found.figures["crps_below/mean_only"].value > 0.1


def test_the_same_seed_gives_the_same_weights(twin: rt.Surrogate, record: rt.Trajectories) -> None:
    quick = replace(
        SMALL, network=TCN(8, 3, 3), members=2, training=Training(max_epochs=2, batch_size=6)
    )
    one, two = (fit_residual(twin, record, Additive(), quick, seed=3) for _ in range(2))
    for name, value in one.state_dict().items():
        assert value.equal(two.state_dict()[name]), name


def test_operator_and_density_must_belong_together(
    twin: rt.Surrogate, record: rt.Trajectories
) -> None:
    with pytest.raises(rt.InputError, match="SequenceMixture"):
        fit_residual(twin, record, Additive(), seed=0, segments="path")
    with pytest.raises(rt.InputError, match="Additive"):
        fit_residual(twin, record, rt.DelayOffset(), SMALL, seed=0, segments="path")
    with pytest.raises(rt.InputError, match="burn_in below window"):
        SequenceMixture(window=10, burn_in=10)
    late = np.broadcast_to(np.arange(STEPS)[None, :, None] > STEPS - 20, record.mask.shape)
    hidden = record.replace(mask=late)
    with pytest.raises(rt.InputError, match="some parts with none"):
        fit_residual(twin, hidden, Additive(), SMALL, seed=0)
