"""Twins with parameters: one value per simulation is the same as one twin per value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, armpi_parametric
from retwin.testing import TWIN_CHECKS, TwinSubject
from retwin.twins.function import FunctionTwin
from retwin.twins.mujoco.twin import MuJoCoTwin
from retwin.twins.wrappers.command_side import CommandSide, command_side_parameters
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin

CHANNEL = rt.Channels(("u",), ("V",))
LEVEL = rt.Channels(("y",), ("m",))


def scaled(commands: np.ndarray, gain: float) -> np.ndarray:
    return gain * commands


def build(values) -> FunctionTwin:
    return FunctionTwin(partial(scaled, gain=values["gain"]), CHANNEL, LEVEL, 10.0)


GAIN = ParametricTwin.built(build, [Parameter("gain", "m/V", 0.0, 4.0, 1.0)])
RAMP = np.tile(np.arange(10.0)[:, None], (3, 1, 1))


def arm_commands(case: rt.Case, count: int = 3) -> np.ndarray:
    sampler = replace(case.sampler, movements=2, duration=3.0, period=1.5)
    return sampler.sample(count, rng=np.random.default_rng(0)).astype(float)


def test_one_value_per_simulation() -> None:
    made = GAIN.simulate(RAMP, seed=0, parameters={"gain": [1.0, 2.0, 1.0]})
    assert made.observed == pytest.approx(RAMP * np.array([1.0, 2.0, 1.0])[:, None, None])
    assert GAIN.with_values({"gain": 3.0}).simulate(RAMP, seed=0).observed == pytest.approx(
        3 * RAMP
    )


def test_one_parameter_may_stand_behind_several_places() -> None:
    def twice(values) -> FunctionTwin:
        return FunctionTwin(lambda u: (values["a"] + values["b"]) * u, CHANNEL, LEVEL, 10.0)

    parts = [Parameter("a", "1", 0, 9), Parameter("b", "1", 0, 9)]
    inner = ParametricTwin.built(twice, parts).twin
    joint = Parameter("both", "1", 0.0, 2.0, 1.0, {"a": 1.0, "b": 3.0})
    twin = ParametricTwin(inner, (joint,), (0.5,))
    assert twin.simulate(RAMP, seed=0).observed == pytest.approx(2 * RAMP)


def test_a_mujoco_twin_takes_parameters_as_it_is() -> None:
    path = Path(__file__).parents[1] / "testing" / "crane.xml"
    crane = MuJoCoTwin.from_file(path, rate=50.0, inputs=["limited"], outputs=["hook"])
    twin = ParametricTwin(crane, (Parameter("body.load.mass", "kg", 0.1, 2.0),))
    pushes = np.zeros((2, 60, 1))
    pushes[:, 10:] = 0.5
    masses = np.array([0.2, 1.5])
    both = twin.simulate(pushes, seed=0, parameters={"body.load.mass": masses}).observed
    for i, mass in enumerate(masses):
        alone = twin.with_values([mass]).simulate(pushes[:1], seed=0).observed
        assert alone[0] == pytest.approx(both[i])
    assert np.abs(both[0] - both[1]).max() > 1e-3


def test_command_side_delays_by_fractions_and_shifts() -> None:
    twin = CommandSide(GAIN)
    made = twin.simulate(
        RAMP, seed=0, parameters={"delay": [0.0, 0.2, 0.25], "offset.u": 0.25, "gain": 1.0}
    )
    assert made.observed[0] == pytest.approx(RAMP[0] + 0.25)
    assert made.observed[1, 2:] == pytest.approx(RAMP[0, :-2] + 0.25)
    assert made.observed[2, 3:] == pytest.approx(RAMP[0, 3:] - 2.5 + 0.25)
    assert made.observed[2, :2] == pytest.approx(0.25)
    assert made.nominal == pytest.approx(RAMP)


def test_command_side_at_rest_is_the_twin_itself(case: rt.Case) -> None:
    commands = arm_commands(case)
    faults = (None, rt.Stuck(1, onset=(0.2, 0.8)), rt.ActuatorBias(2, (10.0, 50.0)))
    for plain, sided in ((KINEMATIC, CommandSide(KINEMATIC)), (case.twin, armpi_parametric())):
        for name in ("nominal", "observed"):
            wanted = getattr(plain.simulate(commands, faults=faults, seed=0), name)
            got = getattr(sided.simulate(commands, faults=faults, seed=0), name)
            assert got == pytest.approx(wanted, abs=1e-12)


def test_what_is_pushed_beyond_the_limits_saturates() -> None:
    top = np.full((1, 50, 4), 1000.0)
    pushed = {f"offset.motor_{i}": 20.0 for i in range(1, 5)}
    made = CommandSide(KINEMATIC).simulate(top, seed=0, parameters=pushed)
    assert made.observed == pytest.approx(KINEMATIC.simulate(top, seed=0).observed)


def test_stiffness_and_damping_act_on_the_arm(case: rt.Case) -> None:
    commands = arm_commands(case, 1)
    twin = armpi_parametric()
    now = dict(zip(twin.names, twin.values, strict=True))
    plain = twin.simulate(commands, seed=0).observed
    # The lag behind a ramp is damping / stiffness: doubling both hardly changes the response.
    both = {"stiffness": 2 * now["stiffness"], "damping": 2 * now["damping"]}
    alike = twin.with_values(both).simulate(commands, seed=0).observed
    soft = twin.with_values({"damping": 4 * now["damping"]}).simulate(commands, seed=0).observed
    assert np.abs(soft - plain).max() > 5 * np.abs(alike - plain).max() > 0


def test_holding_keeps_the_value() -> None:
    twin = armpi_parametric().with_values({"damping": 9.0, "delay": 0.03})
    held = twin.holding("stiffness", "damping")
    assert held.names == twin.names[2:]
    commands = np.full((1, 60, 4), 500.0)
    commands[:, 20:] = 600.0
    assert held.simulate(commands, seed=0).observed == pytest.approx(
        twin.simulate(commands, seed=0).observed
    )


def test_a_failed_simulation_is_named() -> None:
    commands = np.full((3, 40, 4), 500.0)
    commands[:, 10:] = 620.0
    twin = armpi_parametric(rt.cases.ArmPiTwin(step=0.01))
    unstable = {"damping": [4.7, -1e6, 4.7]}
    with pytest.raises(rt.SimulationError) as caught:
        twin.simulate(commands, seed=0, parameters=unstable)
    assert set(caught.value.failed) == {1}
    assert caught.value.finished.ids.tolist() == ["00000", "00002"]


def test_bad_parameters_are_named() -> None:
    one = Parameter("gain", "m/V", 0.0, 4.0)
    for match, call in {
        "bounds": lambda: Parameter("x", "1", 2.0, 1.0),
        "start": lambda: Parameter("x", "1", 0.0, 1.0, 3.0),
        "no name twice": lambda: ParametricTwin(GAIN.twin, (one, one)),
        "at least one": lambda: GAIN.holding("gain"),
        "simulate takes values of its parameters, got FunctionTwin": lambda: ParametricTwin(
            rt.FunctionTwin(np.copy, GAIN.inputs, GAIN.inputs, 10.0), (one,)
        ),
        "some of gain": lambda: GAIN.simulate(RAMP, seed=0, parameters={"mass": 1.0}),
        "one for all, or one per trajectory, 3": lambda: GAIN.simulate(
            RAMP, seed=0, parameters={"gain": [1.0, 2.0]}
        ),
        "finite numbers, one per parameter": lambda: GAIN.with_values([1.0, 2.0]),
        "returns a twin": lambda: ParametricTwin.built(dict, [one]).inputs,
    }.items():
        with pytest.raises(rt.InputError, match=match):
            call()


SUBJECTS = {
    "built": lambda case: TwinSubject(GAIN, RAMP),
    "command side": lambda case: TwinSubject(
        ParametricTwin(
            CommandSide(KINEMATIC),
            command_side_parameters(KINEMATIC.inputs, delay=(0.0, 0.09), offset=9.0),
            (2.5, 1.0, -2.0, 3.0, -4.0),
        ),
        arm_commands(case),
        (None, rt.Stuck(1, onset=(0.2, 0.8)), rt.ActuatorBias(2, (10.0, 50.0))),
    ),
    "arm": lambda case: TwinSubject(
        armpi_parametric(rt.cases.ArmPiTwin(step=0.01)),
        arm_commands(case),
        (None, rt.Stuck(1, onset=(0.2, 0.8)), rt.ActuatorBias(2, (10.0, 50.0))),
    ),
}


@pytest.mark.parametrize("check", TWIN_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("kind", SUBJECTS)
def test_contract(case: rt.Case, kind: str, check: Callable) -> None:
    check(SUBJECTS[kind](case))
