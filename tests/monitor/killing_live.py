"""A live monitor that is killed again and again; run as a script.

`python killing_live.py FOLDER URL KILLS SEED` prints a line for everything that was lost, counted
twice or found differently. Everything is imported once; each attempt is a forked process.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from leaking_tank import TANK, recorded

from retwin.monitor import Live, Registry, Samples, Store, export_log, fit_monitor, verify
from retwin.twins import ParameterShift
from retwin.update import Dynamics, Library, fit_dynamics

ASSETS = ("pump", "tank", "valve")
BEGIN = 1_700_000_000 * 10**9
STEPS = 2000


@cache
def streams() -> dict[str, np.ndarray]:
    """The samples of each machine, which are repeated; two of them leak for some time."""
    made = {}
    for i, name in enumerate(ASSETS):
        leak = ParameterShift("drain", size=0.2, onset=500.0 + 100 * i, end=900.0)
        record = recorded(100 * i, leak if i < 2 else None, steps=STEPS)
        made[name] = np.concatenate([record.commands[0], record.observed[0]], axis=1).astype(float)
    return made


def samples(name: str, first: int, last: int) -> Samples:
    """Those of a machine from a number to another."""
    number = np.arange(first, last)
    return Samples(name, BEGIN + 10**9 * number, streams()[name][number % STEPS])


def stream(folder: Path, url: str, steps: int, begin: int, seed: int, acknowledged: int) -> None:
    """Send what was not acknowledged, in batches of random sizes, and write what is stored."""
    rng = np.random.default_rng(seed)
    with Store(folder, url) as store:
        live = Live(store)
        k = max(0, begin - int(rng.integers(0, 50)))  # an acknowledgement may have been lost
        while k < steps:
            size = min(int(rng.integers(1, 60)), steps - k)
            live.submit([samples(name, k, k + size) for name in ASSETS])
            k += size
            os.write(acknowledged, f"{k}\n".encode())


def attempt(
    folder: Path,
    url: str,
    steps: int,
    begin: int,
    seed: int,
    seconds: float | None,
    stream: Callable = stream,
) -> int:
    """The number of samples of each machine that were acknowledged until the process was killed."""
    received, sent = os.pipe()
    process = os.fork()
    if not process:
        code = 1
        try:
            os.close(received)
            stream(folder, url, steps, begin, seed, sent)
            code = 0
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            os._exit(code)
    os.close(sent)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(process, signal.SIGKILL)
    with os.fdopen(received) as lines:
        numbers = lines.read().split("\n")[:-1]
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    assert code in (0, -signal.SIGKILL), code
    return max([begin, *map(int, numbers)])


def prepared(folder: Path, url: str) -> None:
    """A store with the twin and the machines."""
    with Store(folder, url) as store:
        registry = Registry(store, "tank")
        registry.promote(registry.propose(folder.parent / "watch", "first").number)
        live = Live(store)
        for name in ASSETS:
            live.add(name, "tank")


def differences(folder: Path, url: str, steps: int) -> list[str]:
    """What of the store is not as `steps` acknowledged samples leave it."""
    found = []
    with Store(folder, url, read_only=True) as store:
        for name in ASSETS:
            parts = list(store.samples(name))
            times = np.concatenate([part[0] for part in parts])
            rows = np.concatenate([part[1] for part in parts])
            expected = samples(name, 0, steps)
            if not np.array_equal(times, expected.times):
                found.append(f"{name}: {len(times)} samples, {steps} acknowledged")
            elif not np.array_equal(rows, expected.values):
                found.append(f"{name}: other values")
        if not verify(store.log(), store.head).ok:
            found.append("the log is broken")
    return found


def main(folder: Path, url: str, kills: int, seed: int) -> None:
    """Kill the process at random moments, let it finish, and compare with one that was not."""
    rng = np.random.default_rng(seed)
    twin = fit_dynamics(TANK, recorded(9001, steps=1000), Dynamics(Library(0, (), False))).twin
    fit_monitor(twin, recorded(9002, steps=1000), "1 per day").save(folder / "watch")
    prepared(folder / "killed", url)
    streams()
    done = 0
    for kill in range(kills):
        done = attempt(folder / "killed", url, 10**5, done, kill, rng.uniform(0.3, 1.5))
    steps = done + 1500
    attempt(folder / "killed", url, steps, done, kills, None)
    print(*differences(folder / "killed", url, steps), sep="\n", end="")
    prepared(folder / "whole", "")
    attempt(folder / "whole", "", steps, 0, kills + 1, None)
    files, states = [], []
    for name, where in (("killed", url), ("whole", "")):
        files.append(folder / f"{name}.jsonl")
        with Store(folder / name, where, read_only=True) as store:
            export_log(store.log(), files[-1], kind="alarm", order=("time", "asset"))
            stored = [store.state(each) for each in ASSETS]
        states.append([each and each[1]["monitor"].tobytes() for each in stored])
    if states[0] != states[1] or None in states[0]:
        print("the states differ from those of a process that was not killed")
    if files[0].read_bytes() != files[1].read_bytes():
        print("the alarms differ from those of a process that was not killed")
    alarms = len(files[0].read_bytes().splitlines())
    print(f"{kills} kills, {steps} samples, {alarms} alarms", file=sys.stderr)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
