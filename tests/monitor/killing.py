"""A process that stores a stream, and is killed again and again; run as a script.

`python killing.py FOLDER URL KILLS SEED` prints a line for everything that was lost, stored twice
or not whole. Everything is imported once; each attempt is a forked process.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

from retwin.monitor import Asset, Store, Update, export_log, verify

ASSETS = ("pump", "tank", "valve")
GROUP = 20
"""Samples of an asset in a commit."""
ALARMS = 3
"""Every which commit has an alarm."""


def stream(store: Store, groups: int, acknowledged: int) -> None:
    """Store what is missing of the stream, and write an acknowledgement of each commit.

    As after a lost acknowledgement, the last group that was stored is sent again.
    """
    found = [store.state(name) for name in ASSETS]
    done = [0 if each is None else int(each[1]["groups"]) for each in found]
    sums = [0.0 if each is None else float(each[1]["sum"]) for each in found]
    assert len(set(done)) == 1, "states of one commit"
    for group in range(max(0, done[0] - 1), groups):
        times = np.arange(group * GROUP, (group + 1) * GROUP)
        values = np.sin(times)[:, None]
        if group < done[0]:
            again = store.commit([Update(name, times, values) for name in ASSETS])
            assert all(len(again.repeated[name]) == GROUP for name in ASSETS)
            continue
        sums = [each + float(values.sum()) for each in sums]
        updates = [
            Update(name, times, values, {"groups": np.array(group + 1), "sum": np.array(total)})
            for name, total in zip(ASSETS, sums, strict=True)
        ]
        alarms = [("alarm", {"asset": ASSETS[0], "time": int(times[-1]), "sum": sums[0]})]
        store.commit(updates, alarms if group % ALARMS == 0 else [])
        os.write(acknowledged, f"{group + 1}\n".encode())


def attempt(folder: Path, url: str, groups: int, seconds: float | None) -> int:
    """The number of groups that a process acknowledged until it ended or was killed."""
    received, sent = os.pipe()
    process = os.fork()
    if not process:
        code = 1
        try:
            os.close(received)
            with Store(folder, url) as store:
                stream(store, groups, sent)
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
    return int(numbers[-1]) if numbers else 0


def differences(folder: Path, url: str, acknowledged: int) -> list[str]:
    """What of the store is not as the acknowledged commits, and perhaps one more, leave it."""
    found = []
    with Store(folder, url) as store:
        names = [asset.name for asset in store.assets()]
        states = [store.state(name) for name in names]
        groups = [0 if state is None else int(state[1]["groups"]) for state in states]
        if len(set(groups)) > 1 or any(each < acknowledged for each in groups):
            found.append(f"{acknowledged} groups were acknowledged, {groups} are stored")
        for name, count, state in zip(names, groups, states, strict=True):
            parts = list(store.samples(name))
            times = np.concatenate([part[0] for part in parts]) if parts else np.empty(0)
            if not np.array_equal(times, np.arange(count * GROUP)):
                found.append(f"{name} has {len(times)} samples of {count} groups")
            expected = sum(float(np.sin(part).sum()) for part in times.reshape(-1, GROUP))
            if state is not None and abs(float(state[1]["sum"]) - expected) > 1e-6:
                found.append(f"a sample of {name} was counted twice or not at all")
        log = list(store.log("alarm"))
        if groups and len(log) != -(-groups[0] // ALARMS):
            found.append(f"{len(log)} alarms of {groups[0]} groups")
        if not verify(store.log(), store.head).ok:
            found.append("the log is broken")
    return found


def main(folder: Path, url: str, kills: int, seed: int) -> None:
    """Kill the process at random moments, let it finish, and compare with one that was not."""
    rng = np.random.default_rng(seed)
    with Store(folder / "killed", url) as store:
        for name in ASSETS:
            store.add_asset(Asset(name, 1))
    acknowledged, killed, longest = 0, 0, 0.3
    groups = 10**9
    while killed < kills:
        last = attempt(folder / "killed", url, groups, rng.uniform(0.0, longest))
        acknowledged, killed = max(acknowledged, last), killed + 1
        print(*differences(folder / "killed", url, acknowledged), sep="\n", end="")
    groups = acknowledged + 10
    attempt(folder / "killed", url, groups, None)
    print(*differences(folder / "killed", url, groups), sep="\n", end="")
    with Store(folder / "whole") as store:
        for name in ASSETS:
            store.add_asset(Asset(name, 1))
    attempt(folder / "whole", "", groups, None)
    files = []
    for name, where in (("killed", url), ("whole", "")):
        files.append(folder / f"{name}.jsonl")
        with Store(folder / name, where, read_only=True) as store:
            export_log(store.log(), files[-1], kind="alarm", order=("time", "asset"))
    if files[0].read_bytes() != files[1].read_bytes():
        print("the alarms differ from those of a process that was not killed")
    print(f"{killed} kills, {groups} groups", file=sys.stderr)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
