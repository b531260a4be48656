"""What users decide on: the lights, and what the updated twin is ready for.

One rule holds for every light (`retwin.scores.comparison.compliance`): it is met if the whole 95 %
interval lies within the requirement, not met if nothing of it does, and undecided otherwise. A use
is as ready as the worst of its lights, and the verdict as good as the worst of all.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from retwin.catalog import METRICS
from retwin.data.trajectories import HEALTHY
from retwin.report.labels import quantity
from retwin.report.study import Study
from retwin.report.verdict import decisive, headline
from retwin.scores.change import ErrorChange, error_change
from retwin.scores.comparison import MIN_RUNS, compliance
from retwin.scores.decisions import (
    Decision,
    certain_decision,
    detection_difference,
    healthy_needed,
)

RATES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
"""False-alarm rates that the page shows."""
RATE = 0.05
"""The false-alarm rate that the page chooses, the next one of `RATES` if it cannot be promised."""
DETECTION = 0.8
"""The required share of faults that are detected."""
COVERAGE = (0.85, 0.95)
"""The required coverage of the 90 % band."""
RECOGNISED = 0.75
"""The largest AUROC at which a classifier may tell real from generated trajectories."""
STATES = ("met", "undecided", "not measured", "not met")
"""From the best to the worst."""
NOISELESS = 0.1
"""The share of the measured noise below which generated noise is reported as missing."""


@dataclass(frozen=True)
class Light:
    """A requirement and what was measured of it.

    Attributes
    ----------
    key : str
        Its name in the template `lights.html.j2`.
    state : str
        One of `STATES`.
    values : mapping of str to Any
        The variables of its sentences.

    """

    key: str
    state: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Use:
    """What the updated twin may serve for: its name in the templates, state, and conditions."""

    key: str
    state: str
    conditions: Mapping[str, str]


@dataclass(frozen=True)
class Alarms:
    """The decision at the rate that the page chooses.

    Attributes
    ----------
    rate : float
        The chosen false-alarm rate; NaN if the healthy trajectories promise none of `RATES`.
    decision : Decision
        None without a rate.
    certain : bool
        Whether its false-alarm rate is at most `rate` by its whole interval, or only on average.
    healthy, needed : int
        The healthy test trajectories, and how many of them make `rate` certain.

    """

    rate: float
    decision: Decision | None
    certain: bool
    healthy: int
    needed: int


def worst(states: Iterable[str]) -> str:
    """The worst of the states; "not measured" if there are none."""
    return max(states, key=STATES.index, default="not measured")


def lights(study: Study) -> list[Light]:
    """Error, false alarms, detection and realism of the updated twin; none without one."""
    pair = headline(study.results)
    if pair is None:
        return []
    found = [_error(study)]
    if study.results.classes:
        found += [_false_alarms(study, pair[0]), _detection(study, pair)]
    return [*found, _realism(study, pair[0])]


def uses(study: Study, found: Iterable[Light]) -> list[Use]:
    """Simulation, training data, alarms and bands, each with its conditions."""
    states = {each.key: each.state for each in found}
    if not states:
        return []
    needed: dict[str, dict[str, str]] = {"simulation": {"error": states["error"]}}
    if study.results.classes:
        rival = next(e.values["rival"] for e in found if e.key == "detection")
        needed["training"] = {
            "error": states["error"],
            "gain": _gain(study),
            "rival": "not met" if rival and rival["difference"][1][1] < 0 else "met",
        }
        needed["alarms"] = {key: states[key] for key in ("false_alarms", "detection")}
    needed["bands"] = {"realism": states["realism"]}
    return [Use(key, worst(parts.values()), parts) for key, parts in needed.items()]


def change_of(study: Study) -> tuple[ErrorChange, str] | None:
    """The error on healthy trajectories before and after the update, and its unit.

    It is the mean absolute error of the median of the draws, on the test trajectories; of a study
    without classes the root mean square error of the mean of the draws, as in its scores.

    Outputs of several units are divided by their standard deviation, and the unit is "σ".
    """
    pair, results = headline(study.results), study.results
    overlay = results.overlay
    if pair is None:
        return None
    shown = study.output_quantities
    units = {unit for _, unit in shown}
    portrait = study.portrait
    if overlay is None or overlay.source != pair[0] or not portrait:
        return _simulated_change(study, pair, units)
    healthy = study.healthy
    if not healthy.any():
        return None
    names = "nominal", "observed", "bands"
    nominal, observed, bands = (portrait[name][healthy].astype(float) for name in names)
    scale = np.array([factor for factor, _ in shown])
    if len(units) > 1:
        spread = np.nanstd(observed, axis=(0, 1))
        scale, units = 1 / np.where(spread > 0, spread, 1.0), {"σ"}
    found = error_change(nominal, bands[:, 2], observed, scale)
    return None if found is None else (found, next(iter(units), ""))


def _simulated_change(
    study: Study, pair: tuple[str, str], units: set[str]
) -> tuple[ErrorChange, str] | None:
    """From the scores of a study without classes, whose intervals may be over blocks."""
    results = study.results
    metric = "rmse" if len(units) <= 1 else "nrmse"
    after, before = (results.sources[name].mean(metric) for name in pair)
    compared = results.compared(*pair).get(metric)
    if not (math.isfinite(before) and math.isfinite(after)) or before <= 0:
        return None
    unit = results.outputs.units[0] if results.outputs.units and metric == "rmse" else ""
    factor, shown = quantity(unit) if metric == "rmse" else (1.0, "σ")
    ends = compared.interval if compared else None
    ratio = None if ends is None else (1 + ends[0] / before, 1 + ends[1] / before)
    found = ErrorChange(
        before=factor * before,
        after=factor * after,
        ratio=after / before,
        ratio_interval=ratio,
        outputs_before=np.array([factor * before]),
        outputs_after=np.array([factor * after]),
        trajectories=results.data.test.size,
    )
    return found, shown


def _error(study: Study) -> Light:
    found = change_of(study)
    if found is None:
        return Light("error", "not measured", {"change": None, "unit": ""})
    change, unit = found
    state = compliance(change.ratio, change.ratio_interval, 0.0, 1.0)
    return Light("error", state, {"change": change, "unit": unit})


def alarms(study: Study, source: str) -> Alarms | None:
    """The decision of a source at the rate that the page chooses; None without probabilities.

    A threshold belongs to one model, so it is that of the first run.
    """
    classes = study.results.classes
    if source not in study.diagnosing or HEALTHY not in classes:
        return None
    healthy = int(study.healthy.sum())
    if healthy in (0, len(study.truth)):
        return None
    first = study.probabilities(source)[0]
    for rate in (each for each in RATES if each >= RATE):
        safe = certain_decision(first, study.truth, classes, rate)
        found = safe or study.decision(source, rate)
        if math.isfinite(found.threshold):
            return Alarms(rate, found, safe is not None, healthy, healthy_needed(rate))
    return Alarms(math.nan, None, certain=False, healthy=healthy, needed=healthy_needed(RATE))


def _false_alarms(study: Study, source: str) -> Light:
    found = alarms(study, source)
    if found is None or found.decision is None:
        return Light("false_alarms", "not measured", {"alarms": found})
    decision = found.decision
    state = compliance(decision.guaranteed, decision.false_alarms, 0.0, found.rate * (1 + 1e-9))
    return Light("false_alarms", state, {"alarms": found})


def _detection(study: Study, pair: tuple[str, str]) -> Light:
    found = alarms(study, pair[0])
    values: dict[str, Any] = {"alarms": found, "required": DETECTION, "rival": None}
    if found is None or found.decision is None:
        return Light("detection", "not measured", values)
    decision = found.decision
    ends = decision.interval if found.certain else decision.at_rate
    values["ends"] = ends
    state = compliance(decision.detected, ends, DETECTION, 1.0)
    if pair[1] in study.diagnosing:
        own, other = (study.probabilities(name)[0] for name in pair)
        classes, rate = study.results.classes, decision.guaranteed
        difference = detection_difference(own, other, study.truth, classes, rate)
        plain = study.decision(pair[1], rate)
        if difference is not None:
            values["rival"] = {"difference": difference, "decision": plain, "source": pair[1]}
            state = "not met" if difference[1][1] < 0 else state
    return Light("detection", state, values)


def _realism(study: Study, source: str) -> Light:
    """The worst of the coverage of the 90 % band and of the classifier of real and generated."""
    fidelity, each = study.results.fidelity.get(source), study.results.sources[source]
    figures = fidelity.figures if fidelity else {}
    covered = figures.get("coverage90")
    value = covered.value if covered else each.mean("coverage90")
    ends = covered.ends if covered else each.interval("coverage90")
    parts = {"coverage": (value, ends, compliance(value, ends, *COVERAGE))}
    if "auroc" in figures:
        value, ends = figures["auroc"].value, figures["auroc"].ends
        # A certain answer has no spread over trajectories, so no interval.
        perfect = ends is None and value >= 1.0
        state = "not met" if perfect else compliance(value, ends, 0.0, RECOGNISED)
        parts["auroc"] = (value, ends, state)
    values = {"parts": parts, "coverage": COVERAGE, "recognised": RECOGNISED}
    state = worst(part[2] for part in parts.values())
    return Light("realism", state, {**values, "noiseless": _noiseless(study, source)})


def _noiseless(study: Study, source: str) -> list[str]:
    """The outputs at rest whose generated noise is far below the measured one."""
    missing = []
    for each in study.components(source):
        measured, drawn = (v[np.isfinite(v)] for v in (each.observed, each.predicted))
        if not each.name.startswith("noise_") or not len(measured) or not len(drawn):
            continue
        if all(mean(drawn) < NOISELESS * mean(measured) for mean in (np.median, np.mean)):
            missing.append(each.name.removeprefix("noise_"))
    return missing


def _gain(study: Study) -> str:
    """Whether a diagnoser trained on the updated twin is better than one on the plain twin."""
    pair = headline(study.results)
    each = decisive(study.results.compared(*pair)) if pair else None
    if each is None or each.interval is None:
        return "not measured"
    better = METRICS[each.metric].better
    ends = each.interval if better > 0 else (-each.interval[1], -each.interval[0])
    if study.results.runs < MIN_RUNS and ends[1] > 0:
        return "undecided"  # the interval does not contain the randomness of training
    return compliance(better * each.mean_diff, ends, np.nextafter(0.0, 1.0))


def better_alternatives(study: Study, found: Alarms | None, source: str) -> list[dict[str, Any]]:
    """Other sources on comparable data that detect more at the same rate, the best one first."""
    if found is None or found.decision is None:
        return []
    rate, unlike = found.decision.guaranteed, ("transductive", "labelled")
    names = [n for n in study.diagnosing if study.results.sources[n].real_data not in unlike]
    known = {name: study.decision(name, rate) for name in names if name != source}
    better = {name: each for name, each in known.items() if each.detected > found.decision.detected}
    ranked = sorted(better.items(), key=lambda pair: -pair[1].detected)
    return [{"source": name, "decision": each} for name, each in ranked]
