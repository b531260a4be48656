"""A plant with long trajectories, and work on a set of it; run as a script, under a memory limit.

`python plant.py WORK SMALL LARGE OUT` does WORK on the set SMALL, so that everything is imported
and has run once, then limits the memory of each process and does it on the set LARGE.
"""

from __future__ import annotations

import contextlib
import resource
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

import retwin as rt
from retwin.deploy.simulations import SimulationPlan, simulate_to
from retwin.nets.training import Training
from retwin.twins.commands.samplers import RampSampler
from retwin.twins.function import FunctionTwin
from retwin.update.corrections import Additive

HEADROOM = 2**27
"""Bytes of memory that a process may take beyond the most that one took with the small set."""
BYTES = 4 * 4 + 4 + 4 + 1
"""Of one sample: commands, nominal and observed output, mask."""
STEPS, RATE = 16_000, 1600.0
BRIEF = Training(max_epochs=1, batch_size=512, learning_rate=1e-2)
OF_CLASSES = Training(max_epochs=1, batch_size=32, learning_rate=1e-2)


def level(commands: NDArray) -> NDArray:
    """What the plant does."""
    return 0.01 * commands.sum(axis=-1, keepdims=True)


CASE = rt.Case(
    name="plant",
    title="A plant",
    faults={
        "Healthy": None,
        "Stuck": rt.Stuck(0, 3000 / RATE),
        "Biased": rt.ActuatorBias(1, (10.0, 50.0)),
    },
    twin=FunctionTwin(
        level, rt.Channels.numbered("u", 4, "%"), rt.Channels.numbered("y", 1, "m"), RATE
    ),
    emulator=None,
    sampler=RampSampler((0.0,) * 4, (100.0,) * 4, RATE, STEPS / RATE, 3, (0.5, 1.0)),
    correction=Additive(),
    output_correction=Additive(),
    sensor_rate=10.0,
    network=rt.MLP((16,)),
    training=BRIEF,
)


def plan(n: int) -> SimulationPlan:
    return SimulationPlan(CASE.twin, CASE.sampler, seed=5, n=n, faults=CASE.faults, chunk=64)


def learn(data: Path, out: Path) -> None:
    """Fit a surrogate and a classifier, and diagnose the whole training set."""
    made = rt.load(data, case=CASE)
    surrogate = rt.fit_surrogate(made, CASE.network, seed=0, training=BRIEF)
    diagnoser = rt.fit_diagnoser(made, seed=0, rate=CASE.sensor_rate, training=OF_CLASSES)
    probabilities = diagnoser.predict_proba(made)
    assert np.isfinite(probabilities).all()
    surrogate.save(out / "surrogate")


def study(data: Path, out: Path) -> None:
    """A study whose twin data are the set."""
    real = rt.generate(CASE.twin, CASE, per_class=4, seed=1)
    rt.save(real, out / "real.npz")
    plan = rt.StudyPlan(sources=("dt", "ibg"), runs=1, per_class=10, folds=2)
    found = rt.run_study(
        CASE, plan, rt.StudyData(twin=data, real=out / "real.npz"), out / "study", processes=1
    )
    assert found.data.twin.n == len(rt.load(data))


def copy(data: Path, out: Path) -> None:
    """The same numbers in another folder."""
    made = rt.load(data)
    rt.save(made, out / "copy.zarr")
    np.testing.assert_array_equal(rt.load(out / "copy.zarr").observed[::9], made.observed[::9])


def simulate(data: Path, out: Path) -> None:
    """Another simulation with the commands of the set."""
    again = SimulationPlan(
        CASE.twin, rt.load(data, case=CASE), seed=6, faults=CASE.faults, chunk=32
    )
    assert not simulate_to(out / "again.zarr", again, workers=1).failed


class Watch(threading.Thread):
    """Looks at the memory of this process and of its workers: the most that one of them took."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.most, self._over = 0, threading.Event()
        self._own = psutil.Process()

    def run(self) -> None:
        while not self._over.wait(0.01):
            for each in (self._own, *self._own.children(recursive=True)):
                with contextlib.suppress(psutil.Error):  # it has ended
                    self.most = max(self.most, each.memory_info().data)

    def __enter__(self) -> Watch:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.join()


def limited(most: int) -> None:
    """Forbid this process, and each that it starts, more memory than so many bytes.

    `RLIMIT_DATA`, which `ulimit -d` sets: memory that only one process can write. Not
    `RLIMIT_AS` (`ulimit -v`), which counts what is mapped: of torch that is gigabytes of which
    hardly any is memory, and a read-only map of a file takes none that the system could not have
    back at once.
    """
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def main(work: Callable[[Path, Path], None], small: Path, large: Path, out: Path) -> None:
    for name in ("small", "large"):
        (out / name).mkdir()
    with Watch() as watch:
        work(small, out / "small")
    limited(watch.most + HEADROOM)
    work(large, out / "large")
    try:
        np.ones(watch.most + HEADROOM, np.uint8)
    except MemoryError:
        return
    raise AssertionError("nothing limits the memory")


if __name__ == "__main__":
    works = {each.__name__: each for each in (learn, study, copy, simulate)}
    main(works[sys.argv[1]], *map(Path, sys.argv[2:]))
