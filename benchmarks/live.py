"""What the live monitor costs: latency, load of a core, speed of a replay, and memory.

    python benchmarks/live.py
    python benchmarks/live.py memory
    python benchmarks/live.py http

An emulated tank with one input and one output. Latency is the time from `Gate.send` to the result,
when samples, state and alarms of one machine are durable. The load is that of 100 machines at 10 Hz
whose samples arrive in batches of 0.1 s, as CPU time of all threads over the wall clock time. The
replay is of one day at 1 Hz in one call. Memory is resident memory after 0.2 and after 2 million
samples of 100 machines. The latency of the disk is that of a commit of SQLite alone. Over HTTP, the
latency is that of a request with one sample, without other work and while the causes of alarms of
other machines are inferred.
"""

from __future__ import annotations

import http.client
import json
import secrets
import sqlite3
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from record import record

import retwin as rt
from retwin.monitor import (
    Explanations,
    Gate,
    Live,
    Monitor,
    Registry,
    Samples,
    Store,
    fit_monitor,
)
from retwin.monitor.server import create_app, listening, serving
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, Library, fit_dynamics

MACHINES, TOTAL = 100, 2_000_000
SECOND = 10**9
SENT = 300
"""Samples of one machine from which the latency is measured."""
ROUNDS = 200
"""Batches of 0.1 s from which the load is measured."""


def tank(rate: float) -> StateTwin:
    """A tank that is sampled at this rate in Hz."""
    return StateTwin(
        (State("level", "m", 0.5, 0.0, 3.0),),
        lambda x, u: x.level,
        rt.Channels(("pump",), ("V",)),
        rt.Channels(("level",), ("m",)),
        rate,
        derivative=lambda x, u, p: (0.1 * u.pump - p.drain * x.level,),
        parameters=(Parameter("drain", "1/s", 0.01, 1.0, 0.1),),
    )


