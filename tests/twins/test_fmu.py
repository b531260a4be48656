"""FMUs: the right numbers at the right times, and no harm from those that hang or crash."""

from __future__ import annotations

import os
import pickle
import platform
import signal
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest
from fmus import c_fmu, changed, described, python_fmu

import retwin as rt
from retwin.twins.fmu.twin import FMUTwin
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin
from retwin.twins.wrappers.randomised import RandomisedTwin

TAU = 0.1
RATE = 100.0


@pytest.fixture(scope="module")
def lag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return c_fmu(tmp_path_factory.mktemp("lag"))


@pytest.fixture(scope="module")
def pylag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return python_fmu(tmp_path_factory.mktemp("pylag"))


def lagged(inputs: np.ndarray, seconds: float, gain: float = 1.0) -> np.ndarray:
    """The exact response (K,) of the lag to inputs (K,) held for `seconds` each."""
    out = np.zeros(len(inputs))
    decay = np.exp(-seconds / TAU)
    for k in range(1, len(inputs)):
        target = gain * inputs[k - 1]
        out[k] = target + (out[k - 1] - target) * decay
    return out


@pytest.mark.parametrize("fmu", ["lag", "pylag"])
def test_step_response_is_exact(fmu: str, request: pytest.FixtureRequest) -> None:
    twin = FMUTwin.from_file(request.getfixturevalue(fmu), RATE, ["u"], ["x"], workers=1)
    assert isinstance(twin, rt.Twin)
    made = twin.simulate(np.full((3, 80, 1), 2.0), seed=0)
    truth = 2.0 * (1.0 - np.exp(-np.arange(80) / RATE / TAU))
    for observed in made.observed[:, :, 0]:
        np.testing.assert_allclose(observed, truth, atol=1e-12)
    assert made.nominal.tobytes() == made.observed.tobytes()


def test_continuous_inputs_are_linear_within_a_sample(lag: Path) -> None:
    rng = np.random.default_rng(0)
    commands = rng.uniform(-5, 5, size=(2, 30, 1))
    twin = FMUTwin.from_file(lag, RATE, ["u"], ["x"], step=1 / (4 * RATE), workers=1)
    made = twin.simulate(commands, seed=0)
    fine = np.interp(np.arange(29 * 4 + 1) / 4, np.arange(30), commands[1, :, 0])
    truth = lagged(fine, 1 / (4 * RATE))[::4]
    np.testing.assert_allclose(made.observed[1, :, 0], truth, atol=1e-12)


