from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.twins.faults.applied_faults import faulty_commands, frozen_response
from retwin.twins.function import FunctionTwin

INPUTS = rt.Channels(("valve", "heater"), ("1", "W"))
OUTPUTS = rt.Channels(("level",), ("m",))


def level(commands: np.ndarray) -> np.ndarray:
    """A first-order lag of the valve, warmed by the heater; any leading shape."""
    steps = np.arange(1, commands.shape[-2] + 1)[:, None]
    return np.cumsum(commands[..., :1], axis=-2) / steps + 0.01 * commands[..., 1:]


def noisy(commands: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return level(commands) + rng.normal(0, 0.1, (*commands.shape[:-1], 1))


def raises(commands: np.ndarray) -> np.ndarray:
    raise KeyError("no such valve")


class Particular(Exception):
    """It cannot be rebuilt from its message alone."""

    def __init__(self, valve: int, reason: str) -> None:
        super().__init__(f"valve {valve} {reason}")


def raises_particular(commands: np.ndarray) -> np.ndarray:
    raise Particular(3, "leaks")


def dies(commands: np.ndarray) -> np.ndarray:
    """Ends its process for the second and the fourth trajectory of `trajectories`."""
    if commands[0, 0] in (1.0, 3.0):
        os._exit(7)
    return level(commands)


def process_id(commands: np.ndarray) -> np.ndarray:
    time.sleep(0.1)
    return np.full((len(commands), 1), float(os.getpid()))


def gone(commands: np.ndarray) -> np.ndarray:
    return level(commands)


def twin(function=level, **settings) -> FunctionTwin:
    return FunctionTwin(function, INPUTS, OUTPUTS, 10.0, **settings)


def trajectories(count: int = 5, steps: int = 40) -> np.ndarray:
    """Commands whose first value is the trajectory's number."""
    commands = np.zeros((count, steps, 2))
    commands += np.arange(count)[:, None, None]
    commands[:, 10:] += np.clip(np.arange(steps - 10), 0, 10)[:, None]
    return commands


def test_says_what_the_function_says() -> None:
    commands = trajectories()
    faults = [None, rt.Stuck(0, onset=1.2), None, None, rt.ActuatorBias(1, bias=(4.0,))]
    effective = faulty_commands(commands, faults, rt.Segments.from_commands(commands), rate=10.0)
    held = frozen_response(effective, faults, rate=10.0)
    for each in (twin(), twin(vectorised=False)):
        made = each.simulate(commands, faults=faults, seed=0)
        np.testing.assert_array_equal(made.nominal, level(commands))
        np.testing.assert_array_equal(made.observed, level(held))
        moved = made.residual.any(axis=(1, 2))
        assert moved.tolist() == [False, True, False, False, True]


def test_nothing_is_computed_twice() -> None:
    calls: list[int] = []

    def counted(commands: np.ndarray) -> np.ndarray:
        calls.append(len(commands))
        return level(commands)

    faults = [None, rt.Stuck(0, onset=1.2), None, rt.Stuck(1, onset=3.9), None]
    twin(counted).simulate(trajectories(), faults=faults, seed=0)
    assert calls == [5, 1], "the fault after the last sample changes nothing"
    calls.clear()
    twin(counted, nominal=level).simulate(trajectories(), faults=faults, seed=0)
    assert calls == [5]


def test_nominal_is_what_nominal_says() -> None:
    made = twin(level, nominal=lambda commands: 0 * level(commands)).simulate(
        trajectories(), seed=0
    )
    assert not made.nominal.any()
    np.testing.assert_array_equal(made.observed, level(trajectories()))


def test_whole_numbers_are_outputs_too() -> None:
    counted = twin(level, nominal=lambda commands: level(commands).astype(int))
    made = counted.simulate(trajectories(), seed=0)
    np.testing.assert_array_equal(made.nominal, level(trajectories()).astype(int))
    np.testing.assert_array_equal(made.observed, level(trajectories()))


@pytest.mark.parametrize("settings", [{}, {"vectorised": False}])
def test_noise_is_in_the_residual(settings: dict) -> None:
    made = twin(noisy, nominal=level, **settings).simulate(trajectories(200), seed=3)
    np.testing.assert_array_equal(made.nominal, level(trajectories(200)))
    assert abs(made.residual.std() - 0.1) < 0.005
    # No two trajectories share their noise, within a chunk or across chunks.
    alike = np.corrcoef(made.residual[..., 0])[np.triu_indices(200, 1)]
    assert alike.max() < 0.9
    other = twin(noisy, nominal=level, **settings).simulate(trajectories(200), seed=4)
    assert abs(np.corrcoef(made.residual.ravel(), other.residual.ravel())[0, 1]) < 0.05


def test_same_bytes_whatever_the_workers() -> None:
    commands = trajectories(128 + 3)
    faults = [
        rt.Stuck(0, onset=(0.5, 2.0)),
        None,
        rt.ActuatorBias(1, (10.0, 50.0)),
    ] * 128
    made = [
        twin(noisy, nominal=level, vectorised=False, workers=workers).simulate(
            commands, faults=faults[: len(commands)], seed=8
        )
        for workers in (1, 2, 3)
    ]
    for other in made[1:]:
        assert other.observed.tobytes() == made[0].observed.tobytes()
    # One by one, a trajectory's noise depends on its index alone.
    first = twin(noisy, nominal=level, vectorised=False).simulate(commands[:2], seed=8)
    few = twin(noisy, nominal=level, vectorised=False).simulate(commands, seed=8)
    np.testing.assert_array_equal(first.observed, few.observed[:2])


def test_workers_are_other_processes_and_tell_how_far_they_are() -> None:
    reported: list[float] = []
    made = twin(process_id, vectorised=False, workers=2).simulate(
        trajectories(16), seed=0, progress=reported.append
    )
    seen = set(made.observed.ravel().tolist())
    assert len(seen) == 2
    assert os.getpid() not in seen
    assert len(reported) >= 16
    assert reported == sorted(reported)
    assert reported[-1] == 1.0


def test_a_process_that_dies_ends_its_trajectory_only() -> None:
    with pytest.raises(
        rt.SimulationError, match=r"trajectory 1: .*dies died, exit code 7"
    ) as caught:
        twin(dies, vectorised=False, workers=2).simulate(trajectories(), seed=0)
    assert sorted(caught.value.failed) == [1, 3]
    np.testing.assert_array_equal(caught.value.finished.nominal, level(trajectories()[[0, 2, 4]]))


@pytest.mark.parametrize(
    "settings", [{}, {"vectorised": False}, {"vectorised": False, "workers": 2}]
)
def test_exceptions_come_through_as_they_are(settings: dict) -> None:
    with pytest.raises(KeyError, match="no such valve") as caught:
        twin(raises, **settings).simulate(trajectories(), seed=0)
    where = f"{caught.value.__cause__}" if "workers" in settings else str(caught.traceback[-1])
    assert "test_function.py" in where
    assert "raises" in where


def test_an_exception_that_cannot_be_sent_is_replaced() -> None:
    with pytest.raises(RuntimeError, match="Particular: valve 3 leaks"):
        twin(raises_particular, vectorised=False, workers=2).simulate(trajectories(), seed=0)
    with pytest.raises(Particular):
        twin(raises_particular).simulate(trajectories(), seed=0)


def wrong_width(commands: np.ndarray) -> np.ndarray:
    return commands


def one_less(commands: np.ndarray) -> np.ndarray:
    return level(commands)[..., 1:, :]


def texts(commands: np.ndarray) -> np.ndarray:
    return level(commands).astype(str)


def ragged(commands: np.ndarray) -> list:
    return [[1.0], [1.0, 2.0]]


def nothing(commands: np.ndarray) -> None:
    return None


def complex_numbers(commands: np.ndarray) -> np.ndarray:
    return level(commands) + 1j


def blows_up(commands: np.ndarray) -> np.ndarray:
    out = level(commands)
    out[..., 7, 0] = np.where(commands[..., 0, 0] == 3.0, np.inf, out[..., 7, 0])
    return out


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            wrong_width,
            r"wrong_width to return numbers of shape .*40, 1\), got .*40, 2\); .* level;",
        ),
        (one_less, r"one_less .*, got ndarray, float64 of shape .*39, 1\)"),
        (texts, r"texts .*, got ndarray, <U"),
        (ragged, "ragged .*, got list, .*inhomogeneous"),
        (nothing, "nothing .*, got NoneType, object"),
        (complex_numbers, "complex_numbers .*, got ndarray, complex128"),
        (
            blows_up,
            "blows_up to return finite numbers, got inf for level in trajectory 3, sample 7",
        ),
    ],
)
def test_wrong_outputs_are_named_in_one_line(function, message: str) -> None:
    ways: list[dict] = [{}, {"vectorised": False}, {"vectorised": False, "workers": 2}]
    for settings in ways[: 3 if function is blows_up else 2]:
        with pytest.raises(rt.InputError, match=f"^function: expected {message}") as caught:
            twin(function, **settings).simulate(trajectories(), seed=0)
        assert "\n" not in str(caught.value)
    with pytest.raises(rt.InputError, match=f"^nominal: expected {message}"):
        twin(level, nominal=function).simulate(trajectories(), seed=0)


