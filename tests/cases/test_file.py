"""A case as a file: every key has its effect, and a refusal names the file and the key."""

from __future__ import annotations

import copy
import os
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import reduce
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmus import python_fmu

import retwin as rt
from retwin.cases import ColumnRecords
from retwin.testing import check_twin
from retwin.twins.commands.samplers import (
    HoldSampler,
    MultisineSampler,
    RampSampler,
    RecordedSampler,
)
from retwin.twins.faults.system_faults import SensorFreeze
from retwin.update.identification import LeastSquares, identify
from retwin.update.residual import SequenceMixture

MODULE = """
import numpy as np
import retwin as rt


def turned(commands, *, gain=2.0, offset=0.0):
    return gain * commands[..., :1] + offset + commands[..., 1:]


def ideal(commands):
    return commands[..., :1]


def lagging(commands):
    return np.cumsum(commands[..., :1], axis=1) / 10


def noisy(commands, rng):
    return ideal(commands) + rng.normal(size=(*commands.shape[:2], 1))


class Late:
    rate = 10.0
    steps = 30

    def sample(self, count, *, rng, onsets=None):
        return rng.uniform(size=(count, 30, 2))


def split(path):
    return path, path


def foreign(path):
    data = rt.FunctionTwin(ideal, CHANNELS, CHANNELS, 10).simulate(np.ones((1, 9, 1)), seed=0)
    return data, data


CHANNELS = rt.Channels(("a",), ("V",))
leak = rt.ActuatorBias(1, (1.0, 2.0))
TWIN = rt.FunctionTwin(turned, rt.Channels(("a", "b"), ("V", "V")), rt.Channels(("y",), ("m",)), 10)
"""

STATES = """
import retwin as rt
from retwin.twins import Parameter, State, StateTwin

tank = StateTwin(
    (State("level", "m"),),
    lambda x, u: x.level,
    rt.Channels(("valve",), ("1",)),
    rt.Channels(("level",), ("m",)),
    1.0,
    derivative=lambda x, u, p: (u.valve - p.leak * x.level,),
    parameters=(Parameter("leak", "1/s", 0.01, 0.1, 0.05),),
    limits=rt.Limits((0,), (1,)),
)
"""

BODY = """
name = "toy"
twin = "toy_module:turned"
rate = 10

[inputs]
a = { unit = "V", low = -1, high = 1 }
b = { unit = "V", low = 0, high = 4 }

[outputs]
y = { unit = "m" }
"""
BASE = (
    BODY
    + """
[commands]
duration = 100
segments = 5
"""
)

EVERYTHING = """
title = "A toy"
sensor_rate = 5
network = "tcn"
""" + BODY + """
[commands]
kind = "HoldSampler"
duration = 5
hold_durations = [0.5, 0.9]
[correction]
kind = "Chain"
first = { kind = "CommandSpace", delay_range = [0, 4] }
second = { kind = "SampledSensor", period = 0.2 }
[output_correction]
kind = "DelayOffset"
known_delay = 1
[density]
kind = "Mixture"
components = 2
training = { max_epochs = 5 }
refinement = { draws = 4 }
[training]
max_epochs = 3
decay = "step"
[parameters.gain]
unit = "m/V"
low = 1
high = 3
[parameters.offset]
unit = "m"
low = -1
high = 1
start = 0.5
[faults]
b_stuck = { kind = "Stuck", actuator = "b", onset = [0.3, 0.9] }
a_off = { kind = "ActuatorBias", actuator = 0, size = [0.5, 1] }
leak = "toy_module:leak"
[causes]
sensor = { kind = "SensorFreeze", output = "y" }
[records]
calibration = { a = "a1", b = "b1", y = "y1" }
test = { a = "a2", b = "b2", y = "y2" }
"""  # fmt: skip

PENDULUM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
      <site name="tip" pos="0 0 -0.5"/>
    </body>
  </worldbody>
  <actuator><position name="push" joint="hinge" kp="20" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.fixture
