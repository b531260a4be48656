"""How long things take on this machine, beside what the paper says: `retwin bench`.

The paper's claim is of time: its twin takes about 8.5 hours for 3600 trajectories on an Apple M1
Pro, IBG and RG together 4 to 5 minutes. It leaves training out, and that the same arm can be
simulated otherwise. All that stands beside it here: the arm by MuJoCo, corrected twins, the
surrogate alone, the arm in closed form, and how long the memory takes to be written at all.
"""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from retwin import cases, twins
from retwin._version import __version__
from retwin.cases.case import Case
from retwin.data.trajectories import HEALTHY
from retwin.diagnosis import fit_diagnoser
from retwin.diagnosis.network import training_for
from retwin.errors import InputError
from retwin.nets.networks import CNN
from retwin.nets.training import Training
from retwin.twins.twin import Twin
from retwin.update.corrected import CorrectedTwin, generate
from retwin.update.residual import fit_residual
from retwin.update.surrogate import fit_surrogate, surrogate_training

__all__ = [
    "Benchmark",
    "Timed",
    "generating",
    "machine",
    "median_seconds",
    "memory_bandwidth",
    "run_bench",
    "timed",
]

COUNT = 3600
"""Trajectories of 10 s that times are told for, as in the paper."""
REPEATS = 3
PAPER = {"twin": 8.5 * 3600.0, "corrected": 4.5 * 60.0}
"""The paper's seconds for as many, on an Apple M1 Pro; the latter is told as 4 to 5 minutes."""

Model = TypeVar("Model")
Result = TypeVar("Result")
Report = Callable[[str, float], None]
"""Called with what is being timed and the share that is done."""


@dataclass(frozen=True)
class Timed:
    """How long something takes.

    Attributes
    ----------
    what: in words.
    seconds: for all of it.
    share: of it that was really done, 0 … 1; the time is scaled up.
    paper: the paper's seconds for the same; None where it does not say.

    """

    what: str
    seconds: float
    share: float = 1.0
    paper: float | None = None


