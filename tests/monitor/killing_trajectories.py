"""A live monitor of trajectories that is killed again and again; run as a script.

`python killing_trajectories.py FOLDER KILLS SEED` prints a line for everything that was lost,
counted twice or found differently.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from monitor.killing_live import attempt
from monitor.test_live_trajectories import LEAK, alarm_log, fitted, runs, stored, trajectories

from retwin.monitor import Gate, Live, Registry, Store

HEALTHY, LEAKING = runs(2, 3), runs(1, 4, LEAK)
ASSETS = ("a", "b")


def unit(k: int) -> list:
    """The k-th trajectory of each machine; one in three leaks."""
    made = LEAKING if k % 3 == 2 else HEALTHY[[k % 2]]
    return [trajectories(made, asset, first=k)[0] for asset in ASSETS]


def stream(folder: Path, _url: str, steps: int, begin: int, seed: int, acknowledged: int) -> None:
    """Send what was not acknowledged, and write what is stored."""
    with Store(folder) as store, Gate(Live(store)) as gate:
        # An acknowledgement may have been lost.
        for k in range(max(0, begin - seed % 3), steps):
            for each in [gate.send(each) for each in unit(k)]:
                each.result()
            os.write(acknowledged, f"{k + 1}\n".encode())


def main(folder: Path, kills: int, seed: int) -> None:
    """Kill the process at random moments, let it finish, and compare with one that was not."""
    rng = np.random.default_rng(seed)
    fitted().save(folder / "watch")
    for name in ("killed", "whole"):
        with Store(folder / name) as store:
            registry = Registry(store, "robot")
            registry.promote(registry.propose(folder / "watch", "first").number)
            for asset in ASSETS:
                Live(store).add(asset, "robot")
    # Some kills come before the start is over, whatever the machine, and most after it.
    began = time.perf_counter()
    done = attempt(folder / "killed", "", 1, 0, 0, None, stream)
    usual = time.perf_counter() - began
    for kill in range(kills):
        seconds = rng.uniform(0.5, 2.0) * usual
        done = attempt(folder / "killed", "", 10**4, done, kill, seconds, stream)
    steps = done + 6
    attempt(folder / "killed", "", steps, done, kills, None, stream)
    attempt(folder / "whole", "", steps, 0, 0, None, stream)
    found = []
    for name in ("killed", "whole"):
        with Store(folder / name, read_only=True) as store:
            states = [stored(store, asset) for asset in ASSETS]
            found.append((alarm_log(store, folder / f"{name}.jsonl"), states))
    if found[0] != found[1]:
        print("alarms, states or samples differ from those of a process that was not killed")
    alarms = len(found[0][0].splitlines())
    if not alarms:
        print("there was no alarm")
    print(f"{kills} kills, {steps} trajectories, {alarms} alarms", file=sys.stderr)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
