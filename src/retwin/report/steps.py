"""What to do next, from what the summary found undecided, not met, or better elsewhere."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from retwin.report.lights import Alarms, Light, Use
from retwin.report.study import Study
from retwin.scores.change import ErrorChange, needed_to_decide
from retwin.scores.comparison import MIN_RUNS
from retwin.source_results import Comparison


@dataclass(frozen=True)
class Step:
    """A step: its name in the template `steps.html.j2`, and the variables of its sentence."""

    key: str
    values: Mapping[str, Any]


def next_steps(
    study: Study,
    found: Iterable[Light],
    ready: Iterable[Use],
    alternatives: list[dict[str, Any]],
    rival: Comparison | None,
) -> list[Step]:
    """The steps in the order in which they are worth the effort; at least one.

    Parameters
    ----------
    study : Study
        The study.
    found, ready
        See `retwin.report.lights`.
    alternatives : list of dict
        Sources that detect more, the best one first.
    rival : Comparison, optional
        The comparison of the source with the best mean with the updated twin.

    """
    results = study.results
    lights = {each.key: each for each in found}
    steps = []
    if not results.classes and rival is not None:
        own, theirs = (results.sources[name].mean(rival.metric) for name in (rival.b, rival.a))
        values = {"source": rival.a, "metric": rival.metric, "own": own, "theirs": theirs}
        steps.append(Step("other", values))
    elif results.classes and alternatives:
        best = alternatives[0]
        detected = best["decision"].detected
        steps.append(Step("other", {"source": best["source"], "detected": detected}))
    worse = lights["error"].state == "not met"
    if worse or lights["realism"].state == "not met":
        steps.append(Step("correction", {"worse": worse}))
    recorded = _record(study, lights)
    if recorded is not None:
        steps.append(recorded)
    if results.runs < MIN_RUNS:
        steps.append(Step("repeat", {}))
    if results.emulated:
        steps.append(Step("real", {}))
    if not steps and all(each.state == "met" for each in ready):
        steps.append(Step("use", {}))
    return steps or [Step("record", {"now": results.data.test.size, "alarms": None, "error": None})]


def _record(study: Study, lights: Mapping[str, Light]) -> Step | None:
    """How many healthy trajectories decide what is undecided; None where more decide nothing.

    Where none is healthy, some are needed.
    """
    test = study.results.data.test
    now = int(study.healthy.sum()) if study.results.classes else test.size
    chosen: Alarms | None = None
    if "false_alarms" in lights:
        chosen = lights["false_alarms"].values["alarms"]
    alarms = chosen.needed if chosen is not None and not chosen.certain else None
    change: ErrorChange | None = lights["error"].values["change"]
    error = None
    if lights["error"].state == "undecided" and change is not None and study.results.classes:
        error = needed_to_decide(change)
    undecided = any(each.state == "undecided" for each in lights.values())
    if now and not (alarms or error or undecided):
        return None
    rate = chosen.rate if chosen is not None and math.isfinite(chosen.rate) else None
    return Step("record", {"now": now, "alarms": alarms, "rate": rate, "error": error})
