"""The RG from few trajectories, compared with a discrepancy of known distribution."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy import stats

import retwin as rt
from retwin.data.segments import Segments
from retwin.nets.mixtures import Blocks
from retwin.nets.student import widening
from retwin.update.corrections import Context
from retwin.update.kernels import generation

pytestmark = pytest.mark.numerical

SEGMENTS, STEPS, FIRST = 5, 60, 20
"""Segments of a trajectory, samples of each, and the samples before its motion begins."""
MEAN, DEVIATION = np.array([6.0, 0.05, 0.05]), np.array([1.0, 0.05, 0.05])
"""Of delay and offsets."""
DRAWS, OUTSIDE = 59, 3
"""Simulations per test trajectory: beyond the third from either end lie 10 % of measurements."""


@pytest.fixture(scope="module")
def twin() -> rt.Surrogate:
    """y = u, exactly."""
    channels = rt.Channels(("u", "v"), ("1", "1")), rt.Channels(("x", "y"), ("1", "1"))
    surrogate = rt.Surrogate(rt.MLP(()), inputs=channels[0], outputs=channels[1], rate=100.0)
    with torch.no_grad():
        surrogate.network[0].weight.copy_(torch.eye(2))
        surrogate.network[0].bias.fill_(0.0)
    return surrogate.eval()


@dataclass(frozen=True)
class Machine:
    """A delay and offsets whose normal scores correlate by `persistence` within a trajectory.

    With `slope`, the mean of an offset is that share of the distance travelled.
    """

    twin: rt.Surrogate
    persistence: float
    slope: float = 0.0

    def measured(self, count: int, seed: int) -> tuple[rt.Trajectories, np.ndarray]:
        """Trajectories, and their z (n, M, 3)."""
        rng = np.random.default_rng(seed)
        levels = rng.uniform(-1, 1, (count, SEGMENTS + 1, 1, 2))
        ramp = np.clip((np.arange(STEPS) - FIRST) / 15, 0, 1)[:, None]
        steps = np.diff(levels, axis=1)
        commands = (levels[:, :-1] + ramp * steps).reshape(count, -1, 2).astype(np.float32)
        common, own = rng.normal(size=(count, 1, 3)), rng.normal(size=(count, SEGMENTS, 3))
        score = np.sqrt(self.persistence) * common + np.sqrt(1 - self.persistence) * own
        z = MEAN + DEVIATION * score
        z[..., 1:] += self.slope * steps[:, :, 0]
        context = Context.of(self.twin, commands, Segments.from_commands(commands), rate=100.0)
        outputs = rt.DelayOffset().apply(context, torch.tensor(z, dtype=torch.float32)).numpy()
        noise = 0.002 * rng.normal(size=outputs.shape)
        made = self.twin.simulate(commands, seed=0)
        return made.replace(
            observed=(outputs + noise).astype(np.float32), labels=np.full(count, "Healthy")
        ), z

    def fitted(self, count: int, seed: int) -> rt.ResidualModel:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return rt.fit_residual(
                self.twin, self.measured(count, seed)[0], rt.DelayOffset(), seed=seed
            )

    def coverage(self, count: int, seeds: int) -> tuple[float, float]:
        """Shares of z and of outputs that 90 % intervals hold, over several calibration sets."""
        test, z = self.measured(60, 999)
        inside = []
        for seed in range(seeds):
            model = self.fitted(count, seed)
            context = model.context(self.twin, test.commands)
            with torch.no_grad():
                scores = model(context).normal_scores(torch.tensor(z, dtype=torch.float32))
            of_z = (scores.abs() < 1.6449).float().mean().item()
            inside.append((of_z, outputs_inside(self.twin, model, test[:15])))
        return tuple(np.mean(inside, axis=0))


def outputs_inside(twin: rt.Surrogate, model: rt.ResidualModel, test: rt.Trajectories) -> float:
    """Share of measurements, from the first motion on, that 90 % intervals of outputs hold."""
    commands = np.repeat(test.commands, DRAWS, axis=0)
    made = rt.CorrectedTwin(twin, model).simulate(commands, seed=1).observed
    below = (made.reshape(len(test), DRAWS, -1, 2) < test.observed[:, None]).sum(axis=1)
    held = (below >= OUTSIDE) & (below <= DRAWS - OUTSIDE)
    return float(held[:, STEPS:].mean())


@pytest.mark.slow
@pytest.mark.parametrize("persistence", [0.0, pytest.param(0.7, marks=pytest.mark.slow)])
def test_intervals_from_two_trajectories_hold(twin: rt.Surrogate, persistence: float) -> None:
    """90 % intervals hold 0.92 of z on average over calibration sets, 0.95 of those that persist.

    Before the calibration on held-out trajectories it was 0.52 and 0.41.
    """
    of_z, of_outputs = Machine(twin, persistence).coverage(2, seeds=5)
    assert of_z >= 0.85
    assert of_outputs >= 0.85


@pytest.mark.parametrize(
    ("count", "loss"),
    [
        pytest.param(1, 0.8, marks=pytest.mark.slow),
        pytest.param(2, 0.55, marks=pytest.mark.slow),
        pytest.param(4, 0.26, marks=pytest.mark.slow),
    ],
)
def test_the_middle_of_the_distribution_is_not_too_wide(
    twin: rt.Surrogate, count: int, loss: float
) -> None:
    """50 % intervals of z, and what its log density loses against the true one, per component.

    Over both persistences and five calibration sets, 50 % intervals hold 0.42, 0.50 and 0.56 from
    one, two and four trajectories, and the loss is 0.68, 0.53 and 0.24 nats. A normal distribution
    with the same 90 % intervals lost 0.95, 0.62 and 0.29, and its 50 % intervals held 0.58, 0.57
    and 0.59. That of one trajectory cannot be right for both persistences, which it does not show.
    """
    middle, lost, lost_as_normal = [], [], []
    entropy = stats.norm(scale=DEVIATION).entropy().sum()
    for persistence in (0.0, 0.7):
        machine = Machine(twin, persistence)
        test, z = machine.measured(60, 999)
        value = torch.tensor(z, dtype=torch.float32)
        for seed in range(5):
            model = machine.fitted(count, seed)
            with torch.no_grad():
                found = model(model.context(twin, test.commands))
                normal = Blocks([block.normal for block in found.blocks])
                middle.append((found.normal_scores(value).abs() < 0.6745).float().mean().item())
                for each, losses in ((found, lost), (normal, lost_as_normal)):
                    losses.append((-each.log_prob(value).mean().item() - entropy) / 3)
    assert abs(np.mean(middle) - 0.5) < 0.1
    assert np.mean(lost) < min(loss, np.mean(lost_as_normal))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_the_model_does_not_depend_on_compiled_kernels(
    twin: rt.Surrogate, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Log densities agree to 0.01 nats: kernels and torch differ in the last digits.

    Of seed 2 they differed by 1.7 nats, when a delay was inferred from a start at which the weights
    of a fast motion vanish.
    """
    machine = Machine(twin, 0.7)
    data, (test, z) = machine.measured(4, seed)[0], machine.measured(20, 999)
    brief = rt.Mixture(training=replace(rt.Mixture().training, max_epochs=30))

    def log_density() -> torch.Tensor:
        model = rt.fit_residual(twin, data, rt.DelayOffset(), brief, seed=seed)
        with torch.no_grad():
            found = model(model.context(twin, test.commands))
            return found.log_prob(torch.tensor(z, dtype=torch.float32))

    fast = log_density()
    monkeypatch.setattr(generation, "library", lambda: None)
    assert float((log_density() - fast).abs().max()) < 0.01