@dataclass(frozen=True)
class Benchmark:
    """What was timed.

    Attributes
    ----------
    count: trajectories that `generation` is told for.
    generation: making them, labelled, by name; "corrected" is what the others are held against.
    learning: what must be learned once before, and a classifier from what is made.
    machine: where, with what, and when.

    """

    count: int
    generation: Mapping[str, Timed]
    learning: Mapping[str, Timed]
    machine: Mapping[str, Any]

    def ratio(self, name: str) -> float:
        """How many times as long a way of generating takes as the corrected twin does."""
        return self.generation[name].seconds / self.generation["corrected"].seconds

    @property
    def paper_ratio(self) -> float:
        """The same of the paper's twin and the paper's corrected twin."""
        return PAPER["twin"] / PAPER["corrected"]

    @property
    def pays_from(self) -> float:
        """Trajectories from which learning and generating take less than the twin at 1 ms does.

        Infinite where the corrected twin is the slower one.
        """
        once = sum(self.learning[name].seconds for name in ("twin_data", "surrogate", "residual"))
        gain = self.generation["twin"].seconds - self.generation["corrected"].seconds
        return self.count * once / gain if gain > 0 else float("inf")

    def told(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        ways = {name: asdict(each) for name, each in self.generation.items()}
        return {
            "schema": 1,
            "trajectories": self.count,
            "generation": {name: {**way, "ratio": self.ratio(name)} for name, way in ways.items()},
            "learning": {name: asdict(each) for name, each in self.learning.items()},
            "pays_from": self.pays_from,
            "paper": {"seconds": PAPER, "ratio": self.paper_ratio, "machine": "Apple M1 Pro"},
            "machine": dict(self.machine),
        }


def run_bench(
    *, count: int = COUNT, repeats: int = REPEATS, report: Report | None = None
) -> Benchmark:
    """Time the twins of the arm, and what is learned from them; a minute or two on two cores.

    Slow twins make a part of the trajectories, and networks learn for a few epochs, since times
    do not depend on how good they are: the rest is reckoned. Generation is the median of
    `repeats`, learning is timed once. `report` is told what is going on.

    Raises
    ------
    InputError: `count` or `repeats` below 1.

    """
    for name, number in (("count", count), ("repeats", repeats)):
        if number < 1:
            raise InputError(
                name, expected="at least 1", got=repr(number), remedy="give a positive number"
            )
    tell = report or (lambda _text, _share: None)
    case = cases.get("armpi")
    tell("learning", 0.0)
    learning, corrected, in_commands = _learned(case)
    tell("classifier", 0.3)
    learning["classifier"] = _classifier(corrected, case, count)
    generation = {}
    for done, way in enumerate(_ways(case, corrected, in_commands)):
        tell(way.what, 0.4 + 0.1 * done)
        seconds, share = generating(way.twin, case, count, share=way.share, repeats=repeats)
        generation[way.name] = Timed(way.what, seconds, share, PAPER.get(way.name))
    size = count * _bytes_of_one(case)
    generation["memory"] = Timed("writing as many bytes to memory", size / memory_bandwidth())
    tell("done", 1.0)
    return Benchmark(count, generation, learning, machine())


def generating(
    twin: Twin, case: Case, count: int, *, share: float = 1.0, repeats: int = REPEATS
) -> tuple[float, float]:
    """Median seconds for `count` balanced labelled trajectories, and the share really made.

    With a `share` below 1 fewer are made, at least one of each class, and the time is scaled up.
    """
    per_class = max(1, round(share * count / len(case.classes)))
    seconds = median_seconds(lambda: generate(twin, case, per_class=per_class, seed=2), repeats)
    share = per_class * len(case.classes) / count
    return seconds / share, share


def median_seconds(make: Callable[[], object], repeats: int = REPEATS) -> float:
    """The median time that `make` takes, by the wall clock."""
    return statistics.median(timed(make)[0] for _ in range(repeats))


def timed(
    make: Callable[[], Result], clock: Callable[[], float] = time.perf_counter
) -> tuple[float, Result]:
    """Seconds, by the wall clock unless another is given, and what was made."""
    started = clock()
    result = make()
    return clock() - started, result


def memory_bandwidth() -> float:
    """Bytes per second that one core writes to memory: the best of five copies of 256 MB."""
    source, target = np.ones(2**25), np.zeros(2**25)
    return target.nbytes / min(timed(lambda: np.copyto(target, source))[0] for _ in range(5))


def machine() -> dict[str, Any]:
    """Where something was measured, with what, and when."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "retwin": __version__,
        "processor": _processor(),
        "cores": os.cpu_count(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "torch": version("torch"),
    }


@dataclass(frozen=True)
class _Way:
    """A way of generating, and the share of all trajectories that is enough to time it."""

    name: str
    what: str
    twin: Twin
    share: float = 1.0


def _ways(case: Case, corrected: CorrectedTwin, in_commands: CorrectedTwin) -> list[_Way]:
    slow, default = (replace(case.twin, step=step) for step in (0.001, 0.005))  # type: ignore[type-var]
    return [
        _Way("twin", "MuJoCo twin, steps of 1 ms", slow, 0.05),
        _Way("twin_default", "MuJoCo twin, steps of 5 ms, its default", default, 0.1),
        _Way("corrected", "corrected twin, delay and offset", corrected),
        _Way("corrected_command", "corrected twin, command space", in_commands, 0.25),
        _Way("surrogate", "surrogate alone", corrected.surrogate),
        _Way("closed_form", "closed-form kinematics, vectorised", twins.get("armpi-kinematic")),
    ]


def _learned(case: Case) -> tuple[dict[str, Timed], CorrectedTwin, CorrectedTwin]:
    """Times, and the twin corrected at its outputs and in command space."""
    assert case.emulator is not None
    n = case.per_class
    healthy = replace(case, faults={HEALTHY: None})
    took, said = timed(lambda: generate(case.twin, healthy, per_class=n, seed=0))
    found = {"twin_data": Timed(f"simulating {n} trajectories to learn from", took)}
    surrogate, found["surrogate"] = _trained(
        lambda how: fit_surrogate(said, case.network, seed=0, training=how),
        case.training or surrogate_training(case.network),
        "surrogate",
    )
    measured = generate(case.emulator, case, per_class=10, seed=1).with_label(HEALTHY)
    corrected = []
    for name, correction in (
        ("residual", case.output_correction),
        ("residual_command", case.correction),
    ):
        took, residual = timed(partial(fit_residual, surrogate, measured, correction, seed=0))
        corrected.append(CorrectedTwin(surrogate, residual))
        where = "in command space" if name == "residual_command" else "at outputs"
        found[name] = Timed(f"residual model {where}, of {len(measured)} trajectories", took)
    return found, corrected[0], corrected[1]


def _classifier(twin: Twin, case: Case, count: int) -> Timed:
    """How long the CNN takes to learn from `count` generated trajectories."""
    made = generate(twin, case, per_class=max(5, count // len(case.classes)), seed=2)
    return _trained(
        lambda how: fit_diagnoser(made, CNN(), seed=0, training=how),
        training_for(CNN()),
        f"CNN, of {len(made)} trajectories",
    )[1]


def _trained(
    fit: Callable[[Training], Model], training: Training, what: str
) -> tuple[Model, Timed]:
    """What is fitted in three epochs, and how long all of them would take.

    One epoch and three: what is left is what every fit takes once.
    """
    brief = (1, 3)
    (first, _), (second, model) = (
        timed(partial(fit, replace(training, max_epochs=epochs))) for epochs in brief
    )
    slope = max(0.0, second - first) / (brief[1] - brief[0])
    share = min(1.0, brief[1] / training.max_epochs)
    return model, Timed(what, first + (training.max_epochs - brief[0]) * slope, share)


def _bytes_of_one(case: Case) -> int:
    """What a trajectory in memory takes, in single precision: commands, both outputs, mask."""
    return case.sampler.steps * (4 * len(case.inputs) + 9 * len(case.outputs))


def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        told = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2] for line in told.splitlines() if line.startswith("model name")]
    return names[0].strip() if names else platform.processor()
