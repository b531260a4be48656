"""Eq. 3: posteriors that are known in closed form are found, by chains and by a network."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest, multivariate_normal
from test_readme import python_of
from toys import FAST, LAG, LINE, commands, measured

import retwin as rt
from retwin.testing import TWIN_CHECKS, TwinSubject
from retwin.update.identification import (
    MCMC,
    NPE,
    Noise,
    Posterior,
    PosteriorTwin,
    calibration_ranks,
    identify,
)
from retwin.update.identification.bayes import SIGNIFICANCE
from retwin.update.identification.problem import Summaries

WHITE = Noise(discrepancy=False)
A, B = 1.0, -0.5


def closed_form(observed: rt.Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation of a and b: a flat prior, the noise's scale integrated out."""
    design = observed.commands.reshape(-1, 2)
    best, rest, *_ = np.linalg.lstsq(design, observed.observed.ravel())
    freedom = len(design) - 2
    variance = rest[0] / (freedom - 2) * np.linalg.inv(design.T @ design)
    return best, np.sqrt(np.diag(variance))


@pytest.fixture(scope="module")
def observed() -> rt.Trajectories:
    return measured(LINE, 0.5, seed=1, count=2, a=A, b=B)


@pytest.fixture(scope="module")
def chains(observed: rt.Trajectories) -> Posterior:
    return identify(FAST, observed, MCMC(16, 600, 200, 1, WHITE), seed=0)


def test_chains_find_the_posterior_of_the_linear_gaussian_model(
    observed: rt.Trajectories, chains: Posterior
) -> None:
    mean, deviation = closed_form(observed)
    # The Monte-Carlo error of the mean is the deviation over the root of the independent samples.
    margin = 4 * deviation / np.sqrt(chains.figures["independent"])
    assert (np.abs(chains.samples.mean(axis=0) - mean) < margin).all()
    assert chains.samples.std(axis=0) == pytest.approx(deviation, rel=0.12)
    assert chains.scales["noise"].mean() == pytest.approx(0.43, abs=0.03)
    assert SIGNIFICANCE < chains.misspecified <= 1, "no warning of data that the model did make"
    low, high = chains.interval(0.9)["a"]
    assert high - low == pytest.approx(2 * 1.645 * deviation[0], rel=0.15)


