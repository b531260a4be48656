"""Faults of parameters, sensors and actuators: what they do, in every kind of twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import retwin as rt
from retwin.errors import InputError
from retwin.twins import (
    ActuatorGain,
    FunctionTwin,
    NoisyTwin,
    Parameter,
    ParameterDrift,
    ParameterShift,
    SensorBias,
    SensorDrift,
    SensorFreeze,
    SensorGain,
    State,
    StateTwin,
)

RATE, STEPS = 10.0, 80
INPUTS, OUTPUTS = rt.Channels(("heat",), ("W",)), rt.Channels(("air", "double"), ("K", "K"))
LAG = StateTwin(
    (State("x", "K", 1.0),),
    lambda x, u, p: (x.x, 2 * x.x),
    INPUTS,
    OUTPUTS,
    RATE,
    derivative=lambda x, u, p: (u.heat - p.loss * x.x,),
    parameters=(Parameter("loss", "1/s", 0.1, 5.0, start=1.0),),
    substeps=4,
)
STATIC = FunctionTwin(
    lambda commands: np.concatenate([commands, 2 * commands], axis=2), INPUTS, OUTPUTS, RATE
)
TIME = np.arange(STEPS) / RATE
COMMANDS = np.ones((1, STEPS, 1))


def observed(twin, fault) -> np.ndarray:
    made = twin.simulate(COMMANDS, faults=[fault], seed=0)
    assert made.labels.tolist() == [fault.label]
    return made.observed[0]


def test_a_parameter_shift_is_that_of_the_equations() -> None:
    got = observed(LAG, ParameterShift("loss", size=1.0, onset=2.0, end=5.0, label="leak"))[:, 0]
    # x' = 1 - loss x from x = 1: it rests while loss = 1, then goes to 1/2 with rate 2, and back.
    wanted = np.ones(STEPS)
    during = (TIME >= 2) & (TIME < 5)
    wanted[during] = 0.5 + 0.5 * np.exp(-2 * (TIME[during] - 2))
    last = 0.5 + 0.5 * np.exp(-2 * 3.0)
    wanted[TIME >= 5] = 1 + (last - 1) * np.exp(-(TIME[TIME >= 5] - 5))
    np.testing.assert_allclose(got, wanted, atol=1e-6)


def test_the_nominal_output_has_no_fault() -> None:
    made = LAG.simulate(COMMANDS, faults=[ParameterShift("loss", size=1.0)], seed=0)
    np.testing.assert_allclose(made.nominal[0, :, 0], 1.0, atol=1e-9)


def test_a_drifting_parameter_moves_away_and_comes_back() -> None:
    changes = LAG.changes([ParameterDrift("loss", size=0.3, onset=2.0, end=5.0)], STEPS)
    expected = np.where((TIME >= 2) & (TIME < 5), 0.3 * (TIME - 2), 0.0)
    np.testing.assert_allclose(changes[0, :, 0], expected, atol=1e-12)


def test_shifted_parameters_are_the_same_without_a_compiler(monkeypatch) -> None:
    fault = ParameterShift("loss", size=1.0, onset=2.0, end=5.0)
    changes = LAG.changes([fault], STEPS)
    values = LAG.values(None, 1)
    measured = (np.zeros((1, STEPS, 2)), np.ones((1, STEPS, 2)))
    spread, variances = np.array([[[0.1]]]), (np.array([0.01]), np.array([0.1, 0.2]))

    def both() -> list[np.ndarray]:
        steps = LAG.steps()
        simulated = steps.run(COMMANDS, values, changes=changes)
        filtered = steps.filter(COMMANDS, values, measured, spread, variances, changes)
        return [*simulated, *filtered]

    compiled = both()
    monkeypatch.setattr("retwin.twins.compiled.steps.compiled", lambda source: None)
    for one, other in zip(compiled, both(), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("twin", [LAG, STATIC, NoisyTwin(LAG, np.array([0.0, 0.0]))])
def test_sensors_fail_in_every_twin(twin) -> None:
    healthy = twin.simulate(np.cumsum(COMMANDS, axis=1), seed=0).observed[0]

    def error(fault) -> np.ndarray:
        made = twin.simulate(np.cumsum(COMMANDS, axis=1), faults=[fault], seed=0)
        return made.observed[0] - healthy

    acts = (TIME >= 2) & (TIME < 5)
    biased = error(SensorBias(1, size=-0.5, onset=2.0, end=5.0))
    np.testing.assert_allclose(biased, np.stack([0 * TIME, np.where(acts, -0.5, 0)], 1), atol=1e-5)
    drifted = error(SensorDrift(0, size=0.3, onset=2.0, end=5.0))
    np.testing.assert_allclose(drifted[:, 0], np.where(acts, 0.3 * (TIME - 2), 0), atol=1e-5)
    scaled = error(SensorGain(1, size=-0.2, onset=2.0, end=5.0))[:, 1]
    np.testing.assert_allclose(scaled, np.where(acts, -0.2 * healthy[:, 1], 0), atol=1e-5)
    frozen = error(SensorFreeze(0, onset=2.0)) + healthy
    np.testing.assert_allclose(frozen[TIME >= 2, 0], healthy[20, 0], rtol=1e-9)
    np.testing.assert_allclose(frozen[:, 1], healthy[:, 1], rtol=1e-9)


def test_a_frozen_sensor_repeats_a_noisy_sample() -> None:
    noisy = NoisyTwin(LAG, np.array([0.1, 0.1]))
    got = observed(noisy, SensorFreeze(0, onset=2.0))
    assert len(np.unique(got[TIME >= 2, 0])) == 1
    assert len(np.unique(got[TIME >= 2, 1])) > 50


@pytest.mark.parametrize("twin", [LAG, STATIC])
def test_a_weaker_actuator_follows_a_smaller_command(twin) -> None:
    got = observed(twin, ActuatorGain(0, size=-0.4, onset=2.0))
    weaker = COMMANDS.copy()
    weaker[:, TIME >= 2] *= 0.6
    np.testing.assert_allclose(got, twin.simulate(weaker, seed=0).observed[0], atol=1e-6)


def test_what_is_open_is_drawn_between_its_limits() -> None:
    fault = SensorBias(0, size=(-2.0, 3.0), onset=(1.0, 4.0), end=(3.0, 6.0))
    faults = rt.twins.draw_faults(
        [fault] * 500, rt.Segments.from_commands(np.repeat(COMMANDS, 500, axis=0)), 0, rate=RATE
    )
    size, onset, end = (np.array([getattr(f, n) for f in faults]) for n in ("size", "onset", "end"))
    assert (size.min() >= -2, size.max() <= 3) == (True, True)
    assert size.mean() == pytest.approx(0.5, abs=0.3)
    assert (onset.min(), onset.max(), end.max()) == (1.0, 4.0, 6.0)
    assert ((end > onset) & (end >= 3)).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SensorBias(0, size=0.0), "other than 0"),
        (lambda: SensorBias(0, size=(2.0, 1.0)), "in order"),
        (lambda: SensorGain(0, size=(-1.0, 1.0)), "more than -1"),
        (lambda: SensorBias(0, size=float("nan")), "size"),
        (lambda: SensorBias(0, size=1.0, onset=-1.0), "onset"),
        (lambda: SensorBias(0, size=1.0, onset=3.0, end=2.0), "after the onset"),
        (lambda: SensorFreeze(0, onset=(3.0, 2.0)), "in order"),
        (lambda: observed(LAG, SensorBias(2, size=1.0)), "output from 0 to 1"),
        (lambda: observed(LAG, ActuatorGain(1, size=1.0)), "actuator from 0 to 0"),
        (lambda: observed(LAG, ParameterShift("gain", size=1.0)), "one of the parameters loss"),
        (lambda: observed(STATIC, ParameterShift("loss", size=1.0)), "StateTwin"),
        (lambda: observed(LAG, SensorBias(0, size=1.0, onset=8.0)), "within the trajectory"),
    ],
)
def test_faults_without_sense_are_refused(make, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_a_free_parameter_can_shift() -> None:
    twin = LAG.parametric().with_values({"loss": 2.0})
    fault = ParameterShift("loss", size=-1.0)
    got = twin.simulate(COMMANDS, faults=[fault], seed=0).observed
    np.testing.assert_allclose(got, LAG.simulate(COMMANDS, seed=0).observed, atol=1e-6)


CASE = """
name = "oven"
twin = "oven:TWIN"
[parameters.loss]
unit = "1/s"
low = 0.1
high = 5.0
start = 1.0
[commands]
kind = "HoldSampler"
low = [0.0]
high = [2.0]
duration = 8.0
hold_durations = [1.0, 3.0]
[faults]
leak = { kind = "ParameterShift", parameter = "loss", size = [0.5, 1.0], onset = [1.0, 4.0] }
weak = { kind = "ActuatorGain", actuator = "heat", size = [-0.5, -0.2] }
stale = { kind = "SensorFreeze", output = "air", onset = 2.0 }
"""
MODULE = """
import retwin as rt
from retwin.twins import Parameter, State, StateTwin
TWIN = StateTwin(
    (State("x", "K", 1.0),), lambda x, u, p: (x.x, 2 * x.x),
    rt.Channels(("heat",), ("W",)), rt.Channels(("air", "double"), ("K", "K")), 10.0,
    derivative=lambda x, u, p: (u.heat - p.loss * x.x,),
    parameters=(Parameter("loss", "1/s", 0.1, 5.0, start=1.0),), substeps=4,
)
"""


def test_a_case_file_has_faults_of_the_system(tmp_path) -> None:
    (tmp_path / "oven.py").write_text(MODULE)
    (tmp_path / "case.toml").write_text(CASE)
    case = rt.cases.get(str(tmp_path / "case.toml"))
    assert case.classes == ("Healthy", "leak", "weak", "stale")
    made = rt.generate(case.twin, case, per_class=3, seed=0)
    stale = made.with_label("stale").observed[:, 20:, 0]
    assert (stale == stale[:, :1]).all()
    assert not np.allclose(made.with_label("leak").observed, made.with_label("leak").nominal)
    (tmp_path / "case.toml").write_text(CASE.replace('"loss", size', '"lost", size'))
    with pytest.raises(InputError, match=r"leak.*one of the parameters loss"):
        rt.cases.get(str(tmp_path / "case.toml"))


def test_a_fault_is_saved_by_name() -> None:
    from retwin.serialisation.configs import from_config, to_config
    from retwin.twins.faults.system_faults import FAULTS

    fault = SensorDrift(1, size=(0.1, 0.2), onset=(1.0, 2.0), end=3.0, label="drift")
    assert from_config(to_config(fault, FAULTS), FAULTS) == fault
    assert replace(fault, label="other") != fault
