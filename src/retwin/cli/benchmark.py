"""Times on this machine, beside those of the paper: what `retwin bench` measures.

The paper's twin takes about 8.5 hours for 3600 trajectories on an Apple M1 Pro, its IBG and RG
together 4 to 5 minutes. These figures exclude training, and the same arm can be simulated in other
ways. Timed here are the arm by MuJoCo, corrected twins, the surrogate alone, the arm in closed
form, what is learned, and, as a lower bound, writing the results to memory.
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
from retwin.checks import whole
from retwin.data.trajectories import HEALTHY
from retwin.diagnosis import fit_diagnoser
from retwin.diagnosis.network import training_for
from retwin.nets.networks import CNN
from retwin.nets.training import Training
from retwin.twins.twin import Twin
from retwin.update.corrected import MAX_PER_CLASS, CorrectedTwin, generate
from retwin.update.residual import fit_residual
from retwin.update.surrogate import fit_surrogate, surrogate_training

COUNT = 3600
"""Trajectories of 10 s that times are given for, as in the paper."""
REPEATS = 3
"""Runs of a generation, of which the median time is taken."""
MAX_REPEATS = 1000
"""Runs beyond this number do not change a median."""
PAPER = {"twin": 8.5 * 3600.0, "corrected": 4.5 * 60.0}
"""The paper's times for as many, in s, on an Apple M1 Pro; it states the latter as 4 to 5 min."""

Model = TypeVar("Model")
Result = TypeVar("Result")
Report = Callable[[str, float], None]
"""Callback that gets the name of what is timed and the share that is done."""


@dataclass(frozen=True)
class Timing:
    """The time that something takes.

    Attributes
    ----------
    what : str
        What is timed, in words.
    seconds : float
        Time of all of it, in s.
    share : float
        Share of it that was run, 0 to 1; the time is scaled up.
    paper : float or None
        Time of the same in the paper, in s; None if the paper has none.

    """

    what: str
    seconds: float
    share: float = 1.0
    paper: float | None = None


@dataclass(frozen=True)
class Benchmark:
    """The times of `run_bench`.

    Attributes
    ----------
    count : int
        Trajectories that `generation` is given for.
    generation : mapping of str to Timing
        Times to generate labelled trajectories, by twin; ratios are to that of "corrected".
    learning : mapping of str to Timing
        Times to learn, once, what the corrected twin needs, and a classifier.
    machine : mapping
        Machine, versions and date.

    """

    count: int
    generation: Mapping[str, Timing]
    learning: Mapping[str, Timing]
    machine: Mapping[str, Any]

    def ratio(self, name: str) -> float:
        """Time of a way of generating, in multiples of the corrected twin's."""
        return self.generation[name].seconds / self.generation["corrected"].seconds

    @property
    def paper_ratio(self) -> float:
        """Time of the paper's twin, in multiples of the paper's corrected twin's."""
        return PAPER["twin"] / PAPER["corrected"]

    @property
    def pays_from(self) -> float:
        """Number of trajectories from which learning and generating are faster than the 1 ms twin.

        It is infinite if the corrected twin is slower.
        """
        once = sum(self.learning[name].seconds for name in ("twin_data", "surrogate", "residual"))
        gain = self.generation["twin"].seconds - self.generation["corrected"].seconds
        return self.count * once / gain if gain > 0 else float("inf")

    def about(self) -> dict[str, Any]:
        """The times as JSON values."""
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
    """Time the twins of the arm and the training of networks; a minute or two on two cores.

    Slow twins generate a share of the trajectories, and networks are trained for a few epochs,
    since times do not depend on their quality. Times are scaled up from there.

    Parameters
    ----------
    count : int
        Trajectories that times are given for, from 1 to 1e7.
    repeats : int
        Runs of each generation, of which the median time is taken, from 1 to 1000; learning runs
        once.
    report : callable, optional
        Called with the name of what is timed and the share that is done.

    Returns
    -------
    Benchmark
        All times.

    Raises
    ------
    InputError
        If `count` or `repeats` is out of range.

    """
    whole("count", count, least=1, most=MAX_PER_CLASS)
    whole("repeats", repeats, least=1, most=MAX_REPEATS)
    show = report or (lambda _text, _share: None)
    case = cases.get("armpi")
    show("learning", 0.0)
    learning, corrected, in_commands = _learned(case)
    show("classifier", 0.3)
    learning["classifier"] = _classifier(corrected, case, count)
    generation = {}
    for done, way in enumerate(_ways(case, corrected, in_commands)):
        show(way.what, 0.4 + 0.1 * done)
        seconds, share = generating(way.twin, case, count, share=way.share, repeats=repeats)
        generation[way.name] = Timing(way.what, seconds, share, PAPER.get(way.name))
    size = count * _bytes_of_one(case)
    generation["memory"] = Timing("writing as many bytes to memory", size / memory_bandwidth())
    show("done", 1.0)
    return Benchmark(count, generation, learning, machine())


