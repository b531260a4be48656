"""The surrogate's own error is in the intervals of what is inferred through it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.data.segments import Segments
from retwin.nets.training import Training
from retwin.twins import RampSampler, TwinWrapper
from retwin.update import OutsideTrainingWarning
from retwin.update.corrections.commands.effective_commands import effective_commands
from retwin.update.surrogate_error import surrogate_variance

pytestmark = pytest.mark.slow

CHANNELS = (
    rt.Channels(("shoulder", "elbow"), ("deg", "deg")),
    rt.Channels(("x", "y"), ("mm", "mm")),
)
QUANTILE = 1.645
"""End of the central 90 % interval of a normal distribution."""


def tip(degrees: np.ndarray) -> np.ndarray:
    """The tip of an arm of two links, 300 and 200 mm."""
    shoulder, elbow = np.moveaxis(np.deg2rad(degrees), -1, 0)
    wrist = shoulder + elbow
    x = 300 * np.cos(shoulder) + 200 * np.cos(wrist)
    return np.stack([x, 300 * np.sin(shoulder) + 200 * np.sin(wrist)], axis=-1)


TWIN = rt.FunctionTwin(tip, *CHANNELS, rate=20.0)


def commands(count: int, scale: float, seed: int) -> np.ndarray:
    """Targets within 80 and 50 degrees, times `scale`."""
    high = 80.0 * scale, 50.0 * scale
    low = -high[0], -high[1]
    sampler = RampSampler(low, high, rate=20.0, duration=16.0, segments=4)
    return sampler.sample(count, rng=np.random.default_rng(seed))


@pytest.fixture(scope="module")
def surrogate() -> rt.Surrogate:
    """Trained on targets to 80 and 50 degrees."""
    how = Training(max_epochs=40, batch_size=256, learning_rate=5e-3)
    simulated = TWIN.simulate(commands(100, 1.0, 0), seed=0)
    return rt.fit_surrogate(simulated, rt.MLP((32, 32)), seed=0, training=how)


def measured(scale: float) -> tuple[rt.Trajectories, np.ndarray]:
    """Trajectories with delays of 0.1 s and offsets of 0.5 degrees, 1 mm of noise, and true z."""
    rng = np.random.default_rng(1)
    sent = commands(25, scale, 1)
    segments = Segments.from_commands(sent)
    shape = segments.valid.shape
    z = np.zeros((*shape, 5))
    z[..., 0], z[..., 1:3] = rng.normal(2, 0.5, shape), rng.normal(0, 0.5, (*shape, 2))
    times = torch.arange(sent.shape[1])
    executed = effective_commands(torch.tensor(sent).double(), segments, torch.tensor(z), times)
    observed = tip(executed.numpy()) + rng.normal(size=(*sent.shape[:2], 2))
    made = TWIN.simulate(sent, seed=0)
    return made.replace(observed=observed.astype(np.float32), labels=np.full(25, "Healthy")), z


def covered(found: rt.Discrepancy, z: np.ndarray) -> float:
    """Share of the offsets within their 90 % intervals."""
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt().numpy()
    inside = np.abs(found.z.numpy() - z) < QUANTILE * deviation
    return float(inside[..., 1:3].mean())


def test_intervals_cover_beyond_the_training_and_it_is_said(surrogate: rt.Surrogate) -> None:
    """Asked at 106 degrees the surrogate errs by centimetres."""
    far, z = measured(106 / 80)
    with pytest.warns(OutsideTrainingWarning, match=r"shoulder is -?1\d\d"):
        _, found = rt.infer_discrepancy(surrogate, far, rt.CommandSpace(), twin=TWIN)
    assert covered(found, z) >= 0.8


def test_within_the_training_held_out_simulations_stand_for_the_twin(
    surrogate: rt.Surrogate,
) -> None:
    near, z = measured(0.95)
    _, found = rt.infer_discrepancy(surrogate, near, rt.CommandSpace())
    assert covered(found, z) >= 0.8


@pytest.mark.parametrize("twin", [TWIN, None])
def test_a_surrogate_that_errs_more_than_the_machine_is_warned_of(twin: rt.Twin | None) -> None:
    how = Training(max_epochs=2, batch_size=256, learning_rate=5e-3)
    simulated = TWIN.simulate(commands(20, 1.0, 0), seed=0)
    poor = rt.fit_surrogate(simulated, rt.MLP((8,)), seed=0, training=how)
    density = rt.Mixture(components=1, hidden=(4,), training=Training(max_epochs=1))
    with pytest.warns(UserWarning, match=r"its own error is .* mm in .*; little can be inferred"):
        rt.fit_residual(poor, measured(0.9)[0][:6], rt.DelayOffset(), density, seed=0, twin=twin)


def test_the_error_is_that_on_the_commands(surrogate: rt.Surrogate) -> None:
    sent = commands(6, 1.0, 2)
    segments = Segments.from_commands(sent)
    square = (surrogate.predict(sent) - TWIN.simulate(sent, seed=0).nominal) ** 2
    found = surrogate_variance(surrogate, TWIN, sent, segments)
    begin, end = (int(np.ceil(t[2, 1])) for t in (segments.start, segments.stop))
    np.testing.assert_allclose(found[2, 1], square[2, begin:end].mean(axis=0), rtol=1e-4)
    figures = surrogate.fitted.figures
    held_out = surrogate_variance(surrogate, None, sent, segments)
    np.testing.assert_allclose(held_out[2, 1].sqrt(), [figures["rmse_x"], figures["rmse_y"]])
    limited = rt.FunctionTwin(tip, *CHANNELS, rate=20.0, limits=rt.twins.Limits((0, 0), (1, 1)))
    with pytest.warns(UserWarning, match="twin: it does not simulate these commands"):
        without = surrogate_variance(surrogate, limited, sent, segments)
    torch.testing.assert_close(without, held_out)
    assert surrogate_variance(TWIN, TWIN, sent, segments) is None, "an exact twin has no error"


@pytest.mark.slow
def test_offsets_of_outputs_and_diagnoses_are_less_certain_too(
    surrogate: rt.Surrogate, tmp_path: Path
) -> None:
    near, _ = measured(0.95)
    context, found = rt.infer_discrepancy(surrogate, near, rt.DelayOffset(), twin=TWIN)
    variance = found.covariance.diagonal(dim1=-2, dim2=-1)[..., 1:]
    assert (variance >= context.surrogate_variance).all()
    density = rt.Mixture(components=1, hidden=(4,), training=Training(max_epochs=3))
    residual = rt.fit_residual(surrogate, near, rt.CommandSpace(), density, seed=0, twin=TWIN)
    faults = {"Healthy": None, "Bias": rt.ActuatorBias(0, size=(5.0, 10.0))}
    diagnoser = rt.fit_inversion(surrogate, residual, near, faults, twin=TWIN)
    diagnoser.save(tmp_path / "d")
    back = rt.load_diagnoser(tmp_path / "d")
    torch.testing.assert_close(back.surrogate_variance, diagnoser.surrogate_variance)
    certain = rt.diagnosis.InversionDiagnoser(surrogate, residual, faults, noise=diagnoser.noise)
    wide, narrow = (each.diagnose(near[:2]).bias for each in (back, certain))
    assert np.nanmean(wide.high - wide.low) > np.nanmean(narrow.high - narrow.low)


def test_an_output_that_is_never_measured_is_refused_in_words(surrogate: rt.Surrogate) -> None:
    near, _ = measured(0.95)
    mask = near.mask.copy()
    mask[..., 1] = False
    half = near.replace(mask=mask)
    with pytest.raises(rt.InputError, match="at which all outputs are measured"):
        rt.fit_residual(surrogate, half, rt.CommandSpace(), seed=0, twin=TWIN)


class Ending(TwinWrapper):
    """The twin, whose simulations end after `stop` samples, before other numbers."""

    def __init__(self, stop: int) -> None:
        self.twin, self.stop = TWIN, stop

    def simulate(self, *given: Any, **options: Any) -> rt.Trajectories:
        made = self.twin.simulate(*given, **options)
        mask = np.ones(made.nominal.shape, dtype=bool)
        mask[:, self.stop :] = False
        nominal = np.where(mask, made.nominal, np.float32(1e4))
        return made.replace(nominal=nominal, observed=nominal, mask=mask)


def test_after_the_end_of_a_simulation_the_error_is_that_of_held_out_ones(
    surrogate: rt.Surrogate,
) -> None:
    sent = commands(3, 1.0, 2)
    segments = Segments.from_commands(sent)
    found = surrogate_variance(surrogate, Ending(int(segments.start[0, 2]) + 5), sent, segments)
    exact = surrogate_variance(surrogate, TWIN, sent, segments)
    torch.testing.assert_close(found[0, :2], exact[0, :2])
    assert (found[0, 2] < 1e3).all()
    torch.testing.assert_close(found[0, 3], surrogate.held_out_variance)
