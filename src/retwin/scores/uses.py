"""What an updated twin may be used for: four uses, one rule, computed from a study's results.

Each use has requirements, and its answer is the worst of theirs (`answer_of`). The best source by
its mean is shown beside the original twin on the same test trajectories; the intervals do not
contain that choice, nor, of a single trained model, the randomness of training.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.catalog import SOURCES
from retwin.data.trajectories import HEALTHY
from retwin.results import Figure, Missing, Results, Use
from retwin.scores.bootstrap import MIN_RECORDS
from retwin.scores.change import ErrorChange, error_change, needed_to_decide
from retwin.scores.comparison import MIN_RUNS, alike, outcome
from retwin.scores.decisions import certain_decision, healthy_needed
from retwin.scores.intervals import MIN_GROUPS, share_interval

RATE = 0.05
"""The largest share of healthy runs that may be called faulty."""
DETECTION = 0.8
"""The smallest share of faulty runs that must be detected, and for a diagnosis be named."""
COVERAGE = (0.85, 0.95)
"""The required coverage of the 90 % band."""
ANSWERS = ("yes", "likely", "cannot say", "no")
"""From the best to the worst."""
MAX_RUNS = 100_000
"""The number of runs beyond which a search for a sufficient one ends."""

Arrays = Mapping[str, NDArray]


@dataclass(frozen=True)
class Requirement:
    """What was measured, and the range in which it must lie.

    Attributes
    ----------
    value : float
        NaN where it was not measured.
    interval : (float, float) or None
        Its 95 % interval.
    low, high : float
        The ends of the required range.
    informative : bool
        Whether so many runs could decide at all, if all of them were as required.
    whole : bool
        Whether the interval contains all randomness, that of training and of records included.

    """

    value: float
    interval: tuple[float, float] | None
    low: float
    high: float = math.inf
    informative: bool = True
    whole: bool = True


def answer_of(it: Requirement) -> str:
    """The one rule: "yes" and "no" need a whole interval within or outside the required range.

    "likely" is a value in the range whose interval reaches beyond it; "cannot say" everything else:
    not measured, too few runs to decide, or a value outside whose interval reaches into the range.
    """
    if math.isnan(it.value) or it.interval is None:
        return "cannot say"
    low, high = it.interval
    if high < it.low or low > it.high:
        return "no"
    if it.low <= low and high <= it.high:
        return "yes" if it.whole else "likely"
    return "likely" if it.informative and it.low <= it.value <= it.high else "cannot say"


def uses_of(results: Results, arrays: Arrays) -> list[Use]:
    """The four uses in a fixed order: simulate, training, diagnose, monitor.

    Parameters
    ----------
    results : Results
        The contents of `results.json`; its `uses` are not read.
    arrays : mapping of str to array
        The contents of `arrays.npz`; what needs a missing one counts as not measured.

    """
    simulate = _simulate(results, arrays)
    if HEALTHY in results.classes:
        diagnoses = _Diagnoses(results, arrays)
        others = [_training(diagnoses), _diagnose(diagnoses), _monitor(diagnoses)]
    else:
        bands = _bands(results, simulate.source)
        states = [simulate.answer, bands.answer]
        faults = Missing(what="faults")
        training = bands.with_values(use="training", answer=max(states, key=ANSWERS.index))
        worst = training.missing or simulate.missing
        others = [
            training.with_values(missing=None if training.answer == "yes" else worst),
            Use(use="diagnose", answer="cannot say", missing=faults),
            bands.with_values(use="monitor", answer=_at_best_unknown(bands), missing=faults),
        ]
    return [_on_emulated(each, emulated=results.emulated) for each in (simulate, *others)]


def _at_best_unknown(use: Use) -> str:
    return "no" if use.answer == "no" else "cannot say"


def _on_emulated(use: Use, *, emulated: bool) -> Use:
    """What is right on emulated data lacks the same on real ones."""
    lacking = emulated and use.answer == "yes" and use.missing is None
    return use.with_values(missing=Missing(what="real")) if lacking else use


def truth_of(results: Results) -> NDArray:
    """Class indices of the test trajectories, shape (n,)."""
    return np.array([results.classes.index(label) for label in results.data.test.labels], dtype=int)


def plain_source(results: Results) -> str:
    """The original twin of a study; "" without one."""
    return next((name for name in SOURCES if _is_plain(name) and name in results.sources), "")


def _is_plain(name: str) -> bool:
    return SOURCES[name].role == "plain"


# ---- simulate


def error_of(results: Results, arrays: Arrays) -> tuple[ErrorChange, str, str] | None:
    """The error on test trajectories before and after the update, its unit, and the source.

    With classes it is the mean absolute error of the median of the draws, on the healthy ones;
    without, the root mean square error of the mean of the draws, as in the scores. Outputs of
    several units are divided by their standard deviation, and the unit is "σ".
    """
    if not results.classes:
        return _simulated_error(results)
    names = [f"portrait/{name}" for name in ("nominal", "observed", "bands")]
    if results.overlay is None or any(name not in arrays for name in names):
        return None
    healthy = np.array(results.data.test.labels)[results.overlaid] == HEALTHY
    if not healthy.any():
        return None
    nominal, observed, bands = (np.asarray(arrays[name])[healthy].astype(float) for name in names)
    units = set(results.outputs.units)
    scale, unit = np.ones(observed.shape[-1]), next(iter(units), "")
    if len(units) > 1:
        spread = np.nanstd(observed, axis=(0, 1))
        scale, unit = 1 / np.where(spread > 0, spread, 1.0), "σ"
    change = error_change(nominal, bands[:, 2], observed, scale)
    return None if change is None else (change, unit, results.overlay.source)


def _simulated_error(results: Results) -> tuple[ErrorChange, str, str] | None:
    """Of the best source of a study without classes, from its scores."""
    plain, metric = plain_source(results), "rmse"
    if len(set(results.outputs.units)) > 1:
        metric = "nrmse"
    means = {n: each.mean(metric) for n, each in results.sources.items() if n != plain}
    known = {name: mean for name, mean in means.items() if math.isfinite(mean)}
    before = results.sources[plain].mean(metric) if plain else math.nan
    if not known or not before > 0:
        return None
    best = min(known, key=lambda name: known[name])
    compared = results.compared(best, plain).get(metric)
    ends = compared.interval if compared else None
    change = ErrorChange(
        before=before,
        after=known[best],
        ratio=known[best] / before,
        ratio_interval=None if ends is None else (1 + ends[0] / before, 1 + ends[1] / before),
        outputs_before=np.array([before]),
        outputs_after=np.array([known[best]]),
        trajectories=results.data.test.size,
    )
    return change, (results.outputs.units or [""])[0] if metric == "rmse" else "σ", best


def _simulate(results: Results, arrays: Arrays) -> Use:
    measured = error_of(results, arrays)
    if measured is None:
        healthy = HEALTHY in results.data.test.labels
        what = "updated" if healthy else "healthy" if results.classes else "records"
        return Use(use="simulate", answer="cannot say", missing=Missing(what=what))
    change, unit, source = measured
    n, records = change.trajectories, not results.classes
    whole = not records or (n >= MIN_RECORDS and results.runs >= MIN_RUNS)
    answer = answer_of(Requirement(change.ratio, change.ratio_interval, 0.0, 1.0, whole=whole))
    missing = None
    if answer == "no":
        missing = Missing(what="correction")
    elif records and n < MIN_RECORDS:
        missing = Missing(what="records", count=MIN_RECORDS - n)
    elif answer != "yes" and not whole:
        missing = Missing(what="runs", count=MIN_RUNS)
    elif answer != "yes":
        needed = MIN_GROUPS if n < MIN_GROUPS else needed_to_decide(change)
        more = None if needed is None else needed - n
        missing = Missing(what="records" if records else "healthy", count=more)
    figures = {
        "error": Figure(value=change.after, plain=change.before, unit=unit, n=n),
        "ratio": Figure(value=change.ratio, interval=change.ratio_interval, n=n),
    }
    return Use(
        use="simulate",
        answer=answer,
        source=source,
        plain=plain_source(results),
        figures=figures,
        missing=missing,
    )


def _bands(results: Results, source: str) -> Use:
    """The coverage of the 90 % band of a study without classes."""
    scored = results.sources.get(source)
    value = scored.mean("coverage90") if scored else math.nan
    ends = scored.interval("coverage90") if scored else None
    n = results.data.test.size
    answer = answer_of(Requirement(value, ends, *COVERAGE, whole=n >= MIN_RECORDS))
    missing = None if answer == "yes" else Missing(what="records", count=max(MIN_RECORDS - n, 0))
    if answer == "no" or math.isnan(value):
        missing = Missing(what="correction")
    figures = {} if math.isnan(value) else {"coverage": Figure(value=value, interval=ends, n=n)}
    return Use(use="", answer=answer, source=source, figures=figures, missing=missing)


# ---- training data, diagnosis, alarms


@dataclass(frozen=True)
class _Diagnoses:
    """The diagnoses of a study with classes."""

    results: Results
    arrays: Arrays

    @property
    def plain(self) -> str:
        name = plain_source(self.results)
        return name if name in self.names() else ""

    def names(self, *, trained: bool = False) -> list[str]:
        """The sources on comparable data with diagnoses of every test run, in the catalog's order.

        With `trained`, those whose classifier is trained on generated trajectories.
        """
        sources = self.results.sources
        return [
            name
            for name in (*SOURCES, *(each for each in sources if each not in SOURCES))
            if name in sources
            and alike(sources[name].real_data, "none")
            and np.isfinite(self.probabilities(name)).all()
            and self.probabilities(name).size
            and (not trained or (name in SOURCES and bool(SOURCES[name].twin)))
        ]

    def probabilities(self, name: str) -> NDArray:
        """Shape (runs, n, classes); empty if there are none."""
        return np.asarray(self.arrays.get(f"probabilities/{name}", np.empty((0, 0))))

    @property
    def healthy(self) -> NDArray:
        return np.array(self.results.data.test.labels) == HEALTHY

    def shares(self, name: str) -> dict[str, float]:
        """Healthy runs called faulty, faulty ones found, and named: shares, the mean over runs."""
        truth, healthy = truth_of(self.results), self.healthy
        diagnoses = self.probabilities(name).argmax(axis=2)
        called = diagnoses != self.results.classes.index(HEALTHY)
        with np.errstate(invalid="ignore"):
            return {
                "called": float(called[:, healthy].sum() / called[:, healthy].size or 0.0)
                if healthy.any()
                else math.nan,
                "found": float(called[:, ~healthy].mean()) if not healthy.all() else math.nan,
                "named": float((diagnoses == truth)[:, ~healthy].mean())
                if not healthy.all()
                else math.nan,
            }

    def figures(self, name: str) -> dict[str, Figure]:
        """These shares with their intervals, beside those of the original twin."""
        shares, plain = self.shares(name), self.shares(self.plain) if self.plain else {}
        faulty = int((~self.healthy).sum())
        counts = {"called": int(self.healthy.sum()), "found": faulty, "named": faulty}
        return {
            key: Figure(
                value=value,
                interval=_share_interval(value, counts[key]),
                plain=plain.get(key, math.nan),
                n=counts[key],
            )
            for key, value in shares.items()
            if counts[key]
        }


def _share_interval(share: float, n: int) -> tuple[float, float] | None:
    return share_interval(share * n, n) if n and math.isfinite(share) else None


def _training(it: _Diagnoses) -> Use:
    """Whether a classifier that is trained on generated runs is better than on the original twin's.

    By macro-F1, in which false alarms and missed faults both count.
    """
    results = it.results
    names = [name for name in it.names(trained=True) if name != it.plain]
    if not names or not it.plain:
        return Use(use="training", answer="cannot say", missing=Missing(what="updated"))
    best = max(names, key=lambda name: results.sources[name].mean("macro_f1"))
    compared = results.compared(best, it.plain).get("macro_f1")
    whole = results.runs >= MIN_RUNS
    gain, ends = (compared.mean_diff, compared.interval) if compared else (math.nan, None)
    answer = answer_of(Requirement(gain, ends, math.nextafter(0.0, 1.0), whole=whole))
    if compared and whole and answer == "yes" and outcome(ends, compared.p_verdict, 1) == "open":
        answer = "likely"  # the p-value is adjusted over all pairs of sources
    missing = None
    if answer == "no":
        missing = Missing(what="correction")
    elif not whole:
        missing = Missing(what="runs", count=MIN_RUNS)
    elif answer != "yes":
        missing = Missing(what="test")
    scored = results.sources[best], results.sources[it.plain]
    score = Figure(
        value=scored[0].mean("macro_f1"),
        interval=scored[0].interval("macro_f1"),
        plain=scored[1].mean("macro_f1"),
        n=results.data.test.size,
    )
    figures = {"macro_f1": score, "gain": Figure(value=gain, interval=ends), **it.figures(best)}
    return Use(
        use="training", answer=answer, source=best, plain=it.plain, figures=figures, missing=missing
    )


def _diagnose(it: _Diagnoses) -> Use:
    """Whether healthy runs are called faulty rarely enough, and faults named often enough."""
    names = [name for name in it.names() if name != it.plain]
    if not names or not it.healthy.any() or it.healthy.all():
        what = "healthy" if names and not it.healthy.any() else "faults"
        return Use(use="diagnose", answer="cannot say", missing=Missing(what=what))
    best = max(names, key=lambda name: it.results.sources[name].mean("macro_f1"))
    figures = it.figures(best)
    ranges = {"called": (0.0, RATE), "named": (DETECTION, 1.0)}
    return _decided(Use(use="diagnose", answer="", source=best, plain=it.plain), figures, ranges)


def _monitor(it: _Diagnoses) -> Use:
    """Whether a threshold keeps false alarms at `RATE` for certain and detects enough.

    A threshold belongs to one model, so it is that of the first run.
    """
    results, truth, healthy = it.results, truth_of(it.results), int(it.healthy.sum())
    names = [name for name in it.names() if name != it.plain]
    if not names or healthy in (0, len(truth)):
        what = "faults" if healthy else "healthy"
        return Use(use="monitor", answer="cannot say", missing=Missing(what=what))
    if healthy < healthy_needed(RATE):
        more = Missing(what="healthy", count=healthy_needed(RATE) - healthy)
        few = {"alarms": Figure(value=math.nan, n=healthy)}
        return Use(use="monitor", answer="cannot say", figures=few, missing=more)
    decisions = {
        name: certain_decision(it.probabilities(name)[0], truth, results.classes, RATE)
        for name in (*names, *([it.plain] if it.plain else []))
    }
    detected = {name: each.detected for name, each in decisions.items() if each is not None}
    best = max(names, key=lambda name: detected[name])
    chosen = decisions[best]
    assert chosen is not None
    plain = detected.get(it.plain, math.nan)
    figures = {
        "alarms": Figure(value=chosen.guaranteed, interval=chosen.false_alarms, n=healthy),
        "detected": Figure(
            value=chosen.detected, interval=chosen.interval, plain=plain, n=len(truth) - healthy
        ),
    }
    use = Use(use="monitor", answer="", source=best, plain=it.plain)
    return _decided(use, figures, {"detected": (DETECTION, 1.0)})


def _decided(
    use: Use, figures: Mapping[str, Figure], ranges: Mapping[str, tuple[float, float]]
) -> Use:
    """The use with the worst answer of its shares, and what is missing for that one."""
    found: list[tuple[str, Missing | None]] = []
    for key, (low, high) in ranges.items():
        it = figures[key]
        interval = it.ends
        best = 1.0 if low else 0.0
        fewest = _fewest(best, low, high)
        informative = it.n >= fewest
        asked = Requirement(it.value, interval, low, high, informative)
        answer, missing = answer_of(asked), None
        if answer == "no":
            missing = Missing(what="source")
        elif answer != "yes":
            needed = _fewest(it.value, low, high)
            if not informative:  # the further ones may all be right
                needed = _fewest(best, low, high, abs(it.value - best) * it.n)
            more = max(needed, fewest) - it.n
            what = "healthy" if key == "called" else "faulty"
            missing = Missing(what=what, count=more) if more else Missing(what="source")
        found.append((answer, missing))
    answer, missing = max(found, key=lambda each: ANSWERS.index(each[0]))
    return use.with_values(answer=answer, figures=dict(figures), missing=missing)


def _fewest(share: float, low: float, high: float, errors: float = 0.0) -> int:
    """The smallest number of runs whose interval lies in the range if the share is this one.

    With `errors`, if so many runs are errors, however many there are. 0 if none does.
    """
    if not low <= share <= high:
        return 0
    sign = -1 if low else 1

    def decides(n: int) -> bool:
        ends = share_interval(min(max(share * n + sign * errors, 0), n), n)
        return low <= ends[0] and ends[1] <= high * (1 + 1e-9)

    top = next((n for n in _powers() if decides(n)), 0)
    bottom = top // 2
    while top - bottom > 1:
        middle = (top + bottom) // 2
        bottom, top = (bottom, middle) if decides(middle) else (middle, top)
    return top


def _powers() -> Iterable[int]:
    return (2**k for k in range(int(math.log2(MAX_RUNS)) + 1))
