"""Faults found by physics alone: against closed forms, on a toy, and on the emulated arm."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import entropy, multivariate_normal
from sklearn.metrics import roc_auc_score
from test_readme import python_of
from torch import Tensor

import retwin as rt
from retwin.diagnosis import Calibration, Diagnosis, InversionDiagnoser, conclude, fit_inversion
from retwin.diagnosis.inversion.fitting import lower_bound
from retwin.diagnosis.inversion.hypotheses import stuck_pairs
from retwin.diagnosis.inversion.severity import draw_biases
from retwin.diagnosis.inversion.trajectories import UNEXPLAINED
from retwin.inference.noise import Noise, StudentT
from retwin.inference.problem import GaussianPrior
from retwin.nets.training import Training
from retwin.scores.classification import score
from retwin.testing import DIAGNOSER_CHECKS, DiagnoserSubject
from retwin.twins.commands.samplers import RampSampler
from retwin.twins.faults.applied_faults import draw_faults, faulty_commands, frozen_from
from retwin.twins.faults.system_faults import ActuatorGain
from retwin.update.corrections.commands.effective_commands import effective_commands
from retwin.update.corrections.commands.missed_segments import LatentPrior, fitted
from retwin.update.corrections.commands.problem import CommandProblem

pytestmark = pytest.mark.slow

CHAIN = rt.Chain(rt.CommandSpace(), rt.SampledSensor())
MAP = np.array([[1.0, 0.5], [-0.3, 0.8], [0.2, -1.0]])
SAMPLER = RampSampler((-1.0, -1.0), (1.0, 1.0), 100.0, 4.0, segments=4, ramp_durations=(0.3, 0.4))


class Linear:
    """y = A u: what is known of commands and outputs is then Gaussian together."""

    memoryless = True

    def __call__(self, commands: Tensor) -> Tensor:
        return commands @ torch.tensor(MAP.T, dtype=commands.dtype)

    def predict(self, commands: np.ndarray) -> np.ndarray:
        return (commands @ MAP.T).astype(np.float32)


def posed(context: rt.Context, observed: Tensor, mask: Tensor) -> CommandProblem:
    one = torch.ones((), dtype=torch.float64)
    return CommandProblem.of(
        context, observed, mask, delay_range=(-5.0, 30.0), max_samples=200, unit=one
    )


def at_rest(commands: np.ndarray) -> tuple[CommandProblem, np.ndarray]:
    """Two samples of each rest, where no delay is seen; their segments."""
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Linear(), commands, segments, rate=100.0)
    when = np.stack([segments.stop[0] - 30, segments.stop[0] - 20], axis=1).astype(int).ravel()
    mask = torch.zeros(1, commands.shape[1], 3, dtype=torch.bool)
    mask[:, when] = True
    noise = np.random.default_rng(3).normal(0, 0.1, (1, commands.shape[1], 3))
    observed = torch.tensor(context.nominal.numpy() + noise)
    return posed(context, observed, mask), np.repeat(np.arange(segments.max_count), 2)


def test_evidence_is_that_of_a_gaussian() -> None:
    """Laplace's approximation is exact where nothing is curved and the noise has no tails."""
    rng = np.random.default_rng(0)
    problem, segment = at_rest(SAMPLER.sample(1, rng=rng))
    segments, size = problem.valid.shape[1], 3 * problem.valid.shape[1]
    noise = Noise(torch.full((2, 3), 0.07), torch.ones(2, dtype=torch.float64), StudentT(1e9))
    design = np.zeros((len(segment) * 3, size))
    for s, m in enumerate(segment):
        design[3 * s : 3 * s + 3, 3 * m + 1 : 3 * m + 3] = MAP
    residual = problem.residual(problem.zero)[0].numpy().ravel()
    differences = []
    for width in (0.02, 0.5):
        root = rng.normal(0, width, (size, size))
        covariance = root @ root.T + 0.01 * np.eye(size)
        prior = LatentPrior(
            GaussianPrior.of(
                torch.zeros(1, size, dtype=torch.float64), torch.tensor(covariance)[None]
            ),
            torch.full((1, segments, 2), -40.0, dtype=torch.float64),
        )
        found = fitted(problem, prior, noise, problem.zero)
        gaussian = multivariate_normal(
            cov=design @ covariance @ design.T + 0.07**2 * np.eye(len(design))
        )
        differences.append(float(found.evidence[0]) - gaussian.logpdf(residual))
        gain = covariance @ design.T @ np.linalg.inv(gaussian.cov_object.covariance)
        np.testing.assert_allclose(found.x.numpy().ravel(), gain @ residual, atol=1e-4)
        np.testing.assert_allclose(
            found.solution.covariance[0].numpy(), covariance - gain @ design @ covariance, atol=1e-5
        )
    # What both have in common is the density of the noise at 0.
    common = len(design) * np.log(0.07 * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(differences, common, atol=1e-3)


def test_correlated_noise_is_learned_at_every_polling_phase() -> None:
    """Samples of one trajectory are neighbours whatever lies between them in another one."""
    commands = SAMPLER.sample(4, rng=np.random.default_rng(0))
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Linear(), commands, segments, rate=100.0)
    # Each error of a sample repeats, a little changed, in the next one that is polled.
    rng, error = np.random.default_rng(1), np.zeros((4, 100, 3))
    for k in range(1, 100):
        error[:, k] = 0.95 * error[:, k - 1] + rng.normal(0, 0.01, (4, 3))
    observed = torch.tensor(context.nominal.numpy() + error.repeat(4, axis=1))
    thinning = []
    for phases in ((0, 0, 0, 0), (0, 0, 2, 2)):
        mask = torch.zeros(4, 400, 3, dtype=torch.bool)
        for row, phase in enumerate(phases):
            mask[row, phase::4] = True
        problem = posed(context, observed, mask)
        residual = problem.residual(problem.zero)
        noise = Noise.from_median(problem, residual, groups=2)
        found = problem.learned_noise(noise, residual)
        thinning.append(found.thinning)
    assert thinning[0][0] > 10
    torch.testing.assert_close(thinning[1], thinning[0], rtol=0.2, atol=0.0)