def read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., rt.Case]]:
    """The case of a text, beside a module of the user's."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "toy_module.py").write_text(MODULE)

    def case(text: str) -> rt.Case:
        (tmp_path / "case.toml").write_text(text)
        return rt.cases.get(str(tmp_path / "case.toml"))

    yield case
    sys.modules.pop("toy_module", None)


def commands(case: rt.Case, count: int = 4) -> np.ndarray:
    return case.sampler.sample(count, rng=np.random.default_rng(0)).astype(float)


def test_few_keys_are_needed(read: Callable[..., rt.Case]) -> None:
    case = read(BASE)
    assert (case.name, case.title, case.rate, case.sensor_rate) == ("toy", "toy", 10.0, 10.0)
    assert case.inputs == rt.Channels(("a", "b"), ("V", "V"))
    assert case.outputs == rt.Channels(("y",), ("m",))
    assert case.twin.limits == rt.Limits((-1.0, 0.0), (1.0, 4.0))
    assert case.classes == ("Healthy",)
    assert case.sampler == RampSampler((-1.0, 0.0), (1.0, 4.0), 10.0, 100, 5)
    assert case.correction == case.output_correction == rt.DelayOffset()
    assert (case.density, case.network, case.training) == (rt.Mixture(), rt.MLP(), None)
    assert case.parametric is case.records is None
    drawn = commands(case)
    made = case.twin.simulate(drawn, seed=0)
    np.testing.assert_allclose(made.observed, 2 * drawn[..., :1] + drawn[..., 1:])
    with pytest.raises(rt.InputError, match="b from 0 to 4 V"):
        case.twin.simulate(drawn - 1, seed=0)


def test_every_key_has_its_effect(read: Callable[..., rt.Case]) -> None:
    case = read(EVERYTHING)
    assert (case.title, case.sensor_rate, case.network) == ("A toy", 5.0, rt.TCN())
    assert case.sampler == HoldSampler((-1.0, 0.0), (1.0, 4.0), 10.0, 5, (0.5, 0.9))
    space = rt.CommandSpace(delay_range=(0, 4))
    assert case.correction == rt.Chain(space, rt.SampledSensor(period=0.2))
    assert case.output_correction == rt.DelayOffset(known_delay=1)
    assert case.density == rt.Mixture(
        components=2, training=rt.Training(max_epochs=5), refinement=rt.Refinement(draws=4)
    )
    assert case.training == rt.Training(max_epochs=3, decay="step")
    assert dict(case.faults) == {
        "Healthy": None,
        "b_stuck": rt.Stuck(1, (0.3, 0.9)),
        "a_off": rt.ActuatorBias(0, (0.5, 1.0)),
        "leak": rt.ActuatorBias(1, (1.0, 2.0)),
    }
    assert case.causes == {"sensor": SensorFreeze(0)}
    assert [*case.alarm_causes] == [*case.faults, "sensor"]
    assert case.parametric is case.twin
    assert case.parametric.parameters == (
        rt.Parameter("gain", "m/V", 1, 3),
        rt.Parameter("offset", "m", -1, 1, 0.5),
    )
    assert isinstance(case.records, ColumnRecords)


def test_parameters_are_arguments_of_the_function(read: Callable[..., rt.Case]) -> None:
    case = read(
        BODY + "[parameters]\n"
        'gain = { unit = "m/V", low = 1, high = 3 }\n'
        'offset = { unit = "m", low = -1, high = 1, start = 0.5 }\n'
        "[commands]\nduration = 4\nsegments = 2\nramp_durations = [0.5]\n"
    )
    drawn = commands(case)
    np.testing.assert_allclose(
        case.twin.simulate(drawn, seed=0).observed, 2 * drawn[..., :1] + drawn[..., 1:] + 0.5
    )
    check_twin(case.twin, drawn)
    truth = case.parametric.with_values({"gain": 1.4, "offset": -0.3})
    measured = truth.simulate(drawn, seed=0)
    found = identify(case.parametric, measured, seed=0, method=LeastSquares(starts=1))
    assert found.values == pytest.approx({"gain": 1.4, "offset": -0.3}, abs=1e-4)


MULTISINE = """
[commands]
kind = "MultisineSampler"
duration = 10
band = [0.1, 2.0]
mean = [0, 2]
deviation = [0.3, 0.3]
"""


def test_correction_and_network_are_those_that_suit_the_system(
    read: Callable[..., rt.Case],
) -> None:
    """Without segments no correction per segment, and with memory no network without."""
    static = read(BODY + MULTISINE)
    assert (static.correction, static.network) == (rt.Additive(), rt.MLP())
    lagging = read(BASE.replace("turned", "lagging"))
    assert (lagging.correction, lagging.network) == (rt.DelayOffset(), rt.LSTM())
    given = 'correction = "delay_offset"\nnetwork = "mlp"\n' + BODY.replace("turned", "lagging")
    chosen = read(given + MULTISINE)
    assert (chosen.correction, chosen.network) == (rt.DelayOffset(), rt.MLP())


RECORDS = """
[records]
calibration = [
    { columns = { a = "u", b = "v", y = "w" }, rows = [0, 40], transient = 0.45 },
    { columns = { a = "u", b = "v", y = "w" }, rows = [40, 60] },
]
test = { columns = { a = "u", b = "v", y = "w" }, rows = [60, 90] }
"""


def test_records_are_parts_of_a_table(read: Callable[..., rt.Case], tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    table = rng.uniform(0, 1, (100, 3))
    np.savetxt(tmp_path / "d.csv", table, delimiter=",", header="u,v,w", comments="")
    calibration, test = read(BASE + RECORDS).records(tmp_path / "d.csv")
    assert calibration.ids.tolist() == ["calibration-1", "calibration-2"]
    assert test.ids.tolist() == ["test"]
    np.testing.assert_allclose(test.commands[0], table[60:90, :2])
    np.testing.assert_allclose(test.observed[0, :, 0], table[60:90, 2])
    np.testing.assert_allclose(calibration.commands[1, :20], table[40:60, :2])
    # A transient is masked, and so is what pads the shorter record.
    assert calibration.mask[:, :, 0].tolist() == [
        [False] * 4 + [True] * 36,
        [True] * 20 + [False] * 20,
    ]
    assert test.mask.all()


def test_a_function_of_records_is_checked(read: Callable[..., rt.Case], tmp_path: Path) -> None:
    for name, message in [
        (
            "split",
            r"case\.toml: records \(toy_module:split\): expected a function that returns two",
        ),
        (
            "foreign",
            r"case\.toml: records .*\.inputs: expected that of the twin, a .*, b .*, got a",
        ),
    ]:
        case = read(f'records = "toy_module:{name}"\n' + BASE)
        with pytest.raises(rt.InputError, match=message):
            case.records(tmp_path / "d.csv")


def test_a_correction_per_sample_brings_its_density(read: Callable[..., rt.Case]) -> None:
    case = read('correction = "additive"\n' + BASE)
    assert case.correction == case.output_correction == rt.Additive()
    assert case.density == SequenceMixture()
    keys = """
