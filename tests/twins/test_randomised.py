"""Twins that draw parameters or noise per trajectory draw from the right distribution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, armpi_parametric
from retwin.testing import TWIN_CHECKS, TwinSubject
from retwin.twins.function import FunctionTwin
from retwin.twins.wrappers.command_side import CommandSide, command_side_parameters
from retwin.twins.wrappers.noisy import NoisyTwin, residual_scale
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.randomised import RandomisedTwin

CHANNEL = rt.Channels(("u",), ("V",))
LEVELS = rt.Channels(("y", "p"), ("m", "bar"))


def both(commands: np.ndarray) -> np.ndarray:
    return np.concatenate([commands, 10 * commands], axis=-1)


PLAIN = FunctionTwin(both, CHANNEL, LEVELS, 10.0)
SHIFTED = ParametricTwin(
    CommandSide(PLAIN), command_side_parameters(CHANNEL, delay=(0.0, 0.5), offset=2.0)
)


def test_parameters_are_uniform_within_their_bounds_and_one_per_trajectory() -> None:
    still = np.full((400, 8, 1), 3.0)
    made = RandomisedTwin(SHIFTED).simulate(still, seed=0)
    offset = made.observed[:, :, 0] - 3.0
    assert np.ptp(offset, axis=1) == pytest.approx(np.zeros(400), abs=1e-12)
    assert kstest(offset[:, 0], "uniform", (-2.0, 4.0)).pvalue > 0.01
    assert made.nominal == pytest.approx(both(still))


def test_noise_has_its_scale_at_readings_and_is_linear_between() -> None:
    still = np.zeros((200, 41, 1))
    made = NoisyTwin(PLAIN, np.array([0.5, 2.0]), sensor_rate=1.0).simulate(still, seed=0)
    read = made.observed[:, ::10]
    assert read.std(axis=(0, 1)) == pytest.approx([0.5, 2.0], rel=0.06)
    assert np.corrcoef(read[:, 0, 0], read[:, 1, 0])[0, 1] == pytest.approx(0, abs=0.2)
    assert np.corrcoef(read[..., 0].ravel(), read[..., 1].ravel())[0, 1] == pytest.approx(
        0, abs=0.1
    )
    assert made.observed[:, 5] == pytest.approx((read[:, 0] + read[:, 1]) / 2)
    assert not made.nominal.any()


def test_the_scale_is_found_again_in_what_was_measured() -> None:
    commands = np.zeros((300, 20, 1))
    made = NoisyTwin(PLAIN, np.array([0.5, 2.0])).simulate(commands, seed=1)
    assert residual_scale(made) == pytest.approx([0.5, 2.0], rel=0.05)
    spoilt = made.observed.copy()
    spoilt[:, 3] = 1e6
    seen = np.ones_like(made.mask)
    seen[:, 3] = False
    assert residual_scale(made.replace(observed=spoilt, mask=seen)) == pytest.approx(
        [0.5, 2.0], rel=0.05
    )


def test_bad_input_is_named() -> None:
    made = PLAIN.simulate(np.zeros((2, 20, 1)), seed=0)
    faulty = made.replace(labels=np.array(["Healthy", "Stuck"]))
    unseen = np.ones_like(made.mask)
    unseen[..., 1] = False
    for match, call in {
        "scale: expected 2": lambda: NoisyTwin(PLAIN, np.ones(3)),
        "of at least 0": lambda: NoisyTwin(PLAIN, np.array([1.0, -1.0])),
        "sensor_rate": lambda: NoisyTwin(PLAIN, np.ones(2), sensor_rate=3.0),
        "sensor_rate: expected 10": lambda: NoisyTwin(PLAIN, np.ones(2), sensor_rate=0.0),
        "calibration: expected healthy": lambda: residual_scale(faulty),
        "every output": lambda: residual_scale(made.replace(mask=unseen)),
    }.items():
        with pytest.raises(rt.InputError, match=match):
            call()


def test_a_simulation_that_fails_inside_is_named() -> None:
    commands = np.full((3, 40, 4), 500.0)
    commands[:, 10:] = 620.0
    unstable = armpi_parametric(rt.cases.ArmPiTwin(step=0.01)).with_values({"damping": -1e6})
    with pytest.raises(rt.SimulationError) as caught:
        NoisyTwin(unstable, np.ones(3)).simulate(commands, seed=0)
    assert set(caught.value.failed) == {0, 1, 2}


def arm_commands(case: rt.Case) -> np.ndarray:
    sampler = replace(case.sampler, movements=2, duration=3.0, period=1.5)
    return sampler.sample(3, rng=np.random.default_rng(0)).astype(float)


SUBJECTS = {
    "randomised": RandomisedTwin(armpi_parametric()),
    "noisy": NoisyTwin(KINEMATIC, np.full(3, 0.01), sensor_rate=10.0),
}


@pytest.mark.parametrize("check", TWIN_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("kind", SUBJECTS)
def test_contract(case: rt.Case, kind: str, check: Callable) -> None:
    faults = (None, rt.Stuck(1, onset=(0.2, 0.8)), rt.ActuatorBias(2, (10.0, 50.0)))
    check(TwinSubject(SUBJECTS[kind], arm_commands(case), faults))


def test_arms_at_all_corners_of_the_box_can_be_simulated(case: rt.Case) -> None:
    """The integrator must be stable in the whole range of the parameters."""
    twin = armpi_parametric()
    low, high = twin.bounds
    corners = np.array([[a, b] for a in (low[0], high[0]) for b in (low[1], high[1])])
    commands = np.repeat(arm_commands(case)[:1], 4, axis=0)
    values = {"stiffness": corners[:, 0], "damping": corners[:, 1]}
    fine = armpi_parametric(rt.cases.ArmPiTwin(step=0.001))
    coarse, wanted = (t.simulate(commands, seed=0, parameters=values) for t in (twin, fine))
    assert np.abs(coarse.observed - wanted.observed).max() < 5e-4
