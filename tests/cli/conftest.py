"""What the tests of the command line share: running it, files to run it on, cases of one's own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
import pytest

import retwin as rt
from retwin.cli import main
from retwin.monitor import fit_monitor
from retwin.update import fit_dynamics

PROGRAM = Path(sys.executable).with_name("retwin")

MODULE = """
import numpy as np


def reach(commands):
    # How far an arm of two joints reaches, and how high, in m.
    turned = commands.cumsum(axis=-1)
    return np.stack([np.sin(turned).sum(axis=-1), np.cos(turned).sum(axis=-1)], axis=-1)


def filled(commands, gain=0.1, leak=0.05):
    level = np.zeros((*commands.shape[:2], 1))
    for t in range(1, commands.shape[1]):
        level[:, t] = level[:, t - 1] + gain * commands[:, t - 1] - leak * level[:, t - 1]
    return level
"""

ARM = """
name = "reach"
twin = "own_module:reach"
rate = 10
inputs = { first = { unit = "rad", low = -1, high = 1 }, second = { low = -1, high = 1 } }
outputs = { far = { unit = "m" }, high = { unit = "m" } }
commands = { duration = 9, segments = 3, ramp_durations = [0.8, 1.0] }
network = { kind = "MLP", hidden = [32] }
training = { max_epochs = 20, batch_size = 64, learning_rate = 1e-2 }
density = { kind = "Mixture", training = { max_epochs = 10, decay = "step" } }
[faults]
stuck = { kind = "Stuck", actuator = "second", onset = 1.2 }
"""

TANK = """
name = "tank"
twin = "own_module:filled"
rate = 1
inputs = { valve = { unit = "1", low = 0, high = 1 } }
outputs = { level = { unit = "m" } }
commands = { kind = "HoldSampler", duration = 100, hold_durations = [5, 30] }
correction = "additive"
network = { kind = "StateSpace", states = 2, hidden = 8 }
training = { max_epochs = 10, batch_size = 4, learning_rate = 1e-2 }
[density]
kind = "SequenceMixture"
members = 2
network = { kind = "LSTM", hidden = 4 }
training = { max_epochs = 3 }
[parameters]
gain = { unit = "m", low = 0.05, high = 0.2, start = 0.1 }
leak = { unit = "1/s", low = 0.01, high = 0.1, start = 0.05 }
[records]
calibration = { valve = "u1", level = "y1" }
test = { valve = "u2", level = "y2" }
"""

WATCHED_MODULE = """
import retwin as rt
from retwin.twins import Parameter, State, StateTwin