@pytest.mark.slow
def test_a_network_finds_it_too(observed: rt.Trajectories, chains: Posterior) -> None:
    mean, deviation = closed_form(observed)
    found = identify(FAST, observed, NPE(300, 2, noise=WHITE), seed=1)
    assert (np.abs(found.samples.mean(axis=0) - mean) < 0.5 * deviation).all()
    assert found.samples.std(axis=0) == pytest.approx(deviation, rel=0.25)
    assert found.twin_runs < chains.twin_runs / 4
    assert not list(Path.cwd().glob("sbi-logs"))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_draws_over_processes(observed: rt.Trajectories) -> None:
    progress: list[float] = []
    method = MCMC(8, 40, 20, 1, WHITE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # so few steps are too few
        first, second = (
            identify(FAST, observed, method, seed=4, processes=processes, progress=progress.append)
            for processes in (1, 2)
        )
    assert first.samples.tobytes() == second.samples.tobytes()
    assert progress[-1] == 1.0


@pytest.mark.parametrize("seen", [1.0, 0.7])
def test_the_filter_gives_the_density_of_the_gaussian_process(seen: float) -> None:
    noise, rng = Noise(), np.random.default_rng(0)
    residual = rng.normal(size=(1, 2, 12, 1))
    mask = rng.random((2, 12, 1)) < seen
    scales = np.array([0.3, 0.8, 0.7])
    got = noise.log_likelihood(residual * mask, mask, np.log(scales)[None], 0.1)
    time = 0.1 * np.arange(12)
    kernel = 0.64 * np.exp(-np.abs(time[:, None] - time) / 0.7) + 0.09 * np.eye(12)
    wanted = 0.0
    for one, there in zip(residual[0, :, :, 0], mask[:, :, 0], strict=True):
        gaussian = multivariate_normal(cov=kernel[np.ix_(there, there)])
        wanted += gaussian.logpdf(one[there])
    assert got == pytest.approx([wanted])


def test_noise_is_drawn_as_it_is_scored() -> None:
    rng = np.random.default_rng(0)
    logs = np.log([[0.3, 0.8, 0.7]])
    drawn = Noise().draw(rng, np.repeat(logs, 4000, axis=0), 8, 1, 0.1)[..., 0]
    time = 0.1 * np.arange(8)
    kernel = 0.64 * np.exp(-np.abs(time[:, None] - time) / 0.7) + 0.09 * np.eye(8)
    assert np.cov(drawn.T) == pytest.approx(kernel, abs=0.06)


@pytest.mark.slow
def test_student_noise_forgives_outliers() -> None:
    clean = measured(LINE, 0.1, seed=2, count=2, a=A, b=B)
    spoilt = clean.observed.copy()
    spoilt[0, 5::12] += 6.0
    observed = clean.replace(observed=spoilt)

    def error(noise: Noise) -> float:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = identify(FAST, observed, MCMC(8, 300, 150, 1, noise), seed=0)
        return abs(found.mean["a"] - A) + abs(found.mean["b"] - B)

    assert error(Noise(discrepancy=False, degrees=3)) < 0.05 < error(WHITE)


def test_steps_reveal_a_parameter_that_a_constant_error_hides() -> None:
    slope = np.linspace(0, 1, 50)
    paths = (slope[:, None] * np.arange(40) / 40)[:, None, :, None]
    summaries = Summaries.of(paths)
    shifted = paths + 10 * np.random.default_rng(0).normal(size=(50, 1, 1, 1))
    path, step, *_ = summaries(shifted, np.ones((1, 40, 1), dtype=bool)).T
    assert abs(np.corrcoef(path, slope)[0, 1]) < 0.5
    assert abs(np.corrcoef(step, slope)[0, 1]) > 0.999


@pytest.mark.slow
def test_ranks_of_the_truth_are_uniform() -> None:
    method = MCMC(8, 80, 60, 1, WHITE)
    ranks = calibration_ranks(FAST, commands(1, 30), method, count=20, seed=0)
    assert ranks.shape == (20, 2)
    assert all(kstest(each, "uniform").pvalue > 0.01 for each in ranks.T)


def drifting() -> rt.Trajectories:
    """Data of the line with an output error that is correlated over about a second."""
    observed = measured(LINE, 0.0, seed=3, count=2, a=A, b=B)
    logs = np.log([[0.05, 0.7, 1.0]] * 2)
    error = Noise().draw(np.random.default_rng(3), logs, observed.steps, 1, 1 / observed.rate)
    return observed.replace(observed=observed.observed + error)


@pytest.mark.slow
def test_misspecification_is_reported_and_explained_by_a_discrepancy() -> None:
    observed = drifting()
    with pytest.warns(UserWarning, match="misspecified"):
        blind = identify(FAST, observed, MCMC(12, 200, 120, 1, WHITE), seed=0)
    assert blind.misspecified < 0.02
    assert "misspecified" in blind.reason
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # so few steps may be too few
        aware = identify(FAST, observed, MCMC(12, 200, 120, 1), seed=0)
    assert aware.misspecified > 0.1
    assert np.median(aware.scales["discrepancy"]) > 5 * np.median(aware.scales["noise"])
    assert aware.scales["noise"].mean() < blind.scales["noise"].mean() / 3


def test_bands_of_the_updated_twin_hold_held_out_trajectories() -> None:
    every = measured(LINE, 0.5, seed=5, count=24, a=A, b=B)
    found = identify(FAST, every[:4], MCMC(16, 300, 150, 1, WHITE), seed=0)
    fidelity = rt.measure_fidelity(found.twin, every[4:], draws=60, seed=0)
    inside = (fidelity.observed >= fidelity.bands[:, 0]) & (
        fidelity.observed <= fidelity.bands[:, -1]
    )
    assert inside.mean() == pytest.approx(0.9, abs=0.04)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_draws_from_the_prior_can_be_all_simulations(observed: rt.Trajectories) -> None:
    method = NPE(simulations=50, rounds=1, samples=100, max_epochs=1, noise=WHITE)
    found = identify(FAST, observed, method, seed=0)
    assert found.figures["kept"] == 200
    assert len(found.samples) == 100


def test_bad_input_is_named(observed: rt.Trajectories, monkeypatch: pytest.MonkeyPatch) -> None:
    for match, call in {
        "degrees": lambda: Noise(degrees=4.0),
        "walkers: expected a whole": lambda: MCMC(walkers=0),
        "simulations": lambda: NPE(simulations=3),
        "components: expected a whole": lambda: NPE(components=0),
        "learning_rate": lambda: NPE(learning_rate=0.0),
        "tail": lambda: NPE(tail=0.5),
        "at least 6": lambda: identify(FAST, observed, MCMC(walkers=4, noise=WHITE), seed=0),
        "healthy": lambda: identify(
            FAST, observed.replace(labels=np.full(len(observed), "Stuck")), MCMC(), seed=0
        ),
        "method: expected LeastSquares": lambda: identify(FAST, observed, NPE, seed=0),  # type: ignore[call-overload]
    }.items():
        with pytest.raises(rt.InputError, match=match):
            call()
    for name, method in {"emcee": MCMC(noise=WHITE), "sbi.neural_nets": NPE(noise=WHITE)}.items():
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(rt.InputError, match=r"pip install .*\[bayes\]"):
            identify(FAST, observed, method, seed=0)


@pytest.fixture(scope="module")
def stochastic() -> dict[str, PosteriorTwin]:
    """Updated twins, with and without a correlated output error."""
    observed = measured(LAG, 0.1, seed=6, count=2, gain=1.7, share=0.8)
    made = {}
    for name, noise in {"white": WHITE, "discrepancy": Noise()}.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # so few steps are too few
            made[name] = identify(LAG, observed, MCMC(10, 10, 5, 1, noise), seed=0, rate=5.0)
    return {name: each.twin for name, each in made.items()}


@pytest.mark.parametrize("check", TWIN_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("noise", ["white", "discrepancy"])
def test_the_updated_twin_keeps_the_contract(
    stochastic: dict[str, PosteriorTwin], noise: str, check: Callable
) -> None:
    faults = (None, rt.Stuck(0, onset=1.2), rt.Stuck(0, onset=2.5))
    check(TwinSubject(stochastic[noise], commands(3, 40), faults))


def test_a_saved_posterior_draws_the_same(
    stochastic: dict[str, PosteriorTwin], tmp_path: Path
) -> None:
    some = commands(3, 40)
    for name, twin in stochastic.items():
        twin.save(tmp_path / name)
        again = PosteriorTwin.load(tmp_path / name, LAG)
        assert again.noise == twin.noise
        first, second = (each.simulate(some, seed=3) for each in (twin, again))
        assert first.observed.tobytes() == second.observed.tobytes()
    with pytest.raises(rt.InputError, match="parameters gain, share"):
        PosteriorTwin.load(tmp_path / "white", FAST)
    with pytest.raises(rt.InputError, match="posterior model"):
        PosteriorTwin.load(tmp_path, LAG)


def test_every_trajectory_draws_parameters_of_its_own(chains: Posterior) -> None:
    repeated = np.repeat(commands(1, 20), 400, axis=0)
    made = chains.twin.simulate(repeated, seed=0)
    same = chains.twin.simulate(repeated, seed=0)
    assert made.observed.tobytes() == same.observed.tobytes()
    spread = made.observed.std(axis=0)[:, 0]
    design = repeated[0]
    parameters = np.einsum("ti,ij,tj->t", design, np.cov(chains.samples.T), design)
    wanted = np.sqrt(parameters + np.mean(chains.scales["noise"] ** 2))
    assert spread == pytest.approx(wanted, rel=0.15)


@pytest.mark.slow
def test_the_code_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for code in python_of("correct", "Update a twin's own parameters"):
        exec(compile(code, "docs/correct.md", "exec"), names)
    updated, posterior = names["updated"], names["posterior"]
    for name, true in {"gain": 1.7, "time": 0.8}.items():
        assert abs(updated.values[name] - true) < 4 * updated.errors[name] < 0.1
        assert abs(posterior.mean[name] - true) < 4 * posterior.deviation[name]
    assert names["fidelity"].figures["coverage90"].value == pytest.approx(0.9, abs=0.06)
    assert "gain" in capsys.readouterr().out