@pytest.mark.long
@pytest.mark.parametrize("slope", [0.0, 0.08])
@pytest.mark.parametrize("persistence", [0.0, 0.7])
@pytest.mark.parametrize("count", [2, 3, 4, 6, 10, 30])
def test_intervals_hold_from_any_number_of_trajectories(
    twin: rt.Surrogate, count: int, persistence: float, slope: float
) -> None:
    of_z, of_outputs = Machine(twin, persistence, slope).coverage(count, seeds=30)
    assert of_z >= (0.85 if count < 4 else 0.88)
    assert of_outputs >= (0.85 if count < 4 else 0.88)


@pytest.mark.slow
def test_persistence_is_found_from_four_trajectories(twin: rt.Surrogate) -> None:
    """0.7 comes back as 0.62 on average, 0 as 0.25: four trajectories determine neither."""
    found = {
        true: np.mean([Machine(twin, true).fitted(4, seed).persistence.mean() for seed in range(4)])
        for true in (0.0, 0.7)
    }
    assert found[0.7] > 0.45
    assert found[0.0] < 0.35


@pytest.mark.slow
def test_one_trajectory_and_one_segment_give_a_wide_distribution(twin: rt.Surrogate) -> None:
    machine = Machine(twin, 0.5)
    one = machine.fitted(1, 0)
    widths = np.repeat([widening(each) for each in one.degrees], one.sizes)
    deviations = one.spread.numpy() * widths
    assert (deviations > 1.5).all()
    data, _ = machine.measured(1, 0)
    _, found = rt.infer_discrepancy(twin, data, rt.DelayOffset())
    # Bounds are those of the data, and do not depend on what the network predicts.
    largest = found.z.abs().amax(dim=(0, 1)).numpy()
    np.testing.assert_allclose(one.bounds, 1.25 * largest * widths, rtol=0.01)
    short = data.replace(
        commands=data.commands[:, :STEPS],
        nominal=data.nominal[:, :STEPS],
        observed=data.observed[:, :STEPS],
        mask=data.mask[:, :STEPS],
    )
    with pytest.warns(UserWarning, match="1 trajectories to calibrate on"):
        least = rt.fit_residual(twin, short, rt.DelayOffset(), seed=0)
    assert torch.isfinite(least.spread).all()
    assert least.fitted.figures["movements"] == 1
