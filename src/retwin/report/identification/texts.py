"""Estimates and findings of an identification as text, for the page and the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from math import floor, isfinite, isnan, log10

from retwin.evaluation.identification import Direction, Identification, ParameterEstimate, RMSError
from retwin.evaluation.identification.parameters import WIDEST
from retwin.update.dynamics.windows import state_based
from retwin.update.identification.posterior import Posterior

WHITE = 0.01
"""p-value below which a residual is not taken for white noise, or depends on an input."""
SENTENCES = 4
"""Outputs that have a sentence of their own, at most."""
SMALL = 0.02
"""Ratio of errors below which a change in percent has decimals."""
SMALL_SHARE = 0.01
"""Share of a range below which it is given with more digits."""
ELSEWHERE = 2.0
"""Ratio of the errors at the begin of trajectories and later, from which it is named."""
STRONG = 0.95
"""Correlation of two estimates from which they are named."""
MISFIT = 0.02
"""Prior predictive p-value below which measurements do not fit the twin."""


def significant(number: float, like: float | None = None) -> str:
    """A number with four digits, or with as many decimals as two digits of `like` have."""
    if not isfinite(number):
        return "–"
    if like is None or not isfinite(like) or like <= 0:
        return f"{number:.4g}".replace("-", "−")
    decimals = 1 - floor(log10(like))
    if decimals > 8 or abs(number) >= 1e6:
        return f"{number:.4g}".replace("-", "−")
    return f"{number:.{max(decimals, 0)}f}".replace("-", "−")


def value(each: ParameterEstimate) -> str:
    """`0.646 ± 0.012`; the value alone where there is no error."""
    if not isfinite(each.error) or each.error == 0:
        return significant(each.value)
    return f"{significant(each.value, each.error)} ± {significant(each.error, each.error)}"


def interval(each: ParameterEstimate) -> str:
    """`0.62 to 0.67`, or that it is wider than the range."""
    if each.interval is None:
        return "–"
    low, high = each.interval
    if low <= each.low and high >= each.high:
        return "wider than the range"
    return f"{significant(low, high - low)} to {significant(high, high - low)}"


def state(each: ParameterEstimate) -> str:
    """What is wrong with an estimate; "" if nothing is."""
    if each.at_bound:
        return "at its lower bound" if each.at_bound == "low" else "at its upper bound"
    if each.identified:
        return ""
    if each.depends:
        return "depends on the bound of another parameter"
    if each.covered is None:
        return "not identified"
    if each.covered <= WIDEST and not each.leaves:
        return "not identified: other starts of the search fit as well elsewhere"
    leaves = " and leaves it" if each.leaves else ""
    return f"not identified: interval covers {_share(each.covered)} of the range{leaves}"


def _share(share: float) -> str:
    """`38 %`; below one percent with a digit."""
    return f"{100 * share:.2g} %" if share < SMALL_SHARE else f"{100 * share:.0f} %"


def combination(direction: Direction) -> str:
    """`+0.77 gain −0.64 leak`, in widths of the ranges."""
    return " ".join(
        f"{size:+.2f} {name}".replace("-", "−") for name, size in direction.components.items()
    )


def change(error: RMSError, *, interval: bool = True) -> str:
    """`−86 % (95 % interval −91 to −80)`, or without its interval."""
    if not isfinite(error.ratio):
        return "–"
    ends = [error.ratio, *(error.interval or ())]
    shown = list(map(percent, ends))
    inside = f" (95 % interval {shown[1]} to {shown[2]})" if error.interval and interval else ""
    return f"{shown[0]} %{inside}"


def percent(ratio: float) -> str:
    """`−86` for a ratio of 0.14; with two decimals where little is left."""
    return f"{100 * (ratio - 1):+.{2 if ratio < SMALL else 0}f}".replace("-", "−")


def findings(found: Identification) -> list[str]:
    """What a reader must know, in sentences, the most important first."""
    parts = (_errors, _horizon, _begins, _open, _residuals, _limits)
    return [sentence for each in parts for sentence in each(found)]


def next_steps(found: Identification) -> list[str]:
    """What to do next, by names in the template: what is most worth the effort first."""
    errors = found.errors(found.compared).values()
    worse = any(each.ratio >= 1 or (each.interval or (0, 0))[1] >= 1 for each in errors)
    lacks = any(
        each.p_white < WHITE or any(test.p_value < WHITE for test in each.inputs)
        for each in found.residuals
    )
    unsettled = bool(found.open_parameters) or any(each.at_bound for each in found.parameters)
    needed = {
        "settle": unsettled,
        "hold_out": found.compared != "validation",
        "correct": lacks,
        "check": worse,
    }
    return [name for name, holds in needed.items() if holds] or ["use"]


def _errors(found: Identification) -> Iterator[str]:
    """The error before and after."""
    part = found.compared
    where = "On held-out measurements" if part == "validation" else "On the measurements used"
    errors = list(found.errors(part).items())
    units = {each.name: each.unit for each in found.outputs}
    means = {each.name: each.mean for each in found.outputs}
    simulated = "in free simulation"
    if isfinite(found.horizon):
        simulated = f"over {found.horizon:.3g} s from estimated starts"
    for name, each in errors[:SENTENCES]:
        unit = "" if units[name] == "1" else f" {units[name]}"
        went = "went"
        if each.interval is not None:
            went = "fell" if each.interval[1] < 1 else "rose" if each.interval[0] > 1 else "went"
        mean = means[name]
        compared = f"the record's mean alone has {significant(mean)}{unit}"
        if each.after > mean:
            compared = f"worse than the record's mean, which has {significant(mean)}{unit}"
        yield (
            f"{where}, the RMS error of {name} {simulated} {went} from "
            f"{significant(each.before)} to {significant(each.after)}{unit}: {change(each)}; "
            f"{compared}."
        )
    if len(errors) > SENTENCES:
        better = sum(each.ratio < 1 for _, each in errors)
        yield f"It is smaller for {better} of {len(errors)} outputs."
    undecided = [n for n, e in errors if e.interval and e.interval[0] <= 1 <= e.interval[1]]
    if undecided:
        yield f"No change of the error can be shown for {', '.join(undecided)}."
    if part == "identification":
        yield (
            "Nothing was held out: these errors are of the measurements that the parameters were "
            "fitted to, and smaller than those of others."
        )


def _horizon(found: Identification) -> Iterator[str]:
    """Over which time parameters were fitted, and why; what would be needed where it matters."""
    result = found.found
    if isinstance(result, Posterior):
        return
    free = next((each.error for each in result.horizons if each.length is None), None)
    if isfinite(result.horizon):
        why = "as was asked for"
        if result.horizons:
            why = (
                "since the effects of a start last until the end of the record, as in integrating "
            )
            why += "and unstable plants, where errors grow with time"
        yield (
            f"The parameters were fitted in windows of {result.horizon:.3g} s whose starts were "
            f"estimated, {why}."
        )
        if result.horizons and free is None:
            yield "A simulation of the whole record fails."
        elif free is not None and isfinite(free):
            yield (
                "With parameters that were fitted to whole records, errors of predictions of parts "
                f"left out are {free:.3g} times as large."
            )
    elif len(result.horizons) > 1:
        yield (
            "Effects of a start last until the end of the record, as in integrating and unstable "
            "plants. Whole records were used, since parameters fitted in windows, whose starts "
            "are estimated, predict parts left out no better."
        )
    elif result.lasting and not state_based(found.twin):
        yield (
            "Effects of early commands last until the end of the record, as in integrating and "
            "unstable plants, where errors of the start and of disturbances grow with time and "
            "decide the parameters. Windows whose starts are estimated would avoid that, but the "
            "states of this twin cannot be set: write its equations as a StateTwin, or give short "
            "records that begin as the twin does."
        )


def _begins(found: Identification) -> Iterator[str]:
    """Whether trajectories begin in another state than simulations."""
    larger = {name: ratio for name, ratio in found.begin_errors.items() if ratio > ELSEWHERE}
    if larger:
        shown = ", ".join(f"{name} ({ratio:.1f} times)" for name, ratio in larger.items())
        yield (
            f"The error is larger in the first tenth of the trajectories than later: {shown}. "
            "Probably the system did not begin in the state in which the twin starts, as after a "
            "pause of the log: leave that time out (--transient), or free the start of the state, "
            "which is then one for all trajectories."
        )


def _open(found: Identification) -> Iterator[str]:
    """What the measurements leave open."""
    unknown = [
        each for each in found.parameters if not (each.identified or each.at_bound or each.depends)
    ]
    if unknown:
        last = found.directions[-1]
        combined = (
            f" The least determined combination is {combination(last)}, in widths of the ranges: "
            "hold one of these parameters at a known value, or record commands that separate them."
        )
        listed = ", ".join(each.name for each in unknown)
        yield f"These measurements do not determine {listed}.{combined if last.open else ''}"
    yield from filter(None, map(_not_apart, unknown))
    for each in found.parameters:
        if each.at_bound:
            bound = each.low if each.at_bound == "low" else each.high
            yield (
                f"{each.name} lies at its {'lower' if each.at_bound == 'low' else 'upper'} bound, "
                f"{significant(bound)}; the true value may lie beyond it, so no error is given. "
                "Widen its range if that is possible."
                if not isinstance(found.found, Posterior)
                else f"The posterior of {each.name} has its mass at its "
                f"{'lower' if each.at_bound == 'low' else 'upper'} bound, {significant(bound)}."
            )
    depending = [each.name for each in found.parameters if each.depends]
    if depending:
        yield (
            f"The values of {', '.join(depending)} depend on that bound, beyond which others "
            "fit better: they are right only if the bound is the true value."
        )
    names = [each.name for each in found.parameters]
    strong = [
        f"{names[j]} and {names[i]} ({found.correlation[i, j]:+.2f})".replace("-", "−")
        for i in range(len(names))
        for j in range(i)
        if abs(found.correlation[i, j]) > STRONG
    ]
    if strong:
        yield f"Estimates that are strongly correlated: {', '.join(strong[:SENTENCES])}."


def _not_apart(each: ParameterEstimate) -> str:
    """From which end of its range a parameter is not shown to differ; "" if it is from both."""
    if each.interval is None or not each.leaves or each.covered == 1:
        return ""
    at_end = f"{significant(each.high)}, at which its range ends"
    if each.interval[0] <= each.low:
        at_end = f"{significant(each.low)}, at which its range begins"
    shown = interval(each)
    return f"The 95 % interval of {each.name} is {shown}: it is not shown to differ from {at_end}."


def _residuals(found: Identification) -> Iterator[str]:
    """What the residuals show."""
    coloured = [each.name for each in found.residuals if each.p_white < WHITE]
    if coloured:
        yield (
            f"The residuals of {', '.join(coloured)} are not white noise (Ljung and Box, p below "
            f"{WHITE:g}): noise of the measurements alone does not explain them."
        )
    driven = [
        f"{each.name} on {test.name}"
        for each in found.residuals
        for test in each.inputs
        if test.p_value < WHITE
    ]
    if driven:
        yield (
            f"Residuals depend on commands ({', '.join(driven[: 2 * SENTENCES])}): the twin lacks "
            "dynamics that no value of these parameters gives it."
        )


def _limits(found: Identification) -> Iterator[str]:
    """Limits of the errors, and of the search."""
    if found.basis == "samples":
        yield (
            "Standard errors take the residuals for noise that is correlated from one sample to "
            "the next (a first-order autoregression), or within eight blocks of time, whichever is "
            "wider, since there are fewer than three trajectories, or one of them alone determines "
            "a parameter."
        )
    result = found.found
    if isinstance(result, Posterior):
        if result.misspecified < MISFIT:
            yield (
                "No parameters and noise within the prior give such measurements (prior "
                f"predictive p-value {result.misspecified:.2g}): the twin lacks something."
            )
        return
    agreeing, starts = int(result.figures["starts_agreeing"]), len(result.starts)
    if starts > 1 and agreeing < 2:
        yield (
            f"Only one of {starts} starts of the search found this optimum: a better one may "
            "exist. More starts cost little."
        )
    if any(isnan(each.error) and not each.at_bound for each in found.parameters):
        yield "Some standard errors cannot be given."