tank = StateTwin(
    (State("level", "m"),),
    lambda x, u: x.level,
    rt.Channels(("valve",), ("1",)),
    rt.Channels(("level",), ("m",)),
    1.0,
    derivative=lambda x, u, p: (p.gain * u.valve - p.leak * x.level,),
    parameters=(
        Parameter("gain", "m", 0.05, 0.2, 0.1),
        Parameter("leak", "1/s", 0.01, 0.1, 0.05),
    ),
)
"""
WATCHED_CASE = """
name = "watched_tank"
twin = "watched_module:tank"
commands = { kind = "HoldSampler", duration = 100, hold_durations = [5, 30], low = [0], high = [1] }
[faults]
leaking = { kind = "ParameterShift", parameter = "leak", size = [0.02, 0.5] }
[dynamics]
library = { degree = 0, knots = [], friction = false }
"""

Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """Run `retwin …` in this process; exit code, stdout, stderr."""
    monkeypatch.setenv("COLUMNS", "200")

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["retwin", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out, printed.err

    return run


class Running:
    """`retwin …` in a process of its own, which Ctrl-C reaches."""

    def __init__(
        self, words: tuple[object, ...], stderr: Path, stdout: int | IO = subprocess.PIPE
    ) -> None:
        self._stderr = stderr
        with stderr.open("w") as file:
            self.process = subprocess.Popen(
                [PROGRAM, *map(str, words)],
                stdout=stdout,
                stderr=file,
                text=True,
                start_new_session=True,
                # Tests that run in a shell's background would hand down that SIGINT is ignored.
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )

    @property
    def stderr(self) -> str:
        """What it has said there."""
        return self._stderr.read_text()

    def wait(self, when: Callable[[], bool]) -> None:
        """Wait until that is so."""
        deadline = time.monotonic() + 120
        while not when():
            assert self.process.poll() is None, self.stderr
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def interrupt(
        self, when: Callable[[], bool], number: int = signal.SIGINT, *, workers: bool = False
    ) -> str:
        """Ctrl-C as soon as that is so; the line that it ends with, and code 130.

        With `workers` it reaches the worker processes too, as it does from a terminal.
        """
        self.wait(when)
        (os.killpg if workers else os.kill)(self.process.pid, number)
        out, _ = self.process.communicate(timeout=60)
        assert (self.process.returncode, out) == (130, ""), self.stderr
        assert "Traceback" not in self.stderr
        (message,) = (line for line in self.stderr.splitlines() if "interrupted" in line)
        return message


@pytest.fixture
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Running]]:
    """Start `retwin …` as a process of its own."""
    begun: list[Running] = []

    def run(*words: object, **more: object) -> Running:
        begun.append(Running(words, tmp_path_factory.mktemp("output") / "stderr", **more))
        return begun[-1]

    yield run
    for each in begun:
        each.process.kill()
        each.process.communicate()


@pytest.fixture(scope="module")
def files(
    twin_set: rt.Trajectories,
    emulated: rt.Trajectories,
    updated: rt.CorrectedTwin,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A folder with twin.npz, real.npz and a corrected twin."""
    folder = tmp_path_factory.mktemp("files")
    rt.save(twin_set, folder / "twin.npz")
    rt.save(emulated, folder / "real.npz")
    updated.save(folder / "model")
    return folder


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Cases of a user's own in the current folder, and what was measured."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    Path("own_module.py").write_text(MODULE)
    Path("reach.toml").write_text(ARM)
    Path("tank.toml").write_text(TANK)
    reach, tank = (rt.cases.get(f"{name}.toml") for name in ("reach", "tank"))
    made = rt.generate(reach.twin, reach, per_class=12, seed=5)
    delayed = np.concatenate(
        [made.observed[:, :1].repeat(2, axis=1), made.observed[:, :-2]], axis=1
    )
    rt.save(made.replace(observed=delayed + 0.02, emulated=True), "real.npz")
    commands = tank.sampler.sample(2, rng=np.random.default_rng(6)).astype(float)
    level = tank.parametric.with_values({"leak": 0.07}).simulate(commands, seed=0).observed
    columns = np.concatenate([*commands, *level], axis=1)
    np.savetxt("record.csv", columns, delimiter=",", header="u1,u2,y1,y2", comments="")
    yield tmp_path
    sys.modules.pop("own_module", None)


# One for the whole session, since a second module of that name would be refused.
@pytest.fixture(scope="session")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a case, records, a corrected twin and its calibrated monitor."""
    made = tmp_path_factory.mktemp("watched")
    (made / "watched_module.py").write_text(WATCHED_MODULE)
    (made / "case.toml").write_text(WATCHED_CASE)
    system = rt.cases.get(str(made / "case.toml"))
    rng = np.random.default_rng(0)
    for name, late in (("fit", 0.06), ("healthy", 0.06), ("leak", 0.16)):
        valve = np.repeat(rng.random((1, 40, 1)), 10, axis=1)
        level, levels = 0.0, []
        for k, u in enumerate(valve[0, :, 0]):
            levels.append(level)
            leak = 0.06 if k < 300 else late
            level = u * 0.1 / leak + (level - u * 0.1 / leak) * np.exp(-leak)
        output = np.array(levels)[None, :, None] + 1e-3 * rng.normal(size=(1, 400, 1))
        data = system.twin.simulate(valve, seed=0)
        rt.save(data.replace(observed=output), made / f"{name}.npz")
    fitted = fit_dynamics(system.twin, rt.load(made / "fit.npz"), system.dynamics).twin
    replace(fitted, case=str(made / "case.toml")).save(made / "model")
    fit_monitor(fitted, rt.load(made / "healthy.npz"), "1 per day").save(made / "watch")
    return made