@pytest.mark.parametrize("mean", [(25.0, -30.0), (3.0, 20.0), (0.0, -9.0)])
def test_limits_of_a_bias_are_integrated(mean: tuple[float, float]) -> None:
    """Against a fine grid over the four boxes of two segments."""
    covariance = np.array([[16.0, 9.0], [9.0, 25.0]])
    width, low, high = 32.0, 10.0, 50.0
    drawn = draw_biases(
        torch.tensor([mean], dtype=torch.float64),
        torch.tensor(covariance)[None],
        width=torch.tensor([width], dtype=torch.float64),
        size=torch.tensor([[low, high]], dtype=torch.float64),
    )
    side = np.arange(low, high, 0.1) + 0.05
    axis = np.concatenate([-side[::-1], side])
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    believed = np.exp(-0.5 * (grid / width) ** 2).prod(axis=-1) / (2 * np.pi * width**2)
    mass = multivariate_normal(mean, covariance).pdf(grid) / believed / (2 * (high - low)) ** 2
    np.testing.assert_allclose(drawn.gain[0], np.log(mass.sum() * 0.01), atol=0.03)
    share, prior = mass / mass.sum(), (0.1 / (2 * (high - low))) ** 2
    np.testing.assert_allclose(
        drawn.information[0], -entropy(share, axis=None) - np.log(prior), atol=0.03
    )
    average = (grid * mass[..., None]).sum(axis=(0, 1)) / mass.sum()
    summary = drawn.summary(0.9)[0]
    np.testing.assert_allclose(summary[:, 0], average, atol=0.5)
    assert (summary[:, 1] <= summary[:, 0]).all()
    assert (summary[:, 0] <= summary[:, 2]).all()