def test_what_looks_like_the_other_kind_is_advised() -> None:
    with pytest.raises(rt.InputError, match="vectorised=False if it takes one trajectory"):
        twin(lambda commands: level(commands)[0]).simulate(trajectories(), seed=0)
    with pytest.raises(rt.InputError, match="vectorised=True if it takes many"):
        twin(lambda one: level(one)[None], vectorised=False).simulate(trajectories(), seed=0)


def test_a_function_may_change_or_keep_what_it_gets_and_gives() -> None:
    reused = np.empty((5, 40, 1))

    def rough(commands: np.ndarray) -> np.ndarray:
        reused[: len(commands)] = level(commands)
        commands[:] = -1
        return reused[: len(commands)]

    commands = trajectories()
    faults = [rt.Stuck(0, onset=1.2)] * 5
    made = twin(rough).simulate(commands, faults=faults, seed=0)
    wanted = twin().simulate(commands, faults=faults, seed=0)
    np.testing.assert_array_equal(commands, trajectories())
    np.testing.assert_array_equal(made.commands, commands)
    np.testing.assert_array_equal(made.nominal, wanted.nominal)
    np.testing.assert_array_equal(made.observed, wanted.observed)


def test_compiled_functions_and_lists_do() -> None:
    plain = FunctionTwin(np.sqrt, INPUTS, INPUTS, 10.0).simulate(trajectories(), seed=0)
    np.testing.assert_array_equal(plain.nominal, np.sqrt(trajectories()))
    listed = twin(lambda one: level(one).tolist(), vectorised=False).simulate(
        trajectories(), seed=0
    )
    np.testing.assert_array_equal(listed.nominal, level(trajectories()))


