"""Estimates and findings of an identification as text, for the page and the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, isnan

from retwin.cases.matching import CONSTANT
from retwin.evaluation.identification.parameters import WIDEST, Direction, ParameterEstimate
from retwin.evaluation.identification.validation import Identification, RMSError
from retwin.report.assets import sentences
from retwin.report.labels import behind, signed, significant
from retwin.update.dynamics.windows import state_based
from retwin.update.forecasts import BEGIN
from retwin.update.identification.posterior import Posterior

WHITE = 0.01
"""p-value below which a residual is not taken for white noise, or depends on an input."""
MATERIAL = 0.1
"""Correlation of residuals below which it changes hardly anything, however sure it is."""
SENTENCES = 4
"""Outputs that have a sentence of their own, at most."""
OWN_START = "mean of the records"
"""What a start is of which each record has its own."""


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
    if each.own:
        return OWN_START
    if each.at_bound:
        return "at its lower bound" if each.at_bound == "low" else "at its upper bound"
    if each.identified:
        return ""
    if each.depends:
        return "depends on the bound of another parameter"
    if each.covered is None:
        return "not identified"
    if each.covered <= WIDEST:
        return (
            "not identified: its interval reaches an end of its range"
            if each.leaves
            else "not identified: another optimum of the search fits as well"
        )
    leaves = " and leaves it" if each.leaves else ""
    return f"not identified: interval covers {_share(each.covered)} of the range{leaves}"


def _share(share: float, *, small_share: float = 0.01) -> str:
    """`38 %`; below one percent with a digit.

    Parameters
    ----------
    small_share : float, default 0.01
        Share of a range below which it is given with more digits.

    """
    return f"{100 * share:.2g} %" if share < small_share else f"{100 * share:.0f} %"


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
    # Ratio of errors below which a change in percent has decimals.
    return f"{100 * (ratio - 1):+.{2 if ratio < 0.02 else 0}f}".replace("-", "−")


def interval_remark(found: Identification) -> str:
    """What intervals leave out where the residuals show that the twin lacks something; else ""."""
    if not (_coloured(found) or _driven(found)):
        return ""
    return (
        "The intervals are those of the values that fit this twin best: physical values may lie "
        "outside, since it does not fit the data (see the residuals)."
    )


def _coloured(found: Identification) -> list[str]:
    """Outputs whose residuals are not white."""
    return [
        each.name
        for each in found.residuals
        if each.p_white < WHITE and abs(each.first_correlation) > MATERIAL
    ]


def _driven(found: Identification) -> list[str]:
    """Residuals and the commands on which they depend."""
    return [
        f"{each.name} on {test.name}"
        for each in found.residuals
        for test in each.inputs
        if test.p_value < WHITE and abs(test.correlation) > MATERIAL
    ]


def findings(found: Identification, notes: Sequence[str] = ()) -> list[str]:
    """What a reader must know, in sentences, the most important first.

    Parameters
    ----------
    found : Identification
        The result.
    notes : sequence of str
        Of the logs, of which those are taken that say that a log shows nothing.

    """
    result, names = found.found, [each.name for each in found.parameters]
    errors = list(found.errors(found.compared).items())
    posterior = isinstance(result, Posterior)
    horizons = () if isinstance(result, Posterior) else result.horizons
    pairs = [
        (names[j], names[i], found.correlation[i, j]) for i in range(len(names)) for j in range(i)
    ]
    # Correlation of two estimates from which they are named.
    strong = [f"{a} and {b} ({signed(r, 2)})" for a, b, r in pairs if abs(r) > 0.95]
    means = {each.name: each.mean for each in found.outputs}
    unknown = [p for p in found.parameters if not (p.identified or p.at_bound or p.depends)]
    measured = found.simulated["identification"][0]
    # Ratio of the errors at the begin of trajectories and later, from which it is named.
    # Prior predictive p-value below which measurements do not fit the twin.
    return sentences(
        "findings",
        found=found,
        result=result,
        change=change,
        combination=combination,
        interval=interval,
        posterior=posterior,
        free=not isfinite(found.horizon),
        errors=errors,
        some=SENTENCES,
        better=sum(each.ratio < 1 for _, each in errors),
        undecided=[n for n, e in errors if e.interval and e.interval[0] <= 1 <= e.interval[1]],
        units={each.name: behind("", each.unit) for each in found.outputs},
        means=means,
        nothing=[each for each in notes if each.endswith(CONSTANT)],
        bounds=[each for each in found.parameters if each.at_bound],
        worse=[name for name, each in errors if each.after >= means[name]],
        whole=next((each.error for each in horizons if each.length is None), None),
        settable=state_based(found.twin),
        larger=[pair for pair in found.begin_errors.items() if pair[1] > 2.0],
        tenth=float(f"{measured.lengths.max() / measured.rate / BEGIN:.2g}"),
        started=any(each.name.startswith("start_") for each in found.parameters),
        own=[each.name for each in found.parameters if each.own],
        unknown=unknown,
        undetermined=[p for p in unknown if p.covered is None or p.covered > WIDEST],
        elsewhere=[
            each.name
            for each in unknown
            if each.covered is not None and each.covered <= WIDEST and not each.leaves
        ],
        depending=[each.name for each in found.parameters if each.depends],
        strong=strong[:SENTENCES],
        coloured=_coloured(found),
        white=WHITE,
        driven=_driven(found)[: 2 * SENTENCES],
        misfit=0.02,
        without_error=any(isnan(p.error) and not p.at_bound for p in found.parameters),
    )


def next_steps(found: Identification) -> list[str]:
    """What to do next, by names in the template: what is most worth the effort first."""
    errors = found.errors(found.compared).values()
    worse = any(each.ratio >= 1 or (each.interval or (0, 0))[1] >= 1 for each in errors)
    unsettled = bool(found.open_parameters) or any(each.at_bound for each in found.parameters)
    needed = {
        "settle": unsettled,
        "hold_out": found.compared != "validation",
        "correct": bool(interval_remark(found)),
        "check": worse,
    }
    return [name for name, holds in needed.items() if holds] or ["use"]