def test_an_input_may_have_a_rate_of_its_own(lag: Path) -> None:
    commands = np.zeros((1, 40, 2))
    commands[0, :, 0] = np.linspace(0, 8, 40)
    commands[0, :, 1] = np.linspace(10, 49, 40)
    rates = {"u": 20.0, "trouble": 100 / 3}
    twin = FMUTwin.from_file(lag, RATE, ["u", "trouble"], ["x", "seen"], rates=rates, workers=1)
    made = twin.simulate(commands, seed=0)
    held = commands[0, np.arange(40) // 5 * 5, 0]
    np.testing.assert_allclose(made.observed[0, :, 0], lagged(held, 1 / RATE), atol=1e-12)
    thirds = np.floor(np.arange(39) / 3 + 1e-9) * 3
    np.testing.assert_array_equal(made.observed[0, 1:, 1], 10 + thirds)


def test_whole_numbers_are_rounded_and_held(lag: Path, pylag: Path) -> None:
    commands = np.array([[10.4, 10.6, 11.0, 40.0], [0.2, 0.9, 0.4, 1.0]]).T[None]
    twin = FMUTwin.from_file(lag, RATE, ["trouble", "on"], ["seen"], step=0.005, workers=1)
    assert twin.simulate(commands, seed=0).observed[0, :, 0].tolist() == [0, 10, 11, 11]
    twin = FMUTwin.from_file(pylag, RATE, ["level", "on", "u"], ["sum", "x"], workers=1)
    drive = np.concatenate([commands, np.full((1, 4, 1), 3.0)], axis=2)
    made = twin.simulate(drive, seed=0)
    assert made.observed[0, :, 0].tolist() == [0, 10, 21, 32]
    truth = lagged(np.array([0.0, 3.0, 0.0, 3.0]), 1 / RATE)
    np.testing.assert_allclose(made.observed[0, :, 1], truth, atol=1e-12)


def test_names_units_and_limits_come_from_the_fmu(lag: Path) -> None:
    twin = FMUTwin.from_file(lag)
    # An input whose range is one value is a constant and no command.
    names = ("u", "trouble", "on", "pair[0]", "pair[1]", "mode")
    assert twin.inputs == rt.Channels(names, ("V", "1", "1", "1", "1", "1"))
    assert twin.outputs == rt.Channels(("x", "seen"), ("m", "1"))
    free = (np.inf, np.inf)
    assert twin.limits == rt.Limits(
        (-10.0, -np.inf, 0.0, -np.inf, -np.inf, 1.0), (10.0, np.inf, 1.0, *free, 4.0)
    )
    assert FMUTwin.from_file(lag, inputs=["trouble"]).limits is None
    loud = np.full((1, 20, 1), 12.0)
    with pytest.raises(rt.InputError, match="expected u from -10 to 10 V, got 12"):
        FMUTwin.from_file(lag, inputs=["u"]).simulate(loud, seed=0)
    clipping = FMUTwin.from_file(lag, RATE, ["u"], ["x"], outside="clip", workers=1)
    made = clipping.simulate(loud, seed=0)
    assert made.commands.max() == 10.0
    np.testing.assert_allclose(
        made.observed[0, :, 0], lagged(np.full(20, 10.0), 1 / RATE), atol=1e-12
    )


@pytest.mark.parametrize("fmu", ["lag", "pylag"])
def test_start_values_may_differ_between_runs(fmu: str, request: pytest.FixtureRequest) -> None:
    path = request.getfixturevalue(fmu)
    twin = FMUTwin.from_file(path, RATE, ["u"], ["x"], start={"gain": 7.0}, workers=1)
    commands = np.ones((4, 20, 1))
    unit = lagged(np.ones(20), 1 / RATE)
    for gains, given in [([7.0] * 4, None), ([3.0] * 4, 3.0), ([1, 2, 4, 8], [1, 2, 4, 8])]:
        parameters = None if given is None else {"gain": given}
        made = twin.simulate(commands, seed=0, parameters=parameters)
        np.testing.assert_allclose(made.observed[:, :, 0], np.outer(gains, unit), atol=1e-12)


def test_an_fmu_may_have_no_inputs(lag: Path) -> None:
    alone = described(lag, "alone", 'causality="input"', 'causality="local"')
    twin = FMUTwin.from_file(alone, RATE, outputs=["sums"], workers=1)
    assert twin.outputs.names == ("sums[0]", "sums[1]")
    made = twin.simulate(np.zeros((2, 10, 0)), seed=0, parameters={"gain": [1, 2]})
    assert made.observed[:, -1].tolist() == [[0, 45], [0, 90]]


def test_arrays_are_channels_and_constants_may_be_named(lag: Path) -> None:
    """The element of an array that is no channel keeps its start value."""
    commands = np.arange(1.0, 21.0).reshape(1, 10, 2)
    commands[:, :, 1] = 3.0
    twin = FMUTwin.from_file(lag, RATE, ["pair[0]", "fixed"], ["sums[1]", "sums[0]"], workers=1)
    made = twin.simulate(commands, seed=0)
    assert made.observed[0, -1].tolist() == [9 * 5, 3 * commands[0, :-1, 0].sum()]
    both = FMUTwin.from_file(lag, RATE, ["pair", "mode"], ["sums", "x"], workers=1)
    assert both.inputs.names == ("pair[0]", "pair[1]", "mode")
    assert both.outputs.names == ("sums[0]", "sums[1]", "x")
    drive = np.tile([2.0, 3.0, 3.6], (1, 10, 1))
    assert both.simulate(drive, seed=0).observed[0, -1].tolist() == [9 * 2 * 3, 9 * 3 * 4, 0]
    with pytest.raises(rt.InputError, match="expected mode from 1 to 4 1, got 5"):
        both.simulate(drive * 1.4, seed=0)
    with pytest.raises(rt.InputError, match="expected fixed from 3 to 3"):
        twin.simulate(commands + 1, seed=0)


def test_an_array_without_bound_is_refused(lag: Path) -> None:
    bomb = described(
        lag, "bomb", '<Dimension start="2"/></Float64>', '<Dimension start="9999999"/></Float64>'
    )
    with pytest.raises(rt.InputError, match="outputs: expected arrays of at most 1000000 numbers"):
        FMUTwin.from_file(bomb, outputs=["sums"])


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the FMU counts its instances (i) and runs (r)."""
    monkeypatch.setenv("LAG_LOG", str(tmp_path / "log"))
    return tmp_path / "log"


def test_faults_hold_the_command(lag: Path, log: Path) -> None:
    ramp = np.linspace(0, 6, 60)
    commands = np.tile(ramp[:, None], (3, 1, 1))
    twin = FMUTwin.from_file(lag, RATE, ["u"], ["x"], workers=1)
    made = twin.simulate(commands, faults=[None, rt.Stuck(0, onset=0.2), None], seed=0)
    assert made.labels.tolist() == ["Healthy", "Stuck", "Healthy"]
    stuck = np.minimum(ramp, ramp[20])
    np.testing.assert_allclose(made.observed[1, :, 0], lagged(stuck, 1 / RATE), atol=1e-12)
    for nominal in made.nominal[:, :, 0]:
        np.testing.assert_allclose(nominal, lagged(ramp, 1 / RATE), atol=1e-12)
    # Healthy trajectories are not run twice; two runs more check that the reset is complete.
    assert log.read_text("utf-8") == "i" + 6 * "r"


def test_nominal_may_be_given(lag: Path) -> None:
    commands = np.ones((2, 10, 1))
    twin = FMUTwin.from_file(lag, RATE, ["u"], ["x"], nominal=lambda u: 3 * u, workers=1)
    faults = [None, rt.Stuck(0, onset=0)]
    assert (
        twin.simulate(commands, faults=faults, seed=0).nominal.tolist() == (3 * commands).tolist()
    )
    wrong = FMUTwin.from_file(lag, RATE, ["u"], ["x"], nominal=lambda u: u[0], workers=1)
    with pytest.raises(
        rt.InputError, match=r"nominal: expected .* \(2, 10, 1\), got float64, \(10, 1\)"
    ):
        wrong.simulate(commands, seed=0)


TROUBLES = {
    1: "hung for more than 1.5 s",
    2: "its process died (signal 11)",
    3: "FMI status error in fmi3DoStep (trouble was requested)",
    4: "x is nan from 0.06 s on",
    5: "FMI status fatal in fmi3DoStep",
    6: "its process ended (exit code 3)",
    111: "its process ended (exit code 75)",
    112: "its process ended (exit code 0)",
    113: "FMI status -1 in fmi3DoStep",
    115: "it wrote to the connection of its process",
    116: "it closed the connection of its process",
    117: "it wrote to the connection of its process",
    119: "x is 9.05e+307 from 0.06 s on",
}


@pytest.mark.slow
@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_run_that_fails_ends_alone(lag: Path, workers: int) -> None:
    twin = FMUTwin.from_file(lag, RATE, ["u", "trouble"], ["x"], timeout=1.5, workers=workers)
    kinds = list(TROUBLES)
    commands = np.zeros((2 * len(kinds), 20, 2))
    commands[:, :, 0] = np.arange(len(commands))[:, None] / 4
    commands[1::2, 5:, 1] = np.array(kinds)[:, None]
    reported: list[float] = []
    with pytest.raises(rt.SimulationError, match=r"13 of 26 .* trajectory 1: hung") as caught:
        twin.simulate(commands, seed=0, progress=reported.append)
    assert caught.value.failed == {2 * i + 1: TROUBLES[kind] for i, kind in enumerate(kinds)}
    finished = caught.value.finished
    assert finished.ids.tolist() == [f"{i:05d}" for i in range(0, 26, 2)]
    for made, which in zip(finished.observed, finished.ids, strict=True):
        truth = lagged(np.full(20, int(which) / 4), 1 / RATE)
        np.testing.assert_allclose(made[:, 0], truth, atol=1e-12)
    assert reported == sorted(reported)
    assert reported[-1] == 1.0


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="forks")
def test_an_fmu_that_forks_leaves_no_processes(
    lag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LAG_FORKS", str(tmp_path / "forks"))
    twin = FMUTwin.from_file(lag, RATE, ["u", "trouble"], ["x"], timeout=20, workers=1)
    commands = np.zeros((2, 4, 2))
    commands[0, 1, 1] = 118
    commands[1, 1, 1] = 2  # this one dies besides, so that only its group is left
    with pytest.raises(rt.SimulationError, match="1 of 2"):
        twin.simulate(commands, seed=0)
    children = [int(each) for each in (tmp_path / "forks").read_text().split()]
    assert len(children) >= 4

    def ended(process: int) -> bool:
        try:
            return bool(psutil.Process(process).status() == psutil.STATUS_ZOMBIE)
        except psutil.NoSuchProcess:
            return True

    until(lambda: all(map(ended, children)))


def test_the_failure_of_a_healthy_run_is_named_as_such(lag: Path) -> None:
    commands = np.zeros((1, 20, 2))
    commands[0, :, 0] = 1.0
    commands[0, 10:, 1] = 3
    twin = FMUTwin.from_file(lag, RATE, ["u", "trouble"], ["x"], workers=1)
    with pytest.raises(rt.SimulationError, match="trajectory 0: without its fault: FMI status"):
        twin.simulate(commands, faults=[rt.Stuck(1, onset=0.05)], seed=0)


@pytest.mark.parametrize(("reset", "reuse"), [(1, True), (2, False)], ids=["refused", "idle"])
def test_an_fmu_without_a_reset_is_instantiated_anew(
    tmp_path: Path, log: Path, reset: int, reuse: bool
) -> None:
    """More often than one process may."""
    twin = FMUTwin.from_file(c_fmu(tmp_path, reset=reset), RATE, ["u"], ["x"], reuse=reuse)
    made = twin.simulate(np.ones((600, 4, 1)), seed=0)
    assert np.ptp(made.observed, axis=0).max() == 0
    np.testing.assert_allclose(made.observed[-1, :, 0], lagged(np.ones(4), 1 / RATE), atol=1e-12)
    kinds = log.read_text("utf-8")
    assert kinds.count("i") == kinds.count("r") > 600


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reset", "warning"),
    [(2, "every run has a new instance"), (3, "every run has a process of its own"), (4, "")],
    ids=["instance forgets", "library remembers", "crashes"],
)
def test_an_incomplete_reset_is_found(tmp_path: Path, reset: int, warning: str) -> None:
    """Also where the first trajectories end as they begin; whatever the number of processes."""
    commands = np.repeat([0.0, 0.0, 1.0, 1.0, 1.0, 2.0], 20).reshape(6, 20, 1)
    path = c_fmu(tmp_path, reset=reset)
    for workers in (1, 2):
        twin = FMUTwin.from_file(path, RATE, ["u"], ["x"], workers=workers)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            made = twin.simulate(commands, seed=0)
        assert {str(each.message).count(warning) for each in caught} <= {1}
        assert len(caught) == 1 if warning and workers == 1 else len(caught) <= 1
        for drive, out in zip(commands[:, :, 0], made.observed[:, :, 0], strict=True):
            np.testing.assert_allclose(out, lagged(drive, 1 / RATE), atol=1e-12)


def test_a_run_does_not_change_the_arithmetic_of_the_next(lag: Path) -> None:
    """Trouble 114 rounds upwards and flushes tiny numbers to zero."""
    commands = np.zeros((3, 20, 2))
    commands[:, :, 0] = [[0.1], [0.3], [1e-307]]
    quiet = FMUTwin.from_file(lag, RATE, ["u", "trouble"], ["x"], workers=1)
    truth = quiet.simulate(commands[1:], seed=0).observed
    commands[0, :, 1] = 114
    made = quiet.simulate(commands, seed=0).observed[1:]
    assert made.tobytes() == truth.tobytes()
    assert 0 < made[1, 1, 0] < np.finfo(float).tiny * 10


def test_an_fmu_that_ends_early_gives_what_it_has(lag: Path) -> None:
    commands = np.ones((3, 20, 2))
    commands[:, :, 1] = 0
    commands[1, 5:, 1] = 7
    twin = FMUTwin.from_file(lag, RATE, ["u", "trouble"], ["x"], step=1 / (2 * RATE), workers=1)
    with pytest.warns(
        UserWarning, match=r"ended 1 simulations .*trajectory 1 at 0.055 s"
    ) as caught:
        made = twin.simulate(commands, seed=0)
    assert len(caught) == 1
    assert made.mask[[0, 2]].all()
    assert made.mask[1, :, 0].tolist() == [True] * 6 + [False] * 14
    np.testing.assert_allclose(made.observed[1, :6, 0], made.observed[0, :6, 0], atol=1e-12)
    gain = Parameter("gain", "1", 1.0, 1.0 + 1e-9)
    with pytest.warns(UserWarning, match="ended 1 simulations"):
        drawn = RandomisedTwin(ParametricTwin(twin, (gain,))).simulate(commands, seed=0)
    np.testing.assert_array_equal(drawn.mask, made.mask)


def test_same_bytes_whatever_the_workers(lag: Path) -> None:
    commands = np.random.default_rng(1).uniform(-3, 3, size=(300, 10, 1))
    faults = [rt.Stuck(0, onset=(0.02, 0.08)) if i % 3 else None for i in range(300)]
    made = []
    for workers in (1, 2):
        twin = FMUTwin.from_file(lag, RATE, ["u"], ["x"], workers=workers)
        made.append(twin.simulate(commands, faults=faults, seed=4))
    assert made[0].observed.tobytes() == made[1].observed.tobytes()
    assert made[0].nominal.tobytes() == made[1].nominal.tobytes()


def test_progress_is_reported_per_trajectory(lag: Path) -> None:
    twin = FMUTwin.from_file(lag, RATE, ["u"], ["x"], workers=1)
    reported: list[float] = []
    twin.simulate(np.ones((20, 4, 1)), seed=0, progress=reported.append)
    np.testing.assert_allclose(reported, np.arange(1, 21) / 20)


def test_native_code_stays_out_of_this_process_and_off_the_disk(
    lag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = set(psutil.Process().children())
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    commands = np.zeros((2, 10, 2))
    twin = pickle.loads(pickle.dumps(FMUTwin.from_file(lag, RATE, ["u", "trouble"], ["x"])))
    seen: list[int] = []
    with pytest.raises(rt.SimulationError):
        commands[1, :, 1] = 2
        twin.simulate(
            commands, seed=0, progress=lambda _: seen.append(len(list(tmp_path.iterdir())))
        )
    assert seen == [1, 1]
    assert not list(tmp_path.iterdir())
    assert set(psutil.Process().children()) <= others
    if sys.platform == "linux":
        assert "Lag.so" not in Path("/proc/self/maps").read_text("utf-8")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.0}, "rate: expected a positive number of Hz, got 0.0"),
        ({"timeout": -1.0}, "timeout: expected a positive number of s"),
        ({"step": 0.003}, "step: expected a step that divides the sample period, 0.01 s"),
        ({"step": 0.02}, "step: expected a step that divides .*give for instance step=0.01"),
        ({"step": float("nan")}, "step: expected a positive number of s"),
        ({"rates": {"u": 200.0}}, "rates: expected .* up to 100 Hz, got 'u' with 200 Hz"),
        ({"rates": {"w": 2.0}}, "rates: .* 'w' .*the inputs are u, trouble, on"),
        ({"inputs": ["truble"]}, "inputs: .* 'truble', which the FMU does not have; did you mean "),
        ({"inputs": ["gain"]}, "inputs: .* 'gain', whose causality is parameter, type Float64; "),
        ({"inputs": ["pair[2]"]}, r"inputs: .* 'pair\[2\]', which the FMU does not have"),
        ({"outputs": ["u"]}, "outputs: .* whose causality is input, .*there are: x, seen, sums"),
        ({"start": {"gian": 1.0}}, "start: .* 'gian'; did you mean gain"),
        ({"start": {"u": 1.0}}, "start: expected scalar variables .* no commands, got 'u'"),
        ({"start": {"x": 1.0}}, "start: .* got 'x'"),
        ({"start": {"gain": "high"}}, r"start: expected for gain \(Float64\) .* got 'high'"),
        ({"start": {"gain": float("inf")}}, "start: .* got inf"),
        ({"inputs": ["u"], "start": {"trouble": 0.5}}, r"start: .* trouble \(Int32\) .*got 0.5"),
        ({"outside": "ignore"}, "outside: expected one of refuse, clip, got 'ignore'"),
    ],
)
def test_bad_options_are_refused(lag: Path, options: dict, message: str) -> None:
    with pytest.raises(rt.InputError, match=message):
        FMUTwin.from_file(lag, **options)


def test_bad_parameters_are_refused(lag: Path) -> None:
    twin = FMUTwin.from_file(lag, inputs=["u"])
    for parameters, message in [
        ({"gain": [1.0, 2.0]}, r"one per trajectory, 3, got float64 of shape \(2,\)"),
        ({"gain": [1.0, np.nan, 2.0]}, "give finite numbers"),
        ({"gains": 1.0}, "did you mean gain"),
    ]:
        with pytest.raises(rt.InputError, match=message):
            twin.simulate(np.zeros((3, 10, 1)), seed=0, parameters=parameters)
    with pytest.raises(rt.InputError, match="commands: "):
        twin.simulate(np.zeros((3, 10, 2)), seed=0)


def test_files_that_cannot_run_are_refused(lag: Path, tmp_path: Path) -> None:
    (tmp_path / "text.fmu").write_text("no zip", encoding="utf-8")
    (tmp_path / "none.fmu").write_bytes(b"PK\x05\x06" + bytes(18))
    exchange = described(lag, "exchange", "<CoSimulation", "<ModelExchange")
    elsewhere = changed(lag, "elsewhere", lambda n, c: (n.replace("x86_64", "riscv64"), c))
    hollow = changed(lag, "hollow", lambda n, c: (n.replace("Lag.so", "readme.txt"), c))
    cases = {
        hollow: r"Lag.so, got hollow.fmu, whose binaries/\S+ does not have it",
        tmp_path / "missing.fmu": "which is not there",
        tmp_path / "text.fmu": "which is no zip file",
        tmp_path / "none.fmu": "no item named 'modelDescription.xml'",
        described(lag, "broken", "<ModelVariables>", "<Model"): "readable modelDescription.xml",
        described(lag, "future", 'fmiVersion="3.0"', 'fmiVersion="9.0"'): "Unsupported FMI version",
        exchange: "for co-simulation, FMI 2.0 or 3.0, got exchange.fmu, FMI 3.0 for model exchange",
        changed(lag, "bare", lambda n, c: None if "bin" in n else (n, c)): "which has none",
        elsewhere: "which has riscv64-",
        described(lag, "mute", 'causality="output"', 'causality="local"'): "name local variables",
    }
    for path, message in cases.items():
        with pytest.raises(rt.InputError, match=message) as caught:
            FMUTwin.from_file(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("load", "why"), [(1, "Failed to instantiate"), (2, "signal 11")])
def test_an_fmu_that_does_not_load_is_refused_once(tmp_path: Path, load: int, why: str) -> None:
    twin = FMUTwin.from_file(c_fmu(tmp_path, load=load), RATE, ["u"], ["x"], workers=1)
    with pytest.raises(rt.InputError, match=f"an FMU that loads on this machine, got .*{why}"):
        twin.simulate(np.zeros((3, 10, 1)), seed=0)


def test_a_script_needs_no_guard(lag: Path, tmp_path: Path) -> None:
    text = SCRIPT.split("if __name__")[0] + (
        f"twin = FMUTwin.from_file({str(lag)!r}, 100.0, ['u'], ['x'], workers=1)\n"
        "twin.simulate(np.zeros((1, 10, 1)), seed=0)\n"
    )
    (tmp_path / "main.py").write_text(text)
    subprocess.run([sys.executable, tmp_path / "main.py"], check=True, timeout=120)


def test_members_stay_in_the_folder(
    lag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))

    def simulate(name: str, member: str) -> None:
        path = changed(lag, name, lambda n, c: (n, c))
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(member, "evil")
        twin = FMUTwin.from_file(path, RATE, ["u"], ["x"], workers=1)
        twin.simulate(np.zeros((1, 10, 1)), seed=0)

    simulate("climbing", "../../evil.txt")
    with pytest.raises(rt.InputError, match="an FMU that can be unpacked"):
        simulate("absolute", str(tmp_path / "evil.txt"))
    assert not list(tmp_path.rglob("evil.txt"))


SCRIPT = """
import numpy as np
from retwin.deploy.simulations import SimulationPlan, simulate_to
from retwin.twins.fmu.twin import FMUTwin

if __name__ == "__main__":
    twin = FMUTwin.from_file({path!r}, 100.0, ["u", "trouble"], ["x"])
    commands = np.zeros((4, 10, 2))
    commands[:, 3:, 1] = 1  # it hangs
    plan = SimulationPlan(twin, commands, 0, chunk=2)
    simulate_to({target!r}, plan, workers={workers})
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="ends processes by signals")
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_when_the_program_is_killed(
    lag: Path, tmp_path: Path, workers: int, number: int
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    script = SCRIPT.format(path=str(lag), target=str(tmp_path / "a.zarr"), workers=workers)
    (tmp_path / "main.py").write_text(script)
    process = subprocess.Popen(
        [sys.executable, tmp_path / "main.py"], env={**os.environ, "TMPDIR": str(scratch)}
    )
    until(lambda: len(list(scratch.glob("retwin-*/binaries/*/*"))) == workers)
    time.sleep(1.0)
    process.send_signal(number)
    process.wait()
    until(lambda: not list(scratch.glob("retwin-*")))


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.skipif(os.name != "posix", reason="asks for processes by signal 0")
def test_what_killed_processes_left_is_removed(
    lag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    here = f"retwin-{platform.node()}"
    names = [f"{here}-{gone.pid}-a", f"{here}-{os.getpid()}-b", f"{here}-1-c"]
    names += [f"retwin-elsewhere-{gone.pid}-d", f"{here}-mine-e", "retwin-report"]
    for name in names:
        (tmp_path / name / "inside").mkdir(parents=True)
    twin = FMUTwin.from_file(lag, RATE, ["u"], ["x"], workers=1)
    twin.simulate(np.zeros((1, 5, 1)), seed=0)
    assert {file.name for file in tmp_path.iterdir()} == set(names[1:])


def test_without_fmpy_it_says_how_to_get_it(lag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(rt.InputError, match=r'pip install .*\[fmu\]"'):
        FMUTwin.from_file(lag)


@pytest.mark.slow
def test_ten_thousand_runs_do_not_grow_the_worker(lag: Path, log: Path) -> None:
    if sys.platform != "linux":
        pytest.skip("reads /proc")
    twin = FMUTwin.from_file(lag, RATE, ["u"], ["x"], workers=1)
    memory: list[float] = []
    others = set(psutil.Process().children())

    def measure(share: float) -> None:
        for child in set(psutil.Process().children()) - others:
            pages = int(Path(f"/proc/{child.pid}/statm").read_text("utf-8").split()[1])
            memory.append(pages * 4096 / 2**20)

    twin.simulate(np.ones((10_000, 20, 1)), seed=0, progress=measure)
    assert log.read_text("utf-8").count("i") == 1  # one instance, one process
    assert len(memory) == 10_000
    assert max(memory[1000:]) - memory[1000] < 3.0