def test_bad_settings_are_refused() -> None:
    for settings, message in (
        ({"function": 3}, "function: expected something that can be called"),
        ({"nominal": 3}, "nominal: expected something that can be called"),
        ({"function": noisy}, "nominal: expected .* noisy is random, got None; give nominal="),
        ({"workers": 0, "vectorised": False}, "workers: expected 1, or more"),
        ({"workers": 2}, "workers: .*got 2 with vectorised=True"),
        ({"vectorised": False, "workers": 2, "function": lambda c: c}, "function: .*workers=1"),
        ({"vectorised": False, "workers": 2, "nominal": lambda c: c}, "nominal: .*workers=1"),
    ):
        with pytest.raises(rt.InputError, match=message):
            twin(**settings)
    for rate in (0.0, np.nan, np.inf, "fast", None):
        with pytest.raises(rt.InputError, match="rate: expected a positive number"):
            FunctionTwin(level, INPUTS, OUTPUTS, rate)


def test_limits_are_kept() -> None:
    bounded = twin(limits=rt.Limits((0.0, 0.0), (20.0, 13.0)))
    with pytest.raises(rt.InputError, match="heater from 0 to 13 W, got 14 in trajectory 4"):
        bounded.simulate(trajectories(), seed=0)


def in_a_script(tmp_path: Path, body: str) -> subprocess.Popen:
    """A script of its own that makes `twin` of `slow` with two workers, then does `body`."""
    head = (
        "import sys, time\nimport numpy as np\nimport retwin as rt\n"
        "from retwin.twins.function import FunctionTwin\n"
        "def slow(commands):\n    time.sleep(0.2)\n    return commands[:, :1]\n"
        "channels = rt.Channels(('a',), ('1',))\n"
        "twin = FunctionTwin(slow, channels, channels, 1.0, vectorised=False, workers=2)\n"
    )
    script = tmp_path / "script.py"
    script.write_text(head + body)
    return subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # What a shell starts in the background is deaf to Ctrl-C, and so are its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def test_control_c_ends_it_at_once(tmp_path: Path) -> None:
    body = (
        "if __name__ == '__main__':\n"
        "    twin.simulate(np.ones((500, 4, 1)), seed=0, progress=lambda s: print(s, flush=True))\n"
    )
    with in_a_script(tmp_path, body) as process:
        assert process.stdout is not None
        assert float(process.stdout.readline()) > 0
        process.send_signal(signal.SIGINT)
        shares, errors = process.communicate(timeout=60)
    # It ends with trajectories left to do, however fast or slow the machine is.
    assert all(float(share) < 1 for share in shares.split())
    assert "KeyboardInterrupt" in errors


