"""`retwin bench`: times of twins of the arm on this machine, beside those of the paper.

The paper's twin takes about 8.5 hours for 3600 trajectories on an Apple M1 Pro, its IBG and RG
together 4 to 5 minutes. These figures exclude training.
"""

from __future__ import annotations

import statistics
import timeit
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import retwin as rt
from retwin.cli.options import Json, option
from retwin.cli.terminal import answer, bar, table
from retwin.data.trajectories import HEALTHY

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.twins.twin import Twin

PAPER = {"twin": 8.5 * 3600.0, "corrected": 4.5 * 60.0}
"""The paper's times for 3600 trajectories, in s; it states the latter as 4 to 5 min."""
MAX_COUNT, MAX_REPEATS = 10**7, 1000
"""Largest numbers of trajectories, and of runs, beyond which no median changes."""


def bench(
    n: Annotated[
        int, option("N", "Trajectories that times are given for.", "--n", min=9, max=MAX_COUNT)
    ] = 3600,
    repeats: Annotated[
        int, option("N", "Times that generation is timed.", min=1, max=MAX_REPEATS)
    ] = 3,
    as_json: Json = False,
) -> None:
    """Time twins of the arm, beside the paper."""
    case = rt.cases.get("armpi")
    figures: dict[str, dict[str, Any]] = {}
    with bar("bench") as show:
        show("learning", 0.0)
        for name, what, twin, share in _ways(case):
            show(what, 0.4 + 0.1 * len(figures))
            per_class = max(1, round(share * n / len(case.classes)))
            make = partial(rt.generate, twin, case, per_class=per_class, seed=2)
            seconds = median_seconds(make, repeats) * n / (per_class * len(case.classes))
            figures[name] = {"what": what, "seconds": seconds}
    for name, each in figures.items():
        ratio = each["seconds"] / figures["corrected"]["seconds"]
        each.update(ratio=ratio, paper=PAPER.get(name))
    rows = [
        [what, *(f"{x:.3g}" if x else "" for x in numbers)]
        for what, *numbers in (each.values() for each in figures.values())
    ]
    titles = ("s", "ratio", "paper, s")
    shown = table((f"{n} labelled trajectories of 10 s", *titles), rows, numbers=titles)
    answer({"trajectories": n, **figures}, shown, as_json=as_json)


def _ways(case: Case) -> Iterator[tuple[str, str, Twin, float]]:
    """Name, title and twin of each way of generating, and the share that is enough to time it.

    The surrogate is trained for three epochs, since times do not depend on its quality.
    """
    from retwin.update.surrogate import surrogate_training

    assert case.emulator is not None
    healthy = replace(case, faults={HEALTHY: None})
    simulated = rt.generate(case.twin, healthy, per_class=case.per_class, seed=0)
    training = replace(case.training or surrogate_training(case.network), max_epochs=3)
    surrogate = rt.fit_surrogate(simulated, case.network, seed=0, training=training)
    measured = rt.generate(case.emulator, case, per_class=10, seed=1).with_label(HEALTHY)
    corrected, in_commands = (
        rt.CorrectedTwin(surrogate, rt.fit_residual(surrogate, measured, correction, seed=0))
        for correction in (case.output_correction, case.correction)
    )
    slow, default = (replace(case.twin, step=step) for step in (0.001, 0.005))  # type: ignore[type-var]
    yield "twin", "MuJoCo twin, steps of 1 ms", slow, 0.05
    yield "twin_default", "MuJoCo twin, steps of 5 ms, its default", default, 0.1
    yield "corrected", "corrected twin, delay and offset", corrected, 1.0
    yield "corrected_command", "corrected twin, command space", in_commands, 0.25
    yield "surrogate", "surrogate alone", surrogate, 1.0
    yield "closed_form", "closed-form kinematics", rt.twins.get("armpi-kinematic"), 1.0


def median_seconds(make: Callable[[], object], repeats: int = 3) -> float:
    """Median time of `make` in s, by the wall clock."""
    return statistics.median(timeit.repeat(make, repeat=repeats, number=1))