def generating(
    twin: Twin, case: Case, count: int, *, share: float = 1.0, repeats: int = REPEATS
) -> tuple[float, float]:
    """Median time in s for `count` balanced labelled trajectories, and the share that was run.

    With a `share` below 1 fewer are generated, at least one of each class, and the time is scaled
    up.
    """
    per_class = max(1, round(share * count / len(case.classes)))
    seconds = median_seconds(lambda: generate(twin, case, per_class=per_class, seed=2), repeats)
    share = per_class * len(case.classes) / count
    return seconds / share, share


def median_seconds(make: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median time of `make` in s, by the wall clock."""
    return statistics.median(timed(make)[0] for _ in range(repeats))


def timed(
    make: Callable[[], Result], clock: Callable[[], float] = time.perf_counter
) -> tuple[float, Result]:
    """Time of `make` in s, by the wall clock unless another is given, and its result."""
    started = clock()
    result = make()
    return clock() - started, result


def memory_bandwidth() -> float:
    """Bytes per second that one core writes to memory, the best of five copies of 256 MB."""
    source, target = np.ones(2**25), np.zeros(2**25)
    return target.nbytes / min(timed(lambda: np.copyto(target, source))[0] for _ in range(5))


def machine() -> dict[str, Any]:
    """The machine, versions and the date, for what is measured."""
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
    """A way of generating, and the share of trajectories that is enough to time it."""

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


def _learned(case: Case) -> tuple[dict[str, Timing], CorrectedTwin, CorrectedTwin]:
    """Times to learn, and the twin corrected at its outputs and in command space."""
    assert case.emulator is not None
    n = case.per_class
    healthy = replace(case, faults={HEALTHY: None})
    seconds, simulated = timed(lambda: generate(case.twin, healthy, per_class=n, seed=0))
    found = {"twin_data": Timing(f"simulating {n} trajectories to learn from", seconds)}
    surrogate, found["surrogate"] = _trained(
        lambda how: fit_surrogate(simulated, case.network, seed=0, training=how),
        case.training or surrogate_training(case.network),
        "surrogate",
    )
    measured = generate(case.emulator, case, per_class=10, seed=1).with_label(HEALTHY)
    corrected = []
    for name, correction in (
        ("residual", case.output_correction),
        ("residual_command", case.correction),
    ):
        seconds, residual = timed(partial(fit_residual, surrogate, measured, correction, seed=0))
        corrected.append(CorrectedTwin(surrogate, residual))
        where = "in command space" if name == "residual_command" else "at outputs"
        found[name] = Timing(f"residual model {where}, of {len(measured)} trajectories", seconds)
    return found, corrected[0], corrected[1]


def _classifier(twin: Twin, case: Case, count: int) -> Timing:
    """Time to train the CNN on `count` generated trajectories."""
    made = generate(twin, case, per_class=max(5, count // len(case.classes)), seed=2)
    return _trained(
        lambda how: fit_diagnoser(made, CNN(), seed=0, training=how),
        training_for(CNN()),
        f"CNN, of {len(made)} trajectories",
    )[1]


def _trained(
    fit: Callable[[Training], Model], training: Training, what: str
) -> tuple[Model, Timing]:
    """A model fitted in three epochs, and the time that all epochs would take.

    The difference between one epoch and three is the time of an epoch; the rest occurs once.
    """
    brief = (1, 3)
    (first, _), (second, model) = (
        timed(partial(fit, replace(training, max_epochs=epochs))) for epochs in brief
    )
    slope = max(0.0, second - first) / (brief[1] - brief[0])
    share = min(1.0, brief[1] / training.max_epochs)
    return model, Timing(what, first + (training.max_epochs - brief[0]) * slope, share)


def _bytes_of_one(case: Case) -> int:
    """Size of a trajectory in single precision: commands, both outputs, mask."""
    return case.sampler.steps * (4 * len(case.inputs) + 9 * len(case.outputs))


def _processor() -> str:
    """Name of the processor, if the system states it."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2] for line in text.splitlines() if line.startswith("model name")]
    return names[0].strip() if names else platform.processor()
