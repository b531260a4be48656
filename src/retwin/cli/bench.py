"""`retwin bench`: times on this machine, beside those of the paper.

The paper's twin takes about 8.5 hours for 3600 trajectories on an Apple M1 Pro, its IBG and RG
together 4 to 5 minutes. These figures exclude training, and the same arm can be simulated in other
ways.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import retwin as rt
from retwin.cli.options import Json, option
from retwin.cli.terminal import answer, bar, note, table
from retwin.data.trajectories import HEALTHY
from retwin.serialisation.files import write_json
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.nets.training import Training
    from retwin.twins.twin import Twin

PAPER = {"twin": 8.5 * 3600.0, "corrected": 4.5 * 60.0}
"""The paper's times for 3600 trajectories, in s; it states the latter as 4 to 5 min."""
BRIEF = (1, 3)
"""Epochs of the two trainings from which the time of all epochs is extrapolated."""
MAX_COUNT, MAX_REPEATS = 10**7, 1000
"""Largest numbers of trajectories, and of runs, beyond which no median changes."""

Model = TypeVar("Model")


@dataclass(frozen=True)
class Timing:
    """The time that something takes.

    Attributes
    ----------
    what : str
        What is timed, in words.
    seconds : float
        Time of all of it, in s.
    ratio : float or None
        The same in multiples of the corrected twin's; None for what is learned once.
    paper : float or None
        Time of the same in the paper, in s; None if the paper has none.

    """

    what: str
    seconds: float
    ratio: float | None = None
    paper: float | None = None


def bench(
    out: Annotated[Path | None, option("FILE", "JSON file for the figures, too.")] = None,
    n: Annotated[
        int, option("N", "Trajectories that times are given for.", "--n", min=9, max=MAX_COUNT)
    ] = 3600,
    repeats: Annotated[
        int, option("N", "Times that generation is timed.", min=1, max=MAX_REPEATS)
    ] = 3,
    as_json: Json = False,
) -> None:
    """Time twins of the arm and what learns from them, beside the paper."""
    if out is not None:
        check_place(out)
    with bar("bench") as show:
        found = measure_times(n, repeats, show)
    figures = {"trajectories": n, **{name: asdict(each) for name, each in found.items()}}
    if out is not None:
        write_json(out, figures)
    rows = [
        [each.what, *(f"{x:.3g}" if x else "" for x in (each.seconds, each.ratio, each.paper))]
        for each in found.values()
    ]
    numbers = ("s", "ratio", "paper, s")
    shown = table((f"{n} labelled trajectories of 10 s", *numbers), rows, numbers=numbers)
    answer(figures, shown, as_json=as_json)
    if out is not None:
        note(f"Wrote {out}")


def measure_times(
    count: int, repeats: int, report: Callable[[str, float], None]
) -> dict[str, Timing]:
    """The times of generating `count` labelled trajectories of the arm, and of learning.

    Slow twins generate a share of the trajectories, and networks are trained for a few epochs,
    since times do not depend on their quality. Times are scaled up from there.

    Parameters
    ----------
    count, repeats : int
        Trajectories that times are given for, and runs of which the median time is taken.
    report : callable
        Called with the name of what is timed and the share that is done.

    Returns
    -------
    dict of str to Timing
        By a short name.

    """
    case = rt.cases.get("armpi")
    report("learning", 0.0)
    surrogate, corrected, learned = _learn(case, count)
    classes = len(case.classes)
    times: dict[str, float] = {}
    titles: dict[str, str] = {}
    for name, (titles[name], twin, share) in _ways(case, surrogate, corrected).items():
        report(titles[name], 0.4 + 0.1 * len(times))
        per_class = max(1, round(share * count / classes))
        make = partial(rt.generate, twin, case, per_class=per_class, seed=2)
        times[name] = median_seconds(make, repeats) * count / (per_class * classes)
    generation = {
        name: Timing(titles[name], seconds, seconds / times["corrected"], PAPER.get(name))
        for name, seconds in times.items()
    }
    return generation | learned


def _ways(
    case: Case, surrogate: rt.Surrogate, corrected: Sequence[Twin]
) -> dict[str, tuple[str, Twin, float]]:
    """Title and twin of each way of generating, and the share that is enough to time it."""
    slow, default = (replace(case.twin, step=step) for step in (0.001, 0.005))  # type: ignore[type-var]
    return {
        "twin": ("MuJoCo twin, steps of 1 ms", slow, 0.05),
        "twin_default": ("MuJoCo twin, steps of 5 ms, its default", default, 0.1),
        "corrected": ("corrected twin, delay and offset", corrected[0], 1.0),
        "corrected_command": ("corrected twin, command space", corrected[1], 0.25),
        "surrogate": ("surrogate alone", surrogate, 1.0),
        "closed_form": ("closed-form kinematics", rt.twins.get("armpi-kinematic"), 1.0),
    }


def _learn(
    case: Case, count: int
) -> tuple[rt.Surrogate, list[rt.CorrectedTwin], dict[str, Timing]]:
    """The surrogate, the twin corrected at its outputs and in command space, and their times."""
    from retwin.diagnosis.network import training_for
    from retwin.update.surrogate import surrogate_training

    assert case.emulator is not None
    n = case.per_class
    healthy = replace(case, faults={HEALTHY: None})
    simulated = rt.generate(case.twin, healthy, per_class=n, seed=0)
    surrogate, seconds = _train_briefly(
        lambda how: rt.fit_surrogate(simulated, case.network, seed=0, training=how),
        case.training or surrogate_training(case.network),
    )
    learned = {"surrogate_learning": Timing(f"learning the surrogate, {n} simulations", seconds)}
    measured = rt.generate(case.emulator, case, per_class=10, seed=1).with_label(HEALTHY)
    corrected = []
    for name, where, correction in (
        ("residual", "at outputs", case.output_correction),
        ("residual_command", "in command space", case.correction),
    ):
        seconds, residual = timed(partial(rt.fit_residual, surrogate, measured, correction, seed=0))
        corrected.append(rt.CorrectedTwin(surrogate, residual))
        learned[name] = Timing(f"residual model {where}, {len(measured)} trajectories", seconds)
    per_class = max(5, count // len(case.classes))
    made = rt.generate(corrected[0], case, per_class=per_class, seed=2)
    _, seconds = _train_briefly(
        lambda how: rt.fit_diagnoser(made, rt.CNN(), seed=0, training=how), training_for(rt.CNN())
    )
    learned["classifier"] = Timing(f"training the CNN, {len(made)} trajectories", seconds)
    return surrogate, corrected, learned


def median_seconds(make: Callable[[], object], repeats: int = 3) -> float:
    """Median time of `make` in s, by the wall clock."""
    return statistics.median(timed(make)[0] for _ in range(repeats))


def timed(make: Callable[[], Model]) -> tuple[float, Model]:
    """Time of `make` in s, by the wall clock, and its result."""
    started = time.perf_counter()
    made = make()
    return time.perf_counter() - started, made


def _train_briefly(fit: Callable[[Training], Model], training: Training) -> tuple[Model, float]:
    """A model fitted in three epochs, and the time in s that all epochs would take.

    The difference between one epoch and three is the time of an epoch; the rest occurs once.
    """
    (first, _), (second, model) = (
        timed(partial(fit, replace(training, max_epochs=epochs))) for epochs in BRIEF
    )
    slope = max(0.0, second - first) / (BRIEF[1] - BRIEF[0])
    return model, first + (training.max_epochs - BRIEF[0]) * slope
