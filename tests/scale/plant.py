"""A plant with long trajectories, and work on a set of it; run as a script, under a memory limit.

`python plant.py WORK SMALL LARGE OUT` does WORK on the set SMALL, so that everything is imported
and has run once, then limits its own memory and does it on the set LARGE.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import retwin as rt
from retwin.commands import RampSampler
from retwin.corrections import Additive
from retwin.scale import SimulationPlan, simulate_to
from retwin.training import Training
from retwin.twins.function import FunctionTwin

HEADROOM = 2**27
"""Bytes of memory that work may take beyond what a process has that did it on a small set."""
BYTES = 4 * 4 + 4 + 4 + 1
"""Of one sample: commands, nominal and observed output, mask."""
STEPS, RATE = 16_000, 1600.0
BRIEF = Training(epochs=1, batch=512, rate=1e-2)
OF_CLASSES = Training(epochs=1, batch=32, rate=1e-2)


def level(commands: NDArray) -> NDArray:
    """What the plant does."""
    return 0.01 * commands.sum(axis=-1, keepdims=True)


CASE = rt.Case(
    name="plant",
    title="A plant",
    faults={"Healthy": None, "Stuck": rt.Stuck(0, 3000), "Biased": rt.SteadyStateError(1)},
    twin=FunctionTwin(
        level, rt.Channels.numbered("u", 4, "%"), rt.Channels.numbered("y", 1, "m"), RATE
    ),
    emulator=None,
    sampler=RampSampler((0.0,) * 4, (100.0,) * 4, movements=3, steps=STEPS, ramps=(800, 1600)),
    correction=Additive(),
    output_correction=Additive(),
    sensor_rate=10.0,
    network=rt.MLP((16,)),
    training=BRIEF,
)


def plan(n: int) -> SimulationPlan:
    return SimulationPlan(CASE.twin, CASE.sampler, seed=5, n=n, faults=CASE.faults, chunk=64)


def learn(data: Path, out: Path) -> None:
    """A surrogate and a classifier, and what the latter says of all that it has seen."""
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
    assert found["data"]["twin"]["n"] == len(rt.load(data))


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


def limited(headroom: int) -> None:
    """Forbid more memory than there is now and so much.

    `RLIMIT_DATA`, which `ulimit -d` sets: memory that only this process can write. Not
    `RLIMIT_AS` (`ulimit -v`), which counts what is mapped: of torch that is gigabytes of which
    hardly any is memory, and a read-only map of a file takes none that the system could not have
    back at once.
    """
    told = Path("/proc/self/status").read_text("utf-8")
    (taken,) = (line.split()[1] for line in told.splitlines() if line.startswith("VmData:"))
    limit = 1024 * int(taken) + headroom
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def main(work: Callable[[Path, Path], None], small: Path, large: Path, out: Path) -> None:
    for name, data in (("small", small), ("large", large)):
        folder = out / name
        folder.mkdir()
        work(data, folder)
        if name == "small":
            limited(HEADROOM)
    try:
        np.ones(2 * HEADROOM, np.uint8)
    except MemoryError:
        return
    raise AssertionError("nothing limits the memory")


if __name__ == "__main__":
    works = {each.__name__: each for each in (learn, study, copy, simulate)}
    main(works[sys.argv[1]], *map(Path, sys.argv[2:]))
