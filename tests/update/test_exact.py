"""A twin in place of a surrogate."""

from __future__ import annotations

import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.nets.training import Training

CHANNELS = rt.Channels(("u", "v"), ("1", "1")), rt.Channels(("x", "y"), ("m", "m"))
BRIEF = rt.Mixture(components=1, hidden=(4,), training=Training(max_epochs=3))


def double(commands: np.ndarray) -> np.ndarray:
    return 2.0 * commands


TWIN = rt.FunctionTwin(double, *CHANNELS, rate=10.0)


class Module(torch.nn.Module):
    """The same as a torch module that is a twin."""

    inputs, outputs = CHANNELS
    rate = 10.0
    simulate = staticmethod(TWIN.simulate)

    def forward(self, commands: torch.Tensor) -> torch.Tensor:
        return 2.0 * commands


@pytest.fixture(scope="module")
def measured() -> rt.Trajectories:
    """Four trajectories of two segments, 2 samples late and 0.1 too far."""
    rng = np.random.default_rng(0)
    levels = rng.uniform(0.5, 1, (4, 3, 2)) * np.array([1, -1, 1])[:, None]
    ramp = np.clip((np.arange(30) - 5) / 8, 0, 1)[:, None]
    commands = levels[:, :-1, None] + ramp * np.diff(levels, axis=1)[:, :, None]
    commands = commands.reshape(4, 60, 2)
    made = TWIN.simulate(commands, seed=0)
    late = np.concatenate([made.nominal[:, :1]] * 2 + [made.nominal[:, :-2]], axis=1)
    reached = np.clip((np.arange(60) - 7) / 8, 0, 1)[:, None]
    observed = late + 0.1 * reached + 0.001 * rng.normal(size=late.shape)
    return made.replace(observed=observed.astype(np.float32), labels=np.full(4, "Healthy"))


@pytest.mark.slow
@pytest.mark.parametrize("twin", [TWIN, Module()], ids=["function", "module"])
@pytest.mark.parametrize("correction", [rt.DelayOffset(), rt.CommandSpace()], ids=["out", "in"])
def test_a_twin_is_corrected_without_a_surrogate(
    twin: rt.Twin, correction: rt.Correction, measured: rt.Trajectories
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        residual = rt.fit_residual(twin, measured, correction, BRIEF, seed=0)
        _, found = rt.infer_discrepancy(twin, measured, correction)
    assert found.z[:, 0, 0].numpy() == pytest.approx(2.0, abs=0.3)
    scale = 0.1 if isinstance(correction, rt.DelayOffset) else 0.05
    assert found.z[:, :, 1:3].numpy() == pytest.approx(scale, abs=0.01)
    updated = rt.CorrectedTwin(twin, residual)
    made = updated.simulate(measured.commands, seed=1)
    np.testing.assert_allclose(made.nominal, 2.0 * measured.commands, atol=1e-6)
    assert abs(made.observed - measured.observed).mean() < abs(measured.residual).mean()


@pytest.mark.slow
def test_finite_differences_are_a_warning_on_cost(measured: rt.Trajectories) -> None:
    with pytest.warns(UserWarning, match=r"simulates it once per component of z; .*fit_surrogate"):
        rt.infer_discrepancy(TWIN, measured, rt.CommandSpace())


@pytest.mark.slow
def test_what_needs_a_surrogate_is_refused(measured: rt.Trajectories, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="DelayOffset cannot express what was measured"):
        residual = rt.fit_residual(TWIN, measured, rt.DelayOffset(), BRIEF, seed=0)
    rt.CorrectedTwin(TWIN, residual).save(tmp_path / "twin")
    with pytest.raises(rt.InputError, match=r"twin: expected the twin of this model"):
        rt.load_twin(tmp_path / "twin")
    again = rt.load_twin(tmp_path / "twin", TWIN)
    np.testing.assert_allclose(
        again.simulate(measured.commands, seed=1).nominal,
        TWIN.simulate(measured.commands, seed=1).nominal,
        rtol=1e-6,
    )
    with pytest.raises(rt.InputError, match=r"surrogate: expected a surrogate, or a twin"):
        rt.fit_residual(object(), measured, rt.DelayOffset(), seed=0)  # type: ignore[call-overload]
    refined = rt.Mixture(
        refinement=rt.Refinement(draws=2, training=Training(max_epochs=1)),
        training=Training(max_epochs=2),
    )
    with (
        pytest.raises(rt.InputError, match="a twin that is a torch module"),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        rt.fit_residual(TWIN, measured, rt.CommandSpace(), refined, seed=0)


@pytest.mark.slow
def test_a_twin_is_inverted_and_its_diagnoser_is_not_saved(
    measured: rt.Trajectories, tmp_path: Path
) -> None:
    faults = {"Healthy": None, "Bias": rt.ActuatorBias(0, size=(0.5, 1.0))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        residual = rt.fit_residual(TWIN, measured, rt.CommandSpace(), BRIEF, seed=0)
        diagnoser = rt.fit_inversion(TWIN, residual, measured, faults)
        biased = measured.replace(observed=measured.observed + np.array([1.5, 0], np.float32))
        found = [diagnoser.predict_proba(each[:2])[:, 1] for each in (measured, biased)]
    assert (found[0] < 0.5).all()
    assert (found[1] > 0.5).all()
    with pytest.raises(rt.InputError, match="can be opened again"):
        diagnoser.save(tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_twin_in_place_of_a_surrogate_has_no_onnx_graph(measured: rt.Trajectories) -> None:
    export = pytest.importorskip("retwin.deploy.onnx.export")
    with pytest.warns(UserWarning, match="DelayOffset cannot express what was measured"):
        residual = rt.fit_residual(TWIN, measured, rt.DelayOffset(), BRIEF, seed=0)
    bundle = SimpleNamespace(twin=rt.CorrectedTwin(TWIN, residual), diagnoser=None)
    with pytest.raises(rt.InputError, match="a twin in place of a surrogate: it is no network"):
        export._check_exportable(bundle)