correction.kind = "Additive"
density = { kind = "SequenceMixture", members = 3, network = { kind = "LSTM", hidden = 8 } }
"""
    case = read(keys + BASE)
    assert case.density == SequenceMixture(members=3, network=rt.LSTM(8))


@pytest.mark.parametrize(
    ("keys", "wanted"),
    [
        (
            'kind = "MultisineSampler"\nmean = [0.1, 1]\nduration = 50\nband = [0.1, 2]',
            {"steps": 500, "mean": (0.1, 1.0), "corner": 2},
        ),
        (
            "low = [0, 1]\nhigh = [1, 2]\nsegments = 3\nduration = 6\nramp_durations = [0.8, 1.2]",
            {"low": (0.0, 1.0), "segments": 3, "duration": 6.0, "ramp_durations": (0.8, 1.2)},
        ),
    ],
)
def test_commands_are_drawn_as_described(
    read: Callable[..., rt.Case], keys: str, wanted: dict[str, Any]
) -> None:
    sampler = read(BODY + "[commands]\n" + keys).sampler
    assert isinstance(sampler, MultisineSampler | RampSampler)
    assert {name: getattr(sampler, name) for name in wanted} == wanted


def test_commands_may_be_recorded_or_of_ones_own(
    read: Callable[..., rt.Case], tmp_path: Path
) -> None:
    case = read(BASE)
    rt.save(case.twin.simulate(commands(case), seed=0), tmp_path / "recorded.npz")
    keys = 'commands = { kind = "RecordedSampler", file = "recorded.npz", duration = 90 }\n'
    sampler = read(keys + BODY).sampler
    assert isinstance(sampler, RecordedSampler)
    np.testing.assert_array_equal(sampler.commands, commands(case))
    assert sampler.steps == 900
    own = read('commands = "toy_module:Late"\n' + BODY).sampler
    assert own.sample(2, rng=np.random.default_rng(0)).shape == (2, 30, 2)


def test_a_random_function_names_its_nominal(read: Callable[..., rt.Case]) -> None:
    text = BASE.replace('"toy_module:turned"', '{ name = "toy_module:noisy", nominal = "NOMINAL" }')
    case = read(text.replace("NOMINAL", "toy_module:ideal"))
    made = case.twin.simulate(commands(case), seed=0)
    assert made.residual.std() == pytest.approx(1.0, rel=0.1)
    with pytest.raises(rt.InputError, match=r"case.toml: twin.nominal.*no attribute 'nothing'"):
        read(text.replace("NOMINAL", "toy_module:nothing"))


def test_a_twin_object_has_its_own_channels(read: Callable[..., rt.Case]) -> None:
    case = read('name = "toy"\ntwin = "toy_module:TWIN"\ncommands.low = [0, 0]\n'
                "commands.high = [1, 1]\ncommands.duration = 9\n"
                "commands.segments = 3\n")  # fmt: skip
    assert case.inputs.names == ("a", "b")
    assert case.rate == 10
    times = "commands = { duration = 9, segments = 3 }\n"
    arm = read('name = "arm"\ntwin = "armpi-kinematic"\n' + times)
    assert arm.inputs.names[0] == "motor_1"
    with pytest.raises(rt.InputError, match=r"case\.toml: low: expected a value|commands\.low"):
        read('name = "toy"\ntwin = "toy_module:TWIN"\n' + times)


def test_a_parameter_that_state_equations_lack_is_no_free_one(
    read: Callable[..., rt.Case], tmp_path: Path
) -> None:
    (tmp_path / "toy_states.py").write_text(STATES)
    sampler = "kind = 'HoldSampler'\nduration = 9\nhold_durations = [1, 3]\n"
    read("name = 'toy'\ntwin = 'toy_states:tank'\n[commands]\n" + sampler)
    case = str(tmp_path / "case.toml")
    opened = rt.cases.open_parametric(case, ["start_level=0:1"])
    assert opened.twin.names == ("start_level",)
    with pytest.raises(rt.InputError, match=r"--free: expected some of leak.*got spare;"):
        rt.cases.open_parametric(case, ["spare=0:1"])


def test_a_model_and_an_fmu_lie_beside_the_file(
    read: Callable[..., rt.Case], tmp_path: Path
) -> None:
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    keys = 'twin = { name = "pendulum.xml", settle = 0.5, interpolate = false }\n'
    times = "commands = { duration = 8, segments = 4 }\n"
    case = read('name = "p"\nrate = 50\noutputs = ["tip"]\n' + keys + times)
    assert case.outputs.names == ("tip_x", "tip_y", "tip_z")
    assert (case.twin.settle, case.twin.interpolate, case.rate) == (0.5, False, 50.0)
    assert case.sampler == RampSampler((-1.0,), (1.0,), 50.0, 8, 4)
    heavy = '[parameters]\n"body.arm.mass" = { unit = "kg", low = 0.5, high = 2 }\n'
    case = read('name = "p"\noutputs = ["tip"]\ntwin = "pendulum.xml"\n' + times + heavy)
    assert case.parametric.simulate(np.ones((1, 5, 1)), seed=0).observed.shape == (1, 5, 3)
    python_fmu(tmp_path)
    keys = 'twin = { name = "PyLag.fmu", start = { gain = 3.0 }, step = 0.05 }\n'
    case = read('name = "lag"\nrate = 10\ninputs = ["u"]\noutputs = ["x"]\n' + keys +
                "commands = { low = [0], high = [1], duration = 8, segments = 4 }\n")  # fmt: skip
    assert (case.inputs.names, case.outputs.names) == (("u",), ("x",))
    assert (dict(case.twin.start), case.twin.substeps) == ({"gain": 3.0}, 2)


@pytest.mark.slow
def test_worker_processes_find_the_module(read: Callable[..., rt.Case], tmp_path: Path) -> None:
    case = read(BODY + "[commands]\nduration = 2\nsegments = 1\nramp_durations = [0.5]\n")
    plan = rt.deploy.SimulationPlan(case.twin, case.sampler, 0, 6, chunk=3)
    rt.deploy.simulate_to(tmp_path / "made.zarr", plan, workers=2)
    made = rt.load(tmp_path / "made.zarr")
    np.testing.assert_allclose(
        made.observed, 2 * made.commands[..., :1] + made.commands[..., 1:], rtol=1e-6
    )


@pytest.mark.slow
def test_workers_of_a_cluster_find_the_module(read: Callable[..., rt.Case], tmp_path: Path) -> None:
    from distributed import LocalCluster

    # A class of that module, whose objects cannot be unpickled without it.
    text = 'name = "toy"\ntwin = "toy_twin:TWIN"\n'
    (tmp_path / "toy_twin.py").write_text(
        "from toy_module import TWIN as INNER\n"
        "class Own:\n"
        "    inputs, outputs, rate = INNER.inputs, INNER.outputs, INNER.rate\n"
        "    def simulate(self, *args, **options):\n"
        "        return INNER.simulate(*args, **options)\n"
        "TWIN = Own()\n"
    )
    case = read(text + "commands = { low = [0, 0], high = [1, 1], duration = 2, segments = 1 }\n")
    plan = rt.deploy.SimulationPlan(case.twin, case.sampler, 0, 6, chunk=3)
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        hidden = (tmp_path / "toy_twin.py").rename(tmp_path / "hidden.py")
        with pytest.raises(OSError, match="toy_twin"):
            rt.deploy.simulate_to(tmp_path / "made.zarr", plan, scheduler=address)
        hidden.rename(tmp_path / "toy_twin.py")
        rt.deploy.simulate_to(tmp_path / "made.zarr", plan, scheduler=address)
    made = rt.load(tmp_path / "made.zarr")
    np.testing.assert_allclose(
        made.observed, 2 * made.commands[..., :1] + made.commands[..., 1:], rtol=1e-6
    )


def test_a_module_beside_the_case_is_found_alone(
    read: Callable[..., rt.Case], tmp_path: Path
) -> None:
    """A file beside it stands in for no package; the module itself may import its neighbours."""
    (tmp_path / "not_installed.py").write_text("")
    (tmp_path / "toy_helpers.py").write_text("def twice(commands):\n    return 2 * commands")
    before = [*sys.path]
    case = read(BASE)
    assert sys.path == before
    assert find_spec("not_installed") is None
    (tmp_path / "toy_two.py").write_text("from toy_helpers import twice")
    single = "{ name = 'toy_two:twice', vectorised = false, workers = 2 }"
    case = read(BASE.replace('"toy_module:turned"', single).replace("y = {", "y = {}\nz = {"))
    made = case.twin.simulate(np.ones((3, 9, 2)), seed=0)  # also in worker processes
    assert made.observed.min() == made.observed.max() == 2


def test_a_folder_of_that_name_is_not_taken(
    read: Callable[..., rt.Case], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for a project whose folder has the name of its module, with its parent on the path."""
    (tmp_path / "above" / "toy_project").mkdir(parents=True)
    (tmp_path / "toy_project.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path / "above"))
    case = read(BASE.replace("toy_module:", "toy_project:"))
    assert case.twin.simulate(np.ones((1, 9, 2)), seed=0).observed.min() == 3


def test_another_module_of_that_name_is_not_taken(
    read: Callable[..., rt.Case], tmp_path: Path
) -> None:
    read(BASE)
    other = tmp_path / "other"
    other.mkdir()
    (other / "toy_module.py").write_text(MODULE)
    (other / "case.toml").write_text(BASE)
    with pytest.raises(rt.InputError, match="another one of that name"):
        rt.cases.get(str(other / "case.toml"))


URDF = """
<robot name="one">
  <link name="base"/>
  <link name="arm"><inertial><mass value="1"/><origin xyz="0 0 -0.2"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hip" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="10" velocity="10"/></joint>
</robot>
"""


def test_a_urdf_gets_servos(read: Callable[..., rt.Case], tmp_path: Path) -> None:
    (tmp_path / "one.urdf").write_text(URDF)
    keys = """
name = "one"
rate = 50
outputs = ["arm"]
commands = { low = [-1], high = [1], duration = 1, segments = 1, ramp_durations = [0.2] }
twin = { name = "one.urdf", servos = { hip = { stiffness = 50, damping = 4 } }, step = 0.002 }
"""
    case = read(keys)
    ((joint, servo),) = case.twin.servos
    assert (joint, servo.stiffness, servo.damping) == ("hip", 50.0, 4.0)
    assert case.twin.simulate(commands(case, 1), seed=0).observed.shape == (1, 50, 3)
    with pytest.raises(
        rt.InputError, match=r"case\.toml: twin\.servos\.hip\.damp: expected one of"
    ):
        read(keys.replace("damping", "damp"))


def leaves(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Where values stand in tables in tables."""
    inside = value.items() if isinstance(value, dict) else enumerate(value)
    for key, each in inside:
        yield (*path, key)
        if isinstance(each, dict | list):
            yield from leaves(each, (*path, key))


def test_no_value_in_the_wrong_place_is_anything_but_an_input_error(
    read: Callable[..., rt.Case], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read(BASE)
    rng = np.random.default_rng(0)
    odd = [0, -1, 2.5, float("nan"), "", "x", "a:b", "..", True, [], [1, "a"], [[1]], {}]
    odd += [{"kind": "x"}, {"kind": ["x"]}, {"kind": "LSTM"}, {"a": 1}]
    valid = tomllib.loads(EVERYTHING)
    refused = 0
    for _ in range(200):
        tables = copy.deepcopy(valid)
        paths = list(leaves(tables))
        *parents, last = paths[rng.integers(len(paths))]
        inside = reduce(lambda table, key: table[key], parents, tables)
        inside[last] = odd[rng.integers(len(odd))]
        monkeypatch.setattr(
            "retwin.serialisation.configs.tomllib.loads", lambda _, tables=tables: tables
        )
        try:
            rt.cases.get(str(tmp_path / "case.toml"))
        except rt.InputError as error:
            assert "case.toml" in str(error)
            refused += 1
    assert refused > 100


WRONG = [
    ("[inputs]", "[inputs", r"case\.toml: expected a case as a TOML file, got TOMLDecodeError"),
    ('name = "toy"', "", r"case\.toml: name: expected a value, got none"),
    (BASE, "nonsense = 1\n" + BASE, r"case\.toml: nonsense: expected one of name, twin"),
    ("rate = 10", 'rate = "10"', r"case\.toml: rate: expected a valid number.*got '10'"),
    ("rate = 10", "rate = 0", r"case\.toml: rate: expected a positive number of Hz, got 0"),
    ("rate = 10", "", r"case\.toml: rate: expected a positive number of Hz, got None"),
    ("rate = 10", "rate = 10\nsensor_rate = -1", r"case\.toml: sensor_rate: expected a positive"),
    ("toy_module:turned", "toy_module:bent", r"case\.toml: twin: .*no attribute 'bent'"),
    ("toy_module:turned", "no_module:turned", r"case\.toml: twin: .*No module named"),
    ("toy_module:turned", "nothing", r"case\.toml: twin 'nothing': expected armpi, "),
    ("toy_module:turned", "gone.fmu", r"case\.toml: twin: expected a file, got .*gone\.fmu"),
    ('"toy_module:turned"', "3", r"case\.toml: twin: expected the name of a twin"),
    (
        '"toy_module:turned"',
        '{ name = "toy_module:turned", vectorized = true }',
        r"case\.toml: twin\.vectorized: expected one of vectorised, nominal, workers",
    ),
    ('unit = "m"', 'units = "m"', r"case\.toml: outputs\.y\.units: expected one of unit, low"),
    ("low = -1", 'low = "a"', r"case\.toml: inputs\.a\.low: expected a valid number, got 'a'"),
    ("low = -1", "low = 2", r"case\.toml: inputs\.limits: expected one low and one high"),
    ("low = -1, ", "", r"case\.toml: commands\.limits: expected a finite low"),
    (BASE, 'correction = "warped"\n' + BASE, r"case\.toml: correction: expected one of additive"),
    (BASE, BASE + "[correction]\nkind = 'Warp'\n", r"case\.toml: correction\.kind: expected one"),
    (
        BASE,
        BASE + "[correction]\nkind = 'SampledSensor'\n",
        r"case\.toml: correction: expected a table whose kind is a Correction",
    ),
    (
        BASE,
        BASE + "[correction]\nkind = 'Chain'\nfirst.kind = 'SampledSensor'\n",
        r"case\.toml: correction\.first: expected a table whose kind is a Correction",
    ),
    (
        BASE,
        BASE + "[density]\nkind = 'SequenceMixture'\nmembers = 1\n",
        r"case\.toml: density: expected members of at least 2",
    ),
    (
        BASE,
        'correction = "additive"\ndensity = "flow"\n' + BASE,
        r"case\.toml: density: expected SequenceMixture, for a correction with one z per sample",
    ),
    (BASE, 'density = "sequence_mixture"\n' + BASE, r"case\.toml: density: expected Mixture or"),
    (
        BASE,
        "network = { kind = 'GRU' }\n" + BASE,
        r"network\.kind: expected one of MLP, LSTM, TCN, StateSpace, got 'GRU'; check the \S+$",
    ),
    (
        BASE,
        'correction = "additive"\noutput_correction = "delay_offset"\n' + BASE,
        r"case\.toml: output_correction: expected a correction with one z per sample, ",
    ),
    (
        BASE,
        BASE + RECORDS.replace("[60, 90]", "[59, 90]"),
        r"case\.toml: records\.test: expected measurements that are in no calibration record",
    ),
    (
        BASE,
        BASE + RECORDS.replace(", rows = [60, 90]", ""),
        r"case\.toml: records\.test: .* the same columns, u, v, w; .* rows = \[FIRST, END\]",
    ),
    (
        BASE,
        BASE + RECORDS.replace("[40, 60]", "[60, 40]"),
        r"records\.calibration\.rows: expected the f",
    ),
    (
        BASE,
        BASE + RECORDS.replace("0.45", "-1"),
        r"case\.toml: records\.calibration\.transient: expected",
    ),
    (
        BASE,
        BASE + "[training]\nmax_epochs = 2.5\n",
        r"case\.toml: training\.max_epochs: expected a valid",
    ),
    (
        BASE,
        BASE + "[parameters.mass]\nunit = 'kg'\nlow = 1\nhigh = 2\n",
        r"case\.toml: parameters: expected parameters that turned takes by name, got mass",
    ),
    (
        BASE,
        BASE + "[parameters.gain]\nunit = 'm'\nlow = 2\nhigh = 1\n",
        r"case\.toml: parameters\.gain: expected finite bounds",
    ),
    (
        BASE,
        BASE + "[parameters.gain]\nlow = 2\n",
        r"case\.toml: parameters\.gain\.unit: expected a",
    ),
    (
        BASE,
        BASE + "[faults]\nf = { kind = 'Stuck', actuator = 'c' }\n",
        r"case\.toml: faults\.f\.actuator: expected one of a, b, got 'c'",
    ),
    (
        BASE,
        BASE + "[causes]\nHealthy = { kind = 'SensorFreeze', output = 0 }\n",
        r"case\.toml: causes: expected names that no fault has, got Healthy",
    ),
    (
        BASE,
        BASE + "[faults]\nHealthy = { kind = 'SensorFreeze', output = 0 }\n",
        r"case\.toml: faults\.Healthy: expected no fault",
    ),
    ('name = "toy"', 'name = " "', r"case\.toml: name: expected a name for the case"),
    ('name = "toy"', 'name = "toy"\nfolder = "\\u0000"', r"case\.toml: folder.*zero character"),
    (
        BASE,
        BASE + "[faults]\nf = 'toy_module:split'\n",
        r"case\.toml: faults\.f: expected a Fault",
    ),
    (
        BASE,
        "commands = 'toy_module:split'\n" + BODY,
        r"case\.toml: commands: expected a CommandSampler, got 'toy_module:split', a function",
    ),
    (
        BASE,
        BODY + "[commands]\nkind = 'RecordedSampler'\nfile = 'gone.npz'\n",
        r"case\.toml: commands\.file\.path: expected an existing file",
    ),
    (
        BASE,
        BASE + "[records]\ncalibration = { a = 'a' }\n",
        r"case\.toml: records\.calibration: expected a column for each of a, b, y, got a",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG)
def test_a_refusal_names_file_and_key(
    read: Callable[..., rt.Case], old: str, new: str, message: str
) -> None:
    with pytest.raises(rt.InputError, match=message) as caught:
        read(BASE.replace(old, new))
    assert "\n" not in str(caught.value)
    assert "case.toml" in str(caught.value)


def test_more_channels_than_can_be_read_in_seconds_are_refused(
    read: Callable[..., rt.Case],
) -> None:
    many = "".join(f"u{i} = {{}}\n" for i in range(10_001))
    with pytest.raises(rt.InputError, match=r"inputs: expected at most 10000 channels, got 10003"):
        read(BASE.replace("[outputs]", many + "[outputs]"))


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(rt.InputError, match=r"gone\.toml: expected a case as a TOML file"):
        rt.cases.get(str(tmp_path / "gone.toml"))


class TestRecords:
    """One table of text: a record to calibrate on, one to test."""

    COLUMNS = """
[records]
calibration = { a = "a1", b = "b", y = "y1" }
test = { a = "a2", b = "b", y = "y2" }
"""

    def test_columns_become_records(self, read: Callable[..., rt.Case], tmp_path: Path) -> None:
        case = read(BASE + self.COLUMNS)
        lines = ["a1,b,y1,a2,y2,note"]
        lines += [f"0.{i},{i / 4},{i},0.{i}5,{i + 0.5},x" for i in range(4)] + ["0.4,1,,,9,"]
        (tmp_path / "data.csv").write_text("\ufeff" + "\n".join(lines) + "\n", "utf-8")
        first, second = case.records(tmp_path / "data.csv")
        np.testing.assert_allclose(first.commands[0, :, 0], [0.0, 0.1, 0.2, 0.3, 0.4])
        np.testing.assert_array_equal(first.mask[0, :, 0], [True] * 4 + [False])
        np.testing.assert_allclose(second.commands[0, :, 0], [0.05, 0.15, 0.25, 0.35])
        np.testing.assert_allclose(second.observed[0, :, 0], [0.5, 1.5, 2.5, 3.5])
        np.testing.assert_array_equal(
            second.nominal, case.twin.simulate(second.commands, seed=0).nominal
        )
        assert (first.ids[0], second.ids[0]) == ("calibration", "test")
        assert first.labels.tolist() == ["Healthy"]
        assert (first.rate, first.inputs, first.outputs) == (10.0, case.inputs, case.outputs)
        assert first.provenance[0].name == "data.csv"

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("a1,b,y1,a2\n0,0,0,0\n0,0,0,0\n", r"columns a1, b, y1.*got no column y2"),
            (
                "a1,b,y1,a2,y2\n0,0,x,0,0\n0,0,0,0,0\n",
                "numbers in columns .* got 'x' in data row 0 of y1",
            ),
            ("a1,b,y1,a2,y2\n0,0,0,0,0\n,0,0,0,0\n0,0,0,0,0\n", "2 of 3 rows of the calibration"),
            ("a1,b,y1,a2,y2\n0,0,0,0,0\n", "two rows at least"),
            ("a1,b,y1,a2,y2\n", "two rows at least, got 0 of 0 rows"),
        ],
    )
    def test_bad_tables_are_refused(
        self, read: Callable[..., rt.Case], tmp_path: Path, text: str, message: str
    ) -> None:
        case = read(BASE + self.COLUMNS)
        (tmp_path / "data.csv").write_text(text)
        with pytest.raises(rt.InputError, match=message):
            case.records(tmp_path / "data.csv")


@pytest.mark.parametrize("text", ["a" + ".a" * 20_000 + " = 1", "a = " + "[" * 20_000, "a = {b.c"])
def test_a_case_that_is_nested_too_deeply_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "case.toml").write_text(text)
    with pytest.raises(rt.InputError, match=r"case\.toml: expected a case as a TOML file"):
        rt.cases.get(str(tmp_path / "case.toml"))


def test_a_pipe_is_no_case(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "case.toml")
    with pytest.raises(rt.InputError, match="no regular file"):
        rt.cases.get(str(tmp_path / "case.toml"))