def test_a_script_without_a_guard_is_advised(tmp_path: Path) -> None:
    with in_a_script(tmp_path, "twin.simulate(np.ones((3, 4, 1)), seed=0)\n") as process:
        _, errors = process.communicate(timeout=120)
    assert re.search(r"InputError: workers: .*under `if __name__ == '__main__':`", errors)


def test_a_function_that_the_workers_cannot_find_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As one from a notebook cell: it has a name here, but not there."""
    main = sys.modules["__main__"]
    monkeypatch.setattr(gone, "__module__", "__main__")
    monkeypatch.setattr(main, "gone", gone, raising=False)
    with pytest.raises(rt.InputError, match=r"function: .*can import, got .*'gone'.*workers=1"):
        twin(gone, vectorised=False, workers=2).simulate(trajectories(), seed=0)


@pytest.mark.slow
def test_the_how_to_is_true(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "twins.md").read_text("utf-8")
    blocks = re.findall(r"^```python\n(# (\S+\.py)\n.*?)^```", page, re.M | re.S)
    files = {name: code for code, name in blocks}
    assert list(files) == ["tank.py", "noisy.py", "slow.py", "tanks.py", "test_tank.py"]
    for name, code in files.items():
        (tmp_path / name).write_text(code)
        run = [*(["-m", "pytest", "-q"] if name.startswith("test") else []), name]
        done = subprocess.run(
            [sys.executable, *run], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        for line in re.findall(r"# prints (.*)", code):
            assert line in done.stdout


def ramp(commands: np.ndarray, rate: float, slope: float = 1.0) -> np.ndarray:
    """Time in s since the begin, for one trajectory."""
    return slope * np.arange(len(commands))[:, None] / rate


def leaves(commands: np.ndarray) -> np.ndarray:
    raise SystemExit(0)


def test_the_rate_is_given_to_a_function_that_has_it() -> None:
    channel = rt.Channels(("a",), ("1",))
    for function, last in [
        (ramp, 0.8),
        (partial(ramp, rate=1.0), 8.0),
        (partial(ramp, slope=2), 1.6),
    ]:
        twin = FunctionTwin(function, channel, channel, 10.0, vectorised=False)
        made = twin.simulate(np.ones((2, 9, 1)), seed=0)
        assert made.observed[:, -1, 0].tolist() == [last, last]


def test_a_function_that_ends_the_program_in_a_worker_is_a_failure() -> None:
    channel = rt.Channels(("a",), ("1",))
    twin = FunctionTwin(leaves, channel, channel, 10.0, vectorised=False, workers=2)
    with pytest.raises(RuntimeError, match=r"ended the program \(SystemExit: 0\)"):
        twin.simulate(np.ones((2, 9, 1)), seed=0)
