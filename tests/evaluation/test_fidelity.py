"""Fidelity of generators whose errors are known: the true one, biased, too wide, too narrow.

The toy's output is its command plus a correlated noise, as the residual of a real system is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import scoringrules
from scipy.stats import ks_2samp, norm

import retwin as rt
from retwin.evaluation.fidelity.figures import Fidelity
from retwin.evaluation.fidelity.measure import measure_fidelity, measure_widening
from retwin.twins.twin import simulate_in_chunks

STEPS, DRAWS = 60, 100
OUTPUTS = rt.Channels(("x", "y"), ("m", "m"))


@dataclass(frozen=True)
class Walk:
    """Commands plus `shift` and stationary noise; `correlation` is its lag-1 autocorrelation."""

    width: float = 1.0
    shift: float = 0.0
    correlation: float = 0.9
    inputs: rt.Channels = rt.Channels(("u", "v"), ("m", "m"))  # noqa: RUF009 - frozen
    outputs: rt.Channels = OUTPUTS
    rate: float = 10.0

    def simulate(self, commands, *, faults=None, seed, progress=None) -> rt.Trajectories:
        rng = np.random.default_rng(seed)

        def run(chunk):
            fresh = rng.standard_normal(chunk.commands.shape)
            walk = fresh.copy()
            innovation = np.sqrt(1 - self.correlation**2)
            for t in range(1, walk.shape[1]):
                walk[:, t] = self.correlation * walk[:, t - 1] + innovation * fresh[:, t]
            return chunk.commands, chunk.commands + self.shift + self.width * walk

        return simulate_in_chunks(self, run, commands, faults, seed=seed, progress=progress)


def measured(count: int, *, seed: int = 1, steps: int = STEPS) -> rt.Trajectories:
    """Trajectories of the true walk: two ramps and holds."""
    ramp = np.interp(np.arange(steps), [0, 5, 15, steps / 2, steps / 2 + 10], [0, 0, 1, 1, 3])
    commands = np.repeat(np.stack([ramp, -ramp], axis=1)[None], count, axis=0)
    return Walk().simulate(commands, seed=seed)


@pytest.fixture(scope="module")
def real() -> rt.Trajectories:
    return measured(30)


@pytest.fixture(scope="module")
def truth(real: rt.Trajectories) -> Fidelity:
    rivals = {
        "shifted": Walk(shift=0.7),
        "wide": Walk(2.0),
        "narrow": Walk(0.5),
        "point": Walk(0.0),
    }
    return measure_fidelity(Walk(), real, draws=DRAWS, seed=2, against=rivals)


@pytest.mark.slow
def test_the_truth_is_calibrated(truth: Fidelity) -> None:
    figures = truth.figures
    for level in (50, 90):
        coverage = figures[f"coverage{level}"]
        low, high = coverage.interval
        assert high - low < 0.15
        assert abs(coverage.value - level / 100) < high - low
    assert figures["pit"].value < 0.12
    assert figures["pit"].p > 0.05
    shares, low, high = truth.pit_shares()
    assert shares.sum() == pytest.approx(1)
    assert np.mean((low <= shares) & (shares <= high)) > 0.7
    for name in ("x", "y"):
        assert figures[f"ks/noise_{name}"].p > 0.05
    low, high = figures["auroc"].interval
    assert low < 0.5 < high


def test_the_truth_scores_best(truth: Fidelity) -> None:
    for rival in truth.rivals:
        for score in ("energy", "crps"):
            below = truth.figures[f"{score}_below/{rival}"]
            assert below.interval[0] > 0, (score, rival)
        assert truth.figures["energy"].value < truth.figures[f"energy/{rival}"].value


@pytest.mark.parametrize(
    ("twin", "narrower", "auroc"),
    [(Walk(0.5), True, 0.8), (Walk(2.0), False, 0.8), (Walk(correlation=0.0), None, 0.95)],
    ids=["too narrow", "too wide", "white"],
)
def test_other_generators_are_detected(
    real: rt.Trajectories, twin: Walk, narrower: bool | None, auroc: float
) -> None:
    figures = measure_fidelity(twin, real[:12], draws=DRAWS, seed=3).figures
    coverage = figures["coverage90"]
    if narrower is not None:
        # Twelve trajectories within a band do not exclude that a thirteenth is outside.
        assert coverage.interval[1] < 0.85 if narrower else coverage.value > 0.95
        assert figures["pit"].p <= 0.02
    assert figures["ks/noise_x"].p == pytest.approx(0.05)
    assert figures["auroc"].value > auroc
    assert figures["auroc"].interval[0] > 0.5


def test_dependent_samples_do_not_make_the_truth_look_bad() -> None:
    """Against independent samples, the p-values of the truth would pile up at zero."""
    p = [
        measure_fidelity(Walk(correlation=0.99), measured_walk(0.99, seed), draws=40, seed=seed)
        .figures["pit"]
        .p
        for seed in range(12)
    ]
    assert np.mean(np.array(p) <= 0.1) <= 0.34
    assert max(p) > 0.5


def measured_walk(correlation: float, seed: int) -> rt.Trajectories:
    some = measured(4, seed=seed)
    return Walk(correlation=correlation).simulate(some.commands, seed=100 + seed)


def test_crps_is_that_of_the_gaussian_in_closed_form() -> None:
    real = measured(3)
    found = measure_fidelity(Walk(1.5), real, draws=2000, seed=4)
    wanted = scoringrules.crps_normal(real.observed, real.nominal, 1.5).mean(axis=1)
    np.testing.assert_allclose(found.crps, wanted, rtol=0.06)
    error = (real.observed - real.nominal) / 1.5
    by_hand = 1.5 * (error * (2 * norm.cdf(error) - 1) + 2 * norm.pdf(error) - 1 / np.sqrt(np.pi))
    np.testing.assert_allclose(wanted, by_hand.mean(axis=1), rtol=1e-9)


def test_a_point_forecast_has_the_absolute_error_and_the_distance(real: rt.Trajectories) -> None:
    found = measure_fidelity(Walk(0.0), real[:2], draws=20, seed=0)
    error = (real.observed - real.nominal)[:2]
    np.testing.assert_allclose(found.crps, np.abs(error).mean(axis=1))
    distance = np.sqrt((error**2).sum(axis=(1, 2)) / STEPS)
    np.testing.assert_allclose(found.energy, distance)


def test_energy_score_is_scoringrules(real: rt.Trajectories) -> None:
    found = measure_fidelity(Walk(), real[:1], draws=25, seed=5)
    seed = int(np.random.SeedSequence(5).generate_state(2)[0])
    made = Walk().simulate(np.repeat(real.commands[:1], 25, axis=0), seed=seed).observed
    wanted = scoringrules.es_ensemble(
        real.observed[0].ravel(), made.reshape(25, -1), estimator="fair"
    )
    assert found.energy[0] == pytest.approx(wanted / np.sqrt(STEPS))


def test_outputs_of_different_units_are_standardised(real: rt.Trajectories) -> None:
    twin = Walk(outputs=rt.Channels(("x", "y"), ("m", "deg")))
    mixed = real[:2].replace(outputs=twin.outputs)
    found = measure_fidelity(twin, mixed, draws=30, seed=0)
    plain = measure_fidelity(Walk(), real[:2], draws=30, seed=0)
    np.testing.assert_allclose(found.crps, plain.crps)
    # The nominal outputs are mirrored, so both have the same scale.
    unit = real.nominal[0].std(axis=0)
    np.testing.assert_allclose(found.energy, plain.energy / unit[0])


@pytest.mark.slow
def test_widening_is_one_for_the_truth_and_more_for_one_too_narrow() -> None:
    kept, others = measured(60, seed=7), measured(60, seed=8)
    assert 1 <= measure_widening(Walk(), kept, draws=200, seed=0) <= 1.15
    assert measure_widening(Walk(2.0), kept, draws=200, seed=0) == 1, "bands are not narrowed"
    narrow = Walk(0.5)
    factor = measure_widening(narrow, kept, draws=200, seed=0)
    assert factor == pytest.approx(2, rel=0.1)
    figures = measure_fidelity(narrow, others, draws=200, seed=1, widening=factor).figures
    assert figures["coverage90"].value < 0.7
    assert figures["coverage90_widened"].value == pytest.approx(0.9, abs=0.04)
    assert measure_widening(Walk(0.0), kept[:2], draws=20, seed=0) == np.inf


def test_missing_samples_are_left_out(real: rt.Trajectories) -> None:
    some = real[:2]
    broken = some.observed.copy()
    broken[:, 20:30, 0] = 1e6
    mask = some.mask.copy()
    mask[:, 20:30, 0] = False
    seen = np.r_[0:20, 30:STEPS]
    found = measure_fidelity(Walk(0.0), some.replace(observed=broken, mask=mask), draws=20, seed=0)
    error = np.abs(some.observed - some.nominal)[:, seen]
    np.testing.assert_allclose(found.crps, error.mean(axis=1))
    assert found.features.max() < 10


def test_ks_of_segment_values_is_scipys(truth: Fidelity) -> None:
    few = replace(truth, segment_values=truth.segment_values[:, :, :1])
    values = few.segment_values[:, :, 0, 0]
    wanted = ks_2samp(values[:, 0], values[:, 1:].ravel()).statistic
    # The grid has 512 places for 800 values.
    assert few.figures["ks/noise_x"].value == pytest.approx(wanted, abs=0.005)


def test_compares_at_the_given_rate(real: rt.Trajectories) -> None:
    found = measure_fidelity(Walk(), real[:2], draws=20, seed=0, rate=5.0)
    assert (found.rate, found.bands.shape) == (5.0, (2, 5, STEPS // 2, 2))
    np.testing.assert_array_equal(found.observed, real.observed[:2, ::2])


def test_same_seed_same_bytes_kept_joined_and_read_again(
    real: rt.Trajectories, tmp_path: Path
) -> None:
    parts = [
        measure_fidelity(Walk(), real[part], draws=20, seed=seed, against={"wide": Walk(2.0)})
        for seed, part in ((0, slice(0, 3)), (1, slice(3, 5)), (0, slice(0, 3)))
    ]
    assert parts[0].as_dict() == parts[2].as_dict()
    both = Fidelity.concatenate(parts[:2])
    both.save(tmp_path / "found.npz")
    back = Fidelity.load(tmp_path / "found.npz")
    assert back.as_dict() == both.as_dict()
    assert back.ids.tolist() == real.ids[:5].tolist()
    assert back.figures["energy"].value == pytest.approx(
        np.concatenate([part.energy for part in parts[:2]]).mean()
    )
    assert "auroc" not in back.figures, "five trajectories train no classifier"


def test_bands_widened_by_two_trajectories_are_hardly_too_narrow() -> None:
    """Bands of 0.7 times the true width, widened by pairs, cover 0.89 on average, not 0.87.

    The mean is compared with 0.87 less five standard errors, so that chance does not fail it.
    """
    covered = []
    for seed in range(30):
        factor = measure_widening(Walk(0.7), measured(2, seed=seed), draws=60, seed=seed)
        others = measured(4, seed=100 + seed)
        low, high = (others.nominal + sign * 0.7 * factor * norm.ppf(0.95) for sign in (-1, 1))
        covered.append(np.mean((low <= others.observed) & (others.observed <= high)))
    error = np.std(covered, ddof=1) / np.sqrt(30)
    assert error < 0.02
    assert np.mean(covered) > 0.87 - 5 * error


@pytest.mark.parametrize("count", [1, 4])
def test_few_trajectories_have_no_interval(real: rt.Trajectories, count: int) -> None:
    figures = measure_fidelity(Walk(), real[:count], draws=20, seed=0).figures
    assert all(each.interval is None for each in figures.values())
    assert np.isfinite([each.value for each in figures.values()]).all()


@pytest.mark.slow
def test_a_corrected_twin_against_its_own_draws(
    exact_updated: rt.CorrectedTwin, emulated: rt.Trajectories
) -> None:
    """The corrected twin itself as the real system: z* is compared, and the truth is found.

    Nothing in it is trained, so the figures are the same on any machine.
    """
    commands = emulated.with_label("Healthy").commands[:6]
    real = exact_updated.simulate(commands, seed=11)
    found = measure_fidelity(exact_updated, real, draws=50, seed=12, rate=10.0)
    assert found.segment_channels.names[:2] == ("delay", "offset_x")
    figures = found.figures
    assert figures["ks/delay"].p > 0.05
    assert figures["coverage90/offset_x"].value > 0.75
    assert figures["crps_below/mean_only"].value > 0
    assert 0.75 < figures["coverage90"].value < 0.99
    assert str(found).endswith("(6 trajectories)")


def test_mean_only_is_the_mean_of_the_draws(
    exact_updated: rt.CorrectedTwin, emulated: rt.Trajectories
) -> None:
    """At rest outputs are nominal ones plus the offset: 2 mm, and of 400 draws as much on average.

    The 95 % of a mean of 400 times 5 movements are 3 mm / sqrt(2000) wide; five times that is far
    less than the offset.
    """
    twin = replace(exact_updated, random=False)
    assert isinstance(twin, rt.Twin)
    commands = emulated.with_label("Healthy").commands[:1]
    one, other = (twin.simulate(commands, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(one.observed, other.observed)
    rest = np.arange(150, 1000, 200)
    np.testing.assert_allclose(one.residual[:, rest], 2e-3, atol=1e-6)
    draws = exact_updated.simulate(commands.repeat(400, axis=0), seed=0).residual[:, rest]
    np.testing.assert_allclose(draws.mean(axis=(0, 1)), 2e-3, atol=5 * 3e-3 / np.sqrt(2000))
    np.testing.assert_allclose(draws.std(axis=(0, 1)), 3e-3, rtol=5 / np.sqrt(2 * 2000))


@pytest.mark.parametrize(
    ("change", "how", "message"),
    [
        ({"labels": np.array(["Healthy", "Stuck"])}, {}, "1 of them with a fault"),
        ({"mask": np.zeros((2, STEPS, 2), dtype=bool)}, {}, "one that was never measured"),
        ({"rate": 20.0}, {}, r"trajectories\.rate: expected that of the twin, 10"),
        ({}, {"draws": 5}, "at least 19"),
        ({}, {"rate": 3.0}, "a whole part of it"),
        ({}, {"rate": 0.0}, "a whole part of it"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    real: rt.Trajectories, change: dict, how: dict, message: str
) -> None:
    with pytest.raises(rt.InputError, match=message):
        measure_fidelity(Walk(), real[:2].replace(**change), **{"draws": 20, "seed": 0, **how})
    with pytest.raises(rt.InputError, match="healthy trajectories, one at least"):
        measure_fidelity(Walk(), real[[]], seed=0)