def recorded(rate: float, count: int, steps: int, seed: int) -> rt.Trajectories:
    """Healthy records of emulated machines."""
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.0, 2.0, size=(count, steps // 20, 1)), 20, axis=1)
    made = tank(rate).simulate(pump, seed=0, parameters={"drain": 0.13})
    return made.replace(observed=made.observed + 0.01 * rng.normal(size=made.observed.shape))


def calibrated(rate: float) -> Monitor:
    """A monitor of the tank."""
    settings = Dynamics(Library(0, (), False))
    twin = fit_dynamics(tank(rate), recorded(rate, 1, 600, 0), settings).twin
    return fit_monitor(twin, recorded(rate, 2, 600, 1), "1 per month")


@contextmanager
def opened(monitor: Monitor, machines: int) -> Iterator[Live]:
    """A live monitor of so many machines in a store of its own."""
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        monitor.save(Path(folder) / "monitor")
        with Store(Path(folder) / "store") as store:
            registry = Registry(store, "tank")
            registry.promote(registry.propose(Path(folder) / "monitor", "first").number)
            live = Live(store)
            for i in range(machines):
                live.add(f"m{i}", "tank")
            yield live


def rows(made: rt.Trajectories) -> np.ndarray:
    """Commands and outputs (n, T, 2)."""
    return np.concatenate([made.commands, made.observed], axis=2).astype(float)


def main() -> None:
    monitor, begin = calibrated(10.0), time.time_ns() - 10**6 * SECOND
    if sys.argv[1:] == ["memory"]:
        record("live memory", f"live monitor, {MACHINES} machines", memory(monitor, begin))
        return
    if sys.argv[1:] == ["http"]:
        record("live http", f"live monitor, {MACHINES} machines", over_http(monitor, begin))
        return
    figures = (
        latency_of_disk() | latency(monitor, begin) | load(monitor, begin) | replay(calibrated(1.0))
    )
    record("live", f"live monitor, {MACHINES} machines", figures)


def latency_of_disk() -> dict[str, float]:
    """Seconds of a durable commit of one row, without anything of this package."""
    taken = []
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        connection = sqlite3.connect(Path(folder) / "disk.sqlite")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("CREATE TABLE rows (packed BLOB)")
        for _ in range(SENT):
            started = time.perf_counter()
            connection.execute("INSERT INTO rows VALUES (?)", (bytes(1000),))
            connection.commit()
            taken.append(time.perf_counter() - started)
            time.sleep(0.005)
        connection.close()
    return {
        "commit of SQLite alone, median (ms)": 1e3 * float(np.median(taken)),
        "commit of SQLite alone, 99 % (ms)": 1e3 * float(np.quantile(taken, 0.99)),
    }


def latency(monitor: Monitor, begin: int) -> dict[str, float]:
    """Seconds from a sample to its result, of one machine alone."""
    values = rows(recorded(10.0, 1, SENT, 2))[0]
    taken = []
    with opened(monitor, MACHINES) as live, Gate(live) as gate:
        for k in range(SENT):
            times = np.array([begin + k * SECOND // 10])
            started = time.perf_counter()
            gate.send(Samples("m0", times, values[k : k + 1])).result()
            taken.append(time.perf_counter() - started)
            time.sleep(0.005)
    return {
        "latency, median (ms)": 1e3 * float(np.median(taken)),
        "latency, 99 % (ms)": 1e3 * float(np.quantile(taken, 0.99)),
    }


def over_http(monitor: Monitor, begin: int) -> dict[str, float]:
    """Seconds of requests with a sample, alone and while causes are inferred."""
    values = rows(recorded(10.0, 1, 10 * SENT, 2))[0]
    changed = values[:200] + [0.0, 0.2] * (np.arange(200) >= 120)[:, None]
    token, taken, k = secrets.token_urlsafe(), {"alone": [0.0], "causes": [0.0]}, 0
    with ExitStack() as running:
        live = running.enter_context(opened(monitor, MACHINES))
        gate = running.enter_context(Gate(live))
        explanations = running.enter_context(Explanations(live))
        bound = running.enter_context(listening("127.0.0.1", 0))
        running.enter_context(serving(create_app(live, gate, token=token), bound))
        connection = http.client.HTTPConnection(*bound.getsockname()[:2])
        headers = {"authorization": f"Bearer {token}"}
        for what, own in taken.items():
            if what == "causes":
                for i in range(1, 13):
                    times = begin + np.arange(len(changed)) * SECOND // 10
                    live.submit([Samples(f"m{i}", times, changed)])
                explained = threading.Thread(target=explanations.wait)
                explained.start()
                connection.close()  # the server does, after a pause; the next request opens it
            while len(own) <= SENT if what == "alone" else explained.is_alive():
                pump, level = values[k]
                sample = {"asset": "m0", "time_ns": begin + k * SECOND // 10}
                body = json.dumps({**sample, "values": {"pump": pump, "level": level}})
                started = time.perf_counter()
                connection.request("POST", "/samples", body, headers)
                assert connection.getresponse().read()
                own.append(time.perf_counter() - started)
                time.sleep(0.01)
                k += 1
        connection.close()
    return {
        f"latency over HTTP, {what}, {name} (ms)": 1e3 * float(np.quantile(own[1:], share))
        for what, own in taken.items()
        for name, share in (("median", 0.5), ("99 %", 0.99))
    }


def load(monitor: Monitor, begin: int) -> dict[str, float]:
    """Share of one core, and seconds to a result, where all machines send at 10 Hz."""
    values = rows(recorded(10.0, MACHINES, ROUNDS, 3))
    taken = []
    with opened(monitor, MACHINES) as live, Gate(live) as gate:
        wall, cpu = time.perf_counter(), time.process_time()
        for k in range(ROUNDS):
            times = np.array([begin + k * SECOND // 10])
            started = time.perf_counter()
            sent = [
                gate.send(Samples(f"m{i}", times, values[i, k : k + 1])) for i in range(MACHINES)
            ]
            for each in sent:
                each.result()
            taken.append(time.perf_counter() - started)
            time.sleep(max(0.0, wall + 0.1 * (k + 1) - time.perf_counter()))
        share = (time.process_time() - cpu) / (time.perf_counter() - wall)
    return {
        "all machines at 10 Hz, share of a core": share,
        "latency, median (ms), all machines": 1e3 * float(np.median(taken)),
        "latency, 99 % (ms), all machines": 1e3 * float(np.quantile(taken, 0.99)),
    }


def replay(monitor: Monitor) -> dict[str, float]:
    """How many times faster than real time a day at 1 Hz is watched and stored."""
    day = 86_400
    values = rows(recorded(1.0, 1, day, 4))[0]
    times = time.time_ns() - (day - np.arange(day)) * SECOND
    with opened(monitor, 1) as live:
        started = time.perf_counter()
        live.submit([Samples("m0", times, values)])
        taken = time.perf_counter() - started
    return {"replay, times real time at 1 Hz": day / taken}


def memory(monitor: Monitor, begin: int) -> dict[str, float]:
    """Resident memory after a tenth and all of the samples."""
    part = 100
    values = rows(recorded(10.0, MACHINES, 1000, 5))
    count = TOTAL // (MACHINES * part)
    sizes = {}
    with opened(monitor, MACHINES) as live:
        for k in range(count):
            times = begin + (k * part + np.arange(part)) * SECOND // 10
            here = slice(k * part % 1000, k * part % 1000 + part)
            live.submit([Samples(f"m{i}", times, values[i, here]) for i in range(MACHINES)])
            if k + 1 in (count // 10, count):
                sizes[k + 1] = resident()
    least, most = sizes.values()
    return {
        "resident memory after a tenth (MB)": least,
        "growth of resident memory to the end (%)": 100 * (most / least - 1),
    }


def resident() -> float:
    """Resident memory of this process in MB."""
    pages = Path("/proc/self/statm").read_text("ascii").split()[1]
    return int(pages) * 4096 / 2**20


if __name__ == "__main__":
    main()