TOY: dict[str, rt.Fault | None] = {
    "Healthy": None,
    "First stuck": rt.Stuck(0, onset=(0.0, 3.2)),
    "Second biased": rt.ActuatorBias(1, size=(0.2, 0.5)),
}


def toy(
    count: int, label: str, seed: int, missed: tuple[int, ...] = ()
) -> tuple[rt.Trajectories, list, np.ndarray]:
    """A linear system of two actuators with delays and offsets.

    The second actuator misses the segments `missed`.
    """
    rng = np.random.default_rng(seed)
    commands = SAMPLER.sample(count, rng=rng)
    segments = rt.Segments.from_commands(commands)
    faults = draw_faults([TOY[label]] * count, segments, seed, rate=100.0)
    faulty = torch.tensor(
        faulty_commands(commands, faults, segments, rate=100.0), dtype=torch.float64
    )
    shape = segments.start.shape
    z = [rng.normal(4, 0.5, (*shape, 1)), rng.normal(0, 0.02, (*shape, 2)), np.zeros((*shape, 2))]
    z[2][:, list(missed), 1] = 1.0
    frozen = torch.tensor(frozen_from(faults, *commands.shape[1:], rate=100.0))
    latent = torch.tensor(np.concatenate(z, axis=2))
    done = effective_commands(faulty, segments, latent, torch.arange(400), frozen).numpy()
    outputs = (done @ MAP.T)[:, np.arange(400) // 10 * 10]
    noise = rng.normal(0, 0.004, (count, 40, 3)).repeat(10, axis=1)
    mask = np.zeros(outputs.shape, dtype=bool)
    mask[:, ::10] = True
    made = rt.Trajectories(
        commands,
        (commands @ MAP.T).astype(np.float32),
        (outputs + noise).astype(np.float32),
        rate=100.0,
        mask=mask,
        labels=np.full(count, label),
    )
    return made, faults, done


@pytest.fixture(scope="module")
def toy_diagnoser() -> InversionDiagnoser:
    plain = toy(60, "Healthy", 1)[0]
    ibg = rt.fit_surrogate(
        plain,
        rt.MLP((32,)),
        seed=0,
        training=Training(max_epochs=30, batch_size=64, learning_rate=1e-2),
    )
    healthy = toy(8, "Healthy", 2)[0]
    return fit_inversion(
        ibg, rt.fit_residual(ibg, healthy, rt.CommandSpace(), seed=0), healthy, TOY
    )


@pytest.mark.slow
def test_any_twin_with_actuators(toy_diagnoser: InversionDiagnoser) -> None:
    """Two actuators, three outputs, onsets that nobody knows."""
    for label in TOY:
        made, faults, done = toy(6, label, 7)
        found = toy_diagnoser.diagnose(made)
        own = found.classes.index(label)
        assert (found.probabilities.argmax(axis=1) == own).sum() >= 5
        if label == "First stuck":
            error = found.level.value[:, own] - done[:, -1, 0]
            assert np.abs(error).max() < 0.1
            onset = np.array([fault.onset for fault in faults])
            inside = (found.onset.low[:, own] <= onset) & (onset <= found.onset.high[:, own])
            assert inside.sum() >= 5
            assert np.isnan(found.bias.value[:, own]).all()
        if label == "Second biased":
            bias = np.array([fault.bias for fault in faults])
            assert np.abs(found.bias.value[:, own] - bias).mean() < 0.03
            assert np.isnan(found.level.value[:, own]).all()


def test_a_biased_actuator_may_also_miss_segments(toy_diagnoser: InversionDiagnoser) -> None:
    """The offset that makes up for a missed segment is beyond the limits of a bias.

    Segments are tried as missed though others are explained worse, and though such an offset
    would be rather likely if biases were Gaussian.
    """
    made, _, done = toy(12, "Second biased", 17, missed=(1,))
    found = toy_diagnoser.diagnose(made)
    assert found.classes[2] == "Second biased"
    # Where the actuator stays near its target by chance, nothing shows that it missed the segment.
    stop = rt.Segments.from_commands(made.commands).stop[:, 1].astype(int) - 1
    away = np.abs(done - made.commands)[np.arange(12), stop, 1] > 0.1
    assert away.sum() >= 10
    assert (found.probabilities[away, 2] > 0.9).all()


def test_no_evidence_is_unknown_with_the_reason(toy_diagnoser: InversionDiagnoser) -> None:
    made = toy(4, "First stuck", 23)[0]
    observed = made.observed.copy()
    observed[0], observed[1, :, 2] = np.nan, np.nan
    observed[2] = observed[2][:, [1, 2, 0]]
    seen = made.mask & np.isfinite(observed)
    found = toy_diagnoser.diagnose(made.replace(observed=observed, mask=seen))
    assert found.labels.tolist() == ["unknown"] * 3 + ["First stuck"]
    lost = made.outputs.names[2]
    assert found.reason.tolist() == [
        "nothing was measured",
        f"{lost} never measured",
        UNEXPLAINED,
        "",
    ]
    said = conclude(toy_diagnoser, made)
    assert said.labels.tolist() == ["First stuck"] * 4
    assert "from 8 healthy trajectories: 0.01 of further ones are to be unknown" in said.remark
    own = toy_diagnoser.calibration
    assert (own.simulated, own.outputs) == (99, made.outputs.names)
    assert own.below <= 9


def test_foreign_data_are_unknown_after_one_run_too(tmp_path: Path) -> None:
    """And healthy ones are not, of which the false rate is stated."""
    plain, healthy = toy(60, "Healthy", 1)[0], toy(1, "Healthy", 2)[0]
    training = Training(max_epochs=30, batch_size=64, learning_rate=1e-2)
    ibg = rt.fit_surrogate(plain, rt.MLP((32,)), seed=0, training=training)
    with pytest.warns(UserWarning, match="1 trajectories to calibrate on"):
        residual = rt.fit_residual(ibg, healthy, rt.CommandSpace(), seed=0)
    fit_inversion(ibg, residual, healthy, TOY).save(tmp_path / "one")
    one = InversionDiagnoser.load(tmp_path / "one")
    simulated = (99, one.calibration.below)
    assert one.calibration == Calibration(1, 0.01, healthy.outputs.names, *simulated)
    assert "From 1 of them foreign data cannot be recognised unless" in str(one.calibration)
    further = toy(10, "Healthy", 31)[0]
    o = further.observed
    assert (one.diagnose(further).labels != "unknown").sum() >= 9
    for foreign in (1.5 * o, np.roll(o, 1, axis=0), o[..., [1, 2, 0]]):
        assert (one.diagnose(further.replace(observed=foreign)).labels == "unknown").sum() >= 9


def test_a_fault_of_any_size_is_not_unknown(toy_diagnoser: InversionDiagnoser) -> None:
    """Wide limits cost evidence in every segment, and explain the outputs as well."""
    made = toy(12, "Second biased", 19)[0]
    wide = toy_diagnoser.with_faults({"Second biased": rt.ActuatorBias(1, size=(0.0, 50.0))})
    found, other = toy_diagnoser.diagnose(made), wide.diagnose(made)
    assert (found.evidence[:, 2] - other.evidence[:, 2] > 10).all()
    assert np.median(np.abs(found.explained[:, 2] - other.explained[:, 2])) < 2
    assert ((found.unknown < 0.5) & (other.unknown < 0.5)).sum() >= 10


@pytest.fixture(scope="module")
def inversion(exact, emulated: rt.Trajectories, case: rt.Case) -> InversionDiagnoser:
    """Calibrated on eight healthy trajectories of the emulated arm, with the twin itself.

    A surrogate's error, which differs from machine to machine, would be part of what is found.
    """
    healthy = emulated.with_label("Healthy")[:8]
    residual = rt.fit_residual(exact, healthy, CHAIN, seed=0)
    return fit_inversion(exact, residual, healthy, case.faults)


@pytest.fixture(scope="module")
def arm(case: rt.Case) -> tuple[rt.Trajectories, list, dict[str, np.ndarray]]:
    """Four trajectories per class, their faults, and what was hidden."""
    faults = [fault for fault in case.faults.values() for _ in range(4)]
    commands = case.sampler.sample(len(faults), rng=np.random.default_rng(8))
    hidden: dict[str, np.ndarray] = {}
    made = case.emulator.simulate(commands, faults=faults, seed=8, hidden=hidden)
    drawn = draw_faults(faults, rt.Segments.from_commands(commands), 8, rate=100.0)
    return made.replace(labels=np.repeat(case.classes, 4)), drawn, hidden


@pytest.fixture(scope="module")
def diagnosis(inversion: InversionDiagnoser, arm: tuple) -> Diagnosis:
    return inversion.diagnose(arm[0])


@pytest.mark.slow
def test_the_emulated_arm_is_diagnosed(diagnosis: Diagnosis, arm: tuple) -> None:
    """Over 11 retrainings all are right each time, with a probability of 0.96 at least."""
    truth = np.array([diagnosis.classes.index(label) for label in arm[0].labels])
    scores = score(truth, diagnosis.probabilities, diagnosis.classes)
    assert scores.macro_f1 > 0.9
    assert scores.healthy_recall >= 0.75
    assert scores.ece < 0.1


@pytest.mark.slow
def test_a_fault_that_is_left_out_is_unknown(
    diagnosis: Diagnosis, inversion: InversionDiagnoser, arm: tuple
) -> None:
    """The evidence for a class does not depend on the others: one is left out by its column."""
    areas = []
    assert np.mean(diagnosis.unknown < 0.5) >= 0.9
    for left in range(1, len(diagnosis.classes)):
        kept = np.delete(diagnosis.explained, left, axis=1)
        own = arm[0].labels == diagnosis.classes[left]
        areas.append(roc_auc_score(own, -kept.max(axis=1)))
    assert np.mean(areas) >= 0.9
    some = arm[0][arm[0].labels == "Motor_1_Stuck"]
    faults = {name: fault for name, fault in inversion.faults.items() if name != "Motor_1_Stuck"}
    parts = {"noise": inversion.noise, "bound": inversion.bound}
    others = InversionDiagnoser(inversion.surrogate, inversion.residual, faults, **parts)
    assert (others.diagnose(some).labels == "unknown").mean() >= 0.5


@dataclass(frozen=True)
class BothStuck:
    """Two actuators whose responses are held from the same moment on."""

    one: rt.Stuck
    other: int
    label: str = "two stuck"

    def drawn(self, rng: np.random.Generator, **about: Any) -> BothStuck:
        return replace(self, one=self.one.drawn(rng, **about))

    def command(self, commands: np.ndarray, segments: rt.Segments, rate: float) -> np.ndarray:
        return commands

    def response(self, response: np.ndarray, rate: float) -> np.ndarray:
        held = self.one.response(response, rate)
        return replace(self.one, actuator=self.other).response(held, rate)


@pytest.mark.slow
def test_two_stuck_actuators_are_no_single_fault(
    inversion: InversionDiagnoser, arm: tuple, case: rt.Case
) -> None:
    drawn = [BothStuck(rt.Stuck(i), j) for i, j in combinations(range(4), 2) for _ in range(3)]
    commands = case.sampler.sample(len(drawn), rng=np.random.default_rng(9))
    both = case.emulator.simulate(commands, faults=drawn, seed=9)
    one, two = (inversion.diagnose(each, max_faults=2) for each in (arm[0], both))
    scores = np.concatenate([one.several, two.several])
    assert roc_auc_score(np.arange(len(scores)) >= len(one.several), scores) >= 0.95
    assert (two.labels == "unknown").mean() >= 0.9
    named = [
        f"Motor_{each.one.actuator + 1}_Stuck and Motor_{each.other + 1}_Stuck" for each in drawn
    ]
    assert np.mean([name in why for name, why in zip(named, two.reason, strict=True)]) >= 0.9
    # Single faults keep their answers.
    assert (one.several > 0.5).sum() <= 1
    alone = inversion.diagnose(arm[0])
    assert (alone.several == 0).all()
    np.testing.assert_allclose(one.probabilities, alone.probabilities, atol=1e-6)


def test_pairs_are_those_of_actuators_that_are_stuck_from_the_same_moment() -> None:
    faults = {"fine": None, "a": rt.Stuck(0), "b": rt.Stuck(1), "c": rt.Stuck(2, (0.0, 1.0))}
    assert {name: pair.actuators for name, pair in stuck_pairs(faults).items()} == {
        ("a", "b"): (0, 1)
    }


@pytest.mark.slow
def test_pairs_are_refused_where_there_are_none(toy_diagnoser: InversionDiagnoser) -> None:
    made = toy(2, "Healthy", 3)[0]
    with pytest.raises(rt.InputError, match="max_faults: expected 1 for a diagnoser without two"):
        toy_diagnoser.diagnose(made, max_faults=2)
    with pytest.raises(rt.InputError, match="max_faults"):
        conclude(toy_diagnoser, made, max_faults=3)


@pytest.mark.slow
def test_intervals_of_severities_cover(diagnosis: Diagnosis, arm: tuple) -> None:
    """The limits are ten standard deviations and more away from what 11 retrainings give.

    Biases err by 4.01 with a standard deviation of 0.04, and 0.932 of their intervals hold
    them, with one of 0.007; levels err by 0.60 with one of 0.02, and all intervals hold.
    """
    truth = np.array([diagnosis.classes.index(label) for label in arm[0].labels])
    each, (_, drawn, hidden) = np.arange(len(truth)), arm
    biased, stuck = np.flatnonzero(truth >= 5), np.flatnonzero((truth > 0) & (truth < 5))
    bias = np.array([drawn[i].bias for i in biased])
    estimate = [part[each, truth][biased] for part in vars(diagnosis.bias).values()]
    assert np.abs(estimate[0] - bias).mean() < 8.0, "2 degrees; knowing nothing gives 30 units"
    assert 0.8 <= ((estimate[1] <= bias) & (bias <= estimate[2])).mean() <= 1.0
    level = hidden["angles"][stuck, -1, truth[stuck] - 1]
    estimate = [part[each, truth][stuck] for part in vars(diagnosis.level).values()]
    assert np.abs(estimate[0] - level).mean() < 4.0
    assert ((estimate[1] <= level) & (level <= estimate[2])).mean() >= 0.7
    assert (diagnosis.onset.value[stuck, truth[stuck]] == 0.49).all()


def played(inversion: InversionDiagnoser, case: rt.Case, z: Tensor) -> rt.Trajectories:
    """Healthy trajectories of which z is known."""
    commands = case.sampler.sample(len(z), rng=np.random.default_rng(21))
    context = inversion.residual.context(inversion.surrogate, commands)
    with torch.no_grad():
        outputs = rt.CommandSpace().apply(context, z).numpy()
    noise = np.random.default_rng(2).normal(0, 3e-4, outputs[:, ::10].shape)
    return rt.Trajectories(
        commands,
        context.nominal.numpy(),
        outputs + noise.repeat(10, axis=1),
        rate=100.0,
        inputs=case.inputs,
        outputs=case.outputs,
    )


def test_a_missed_movement_is_no_fault(inversion: InversionDiagnoser, case: rt.Case) -> None:
    """Stuck and missed differ by persistence: one segment is no more than a discrepancy."""
    z = torch.zeros(4, 5, 9)
    z[..., 0] = 4.5
    z[torch.arange(4), torch.tensor([1, 2, 3, 4]), 5 + torch.arange(4)] = 1.0
    found = inversion.diagnose(played(inversion, case, z))
    assert (found.probabilities[:, 0] > 0.5).all()


def test_a_glitch_is_no_fault(inversion: InversionDiagnoser, case: rt.Case) -> None:
    z = torch.zeros(1, 5, 9)
    z[..., 0] = 4.5
    made = played(inversion, case, z)
    observed = made.observed.copy()
    observed[0, 290:311] += 0.2
    clean, hit = (
        inversion.predict_proba(made.replace(observed=each)) for each in (made.observed, observed)
    )
    assert clean[0, 0] > 0.9
    assert hit[0, 0] > 0.9


@pytest.fixture(scope="module")
def few(inversion: InversionDiagnoser, ibg: rt.Surrogate) -> InversionDiagnoser:
    """The same about three classes, with a surrogate: contracts are about form."""
    names = ("Healthy", "Motor_1_Stuck", "Motor_2_Steady_state_error")
    faults = {name: inversion.faults[name] for name in names}
    return InversionDiagnoser(ibg, inversion.residual, faults, noise=inversion.noise)


@pytest.mark.parametrize("check", DIAGNOSER_CHECKS, ids=lambda check: check.__name__)
def test_contract(few: InversionDiagnoser, arm: tuple, check) -> None:
    check(DiagnoserSubject(few, arm[0][:3:2]))


def test_saved_and_loaded_is_the_same(few: InversionDiagnoser, arm: tuple, tmp_path: Path) -> None:
    few.save(tmp_path / "a")
    back = InversionDiagnoser.load(tmp_path / "a")
    assert back.classes == few.classes
    assert back.faults == few.faults
    wanted, got = few.diagnose(arm[0][:2]), back.diagnose(arm[0][:2])
    np.testing.assert_array_equal(got.evidence, wanted.evidence)
    np.testing.assert_array_equal(got.bias.value, wanted.bias.value)


def test_what_cannot_be_inverted_is_refused(
    inversion: InversionDiagnoser, rg: rt.ResidualModel, emulated: rt.Trajectories
) -> None:
    parts = (inversion.surrogate, inversion.residual)
    known = {"Healthy": None, "known": rt.ActuatorBias(0, bias=(20.0,) * 5)}
    with pytest.raises(rt.InputError, match="ActuatorBias with its bias open"):
        InversionDiagnoser(*parts, known, noise=inversion.noise)
    with pytest.raises(rt.InputError, match="at least 2 classes"):
        InversionDiagnoser(*parts, {"Healthy": None}, noise=inversion.noise)
    with pytest.raises(rt.InputError, match="the actuators' effective commands"):
        InversionDiagnoser(parts[0], rg, inversion.faults, noise=inversion.noise)
    faulty = emulated.with_label("Motor_1_Stuck")
    with pytest.raises(rt.InputError, match="at least one trajectory labelled 'Healthy'"):
        fit_inversion(*parts, faulty, inversion.faults)
    # Of an unlabelled set there is nothing to fit: the faults are refused before.
    weak = {"Healthy": None, "weak": ActuatorGain(0, size=-0.5)}
    with pytest.raises(rt.InputError, match="fit_dynamics"):
        fit_inversion(*parts, faulty, weak)
    fewer = emulated[:2].replace(inputs=rt.Channels.numbered("u", 4))
    with pytest.raises(rt.InputError, match=r"trajectories.inputs"):
        inversion.predict_proba(fewer)


@pytest.mark.slow
def test_what_the_page_shows_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = python_of("diagnose", "By inversion")
    names: dict[str, Any] = {}
    exec(compile(code, "docs/diagnose.md", "exec"), names)
    assert "stands at" in capsys.readouterr().out
    assert (names["found"].probabilities[:, names["own"]] > 0.5).all()


def test_the_bound_holds_99_of_100_further_values() -> None:
    rng = np.random.default_rng(0)
    draws = rng.normal(3, 2, (20000, 5))
    below = np.mean([values[0] < lower_bound(values[1:]) for values in draws])
    # 0.01 with a standard error of 0.0007: six of them.
    assert below == pytest.approx(0.01, abs=0.0042)
    assert lower_bound(np.ones(1)) == -np.inf
