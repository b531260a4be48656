"""What the scores say: the verdict, Table 1 beside the paper's numbers, the comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from retwin.report.blocks import Block, Cell, Column, Forest, Prose, Section, Table
from retwin.report.curves import ece_floor
from retwin.report.plots import scores_plot
from retwin.report.results import Comparison, Results
from retwin.report.words import (
    MANY,
    METRICS,
    counted,
    in_sentence,
    mean_and_spread,
    number,
    order,
    p_value,
    real_data,
    signed,
    slot,
    source_name,
    span,
)

__all__ = ["comparisons", "further_scores", "headline", "outcome", "scores", "verdict"]

MAIN = ("macro_f1", "balanced_accuracy", "auroc", "healthy_recall", "rmse", "nrmse", "crps")
AGAINST = ("dt", "ibg_rg_command")
"""Of many sources, those that the others are held against."""
MORE = ("accuracy", "auroc_micro", "ece", "ece_classwise", "coverage50", "coverage90")


def outcome(comparison: Comparison) -> str:
    """`better` or `worse` when the interval leaves zero out, `open` when not, else nothing."""
    interval = comparison.interval
    direction = METRICS[comparison.metric].better if comparison.metric in METRICS else 0
    if interval is None or direction == 0:
        return ""
    if interval[0] <= 0 <= interval[1]:
        return "open"
    return "better" if (interval[0] > 0) == (direction > 0) else "worse"


def verdict(results: Results) -> list[str]:
    """Up to three plain sentences; "better" only where the bootstrap interval leaves zero out."""
    pair = headline(results.comparisons)
    if pair is None:
        return []
    found = {each.metric: each for each in _between(results.comparisons, *pair)}
    metric = next((name for name in METRICS if name in found and outcome(found[name])), None)
    if metric is None:
        return []
    sentences = [_first(results, found[metric])]
    others = [each for name, each in found.items() if name in MAIN and name != metric]
    sentences += _second(others)
    rival = _leading(results, metric, pair)
    if rival is not None:
        sentences.append(rival)
    alone = _between(results.comparisons, pair[0], "ibg")
    sentences += [_third(each) for each in alone if each.metric == metric and outcome(each)]
    return sentences[:3]


def _leading(results: Results, metric: str, pair: tuple[str, str]) -> str | None:
    """Which other source has the best mean, if any is ahead of the headline's."""
    best = max(results.sources, key=lambda name: _rank(results, name, metric))
    if best in pair or _rank(results, best, metric) <= _rank(results, pair[0], metric):
        return None
    found = [e for e in _between(results.comparisons, best, pair[0]) if e.metric == metric]
    if not found:
        return None
    gap = f"{signed(found[0].mean_diff)}, 95 % interval {span(found[0].interval, sign=True)}"
    sure = "is ahead" if outcome(found[0]) == "better" else "has the best mean, undecided"
    return (
        f"Of all sources, {in_sentence(source_name(best))} {sure}: "
        f"{in_sentence(METRICS[metric].name)} {number(results.sources[best].mean(metric))} ({gap})."
    )


def _rank(results: Results, source: str, metric: str) -> float:
    """The more, the better; a target to meet ranks nobody."""
    value = METRICS[metric].better * results.sources[source].mean(metric)
    return value if np.isfinite(value) else -np.inf


def headline(found: Sequence[Comparison]) -> tuple[str, str] | None:
    """The updated twin against the plain one, else the first pair in the file."""
    for updated, plain in product(("ibg_rg_command", "ibg_rg"), ("dt", "twin")):
        if _between(found, updated, plain):
            return updated, plain
    return (found[0].a, found[0].b) if found else None


def _between(found: Sequence[Comparison], a: str, b: str) -> list[Comparison]:
    return [each.seen_from(a) for each in found if {each.a, each.b} == {a, b}]


def _first(results: Results, found: Comparison) -> str:
    a, b = (in_sentence(source_name(each)) for each in (found.a, found.b))
    means = [
        number(results.sources[each].mean(found.metric)) if each in results.sources else "–"
        for each in (found.a, found.b)
    ]
    count = results.data.test.n or len(results.data.test.labels)
    on = counted(count, "test trajectory") if count else "the test trajectories"
    what = f"{in_sentence(METRICS[found.metric].name)} {means[0]} against {means[1]}"
    difference = (
        f"difference {signed(found.mean_diff)}, 95 % interval {span(found.interval, sign=True)}"
    )
    result = outcome(found)
    doing, by = ("training", "on") if results.classes else ("simulation", "by")
    if result == "open":
        return (
            f"On {on}, {doing} {by} {a} cannot be told apart from {doing} {by} {b}: {what}, "
            f"and the interval of the difference includes zero ({difference})."
        )
    return f"On {on}, {doing} {by} {a} is {result} than {by} {b}: {what} ({difference})."


def _second(found: Sequence[Comparison]) -> list[str]:
    """The other main scores of the same pair, grouped by what their intervals say."""
    said = []
    for result, words in (("better", "also better"), ("worse", "worse"), ("open", "undecided")):
        each = [
            f"{in_sentence(METRICS[one.metric].name)} "
            f"({signed(one.mean_diff)}, {span(one.interval, sign=True)})"
            for one in found
            if outcome(one) == result
        ]
        if each:
            said.append(f"{words}: {', '.join(each)}")
    text = "; ".join(said)
    return [f"{text[0].upper()}{text[1:]}."] if text else []


def _third(found: Comparison) -> str:
    """What the residual model adds to the surrogate alone."""
    meaning = {
        "better": "so the residual model itself helps",
        "worse": "so the residual model itself does harm",
        "open": "so it is not shown that the residual model itself helps",
    }[outcome(found)]
    name = in_sentence(METRICS[found.metric].name)
    gap = f"{signed(found.mean_diff)} ({span(found.interval, sign=True)})"
    return (
        f"Against {in_sentence(source_name('ibg'))}, given the same commands, the "
        f"difference in {name} is {gap}, {meaning}."
    )


def scores(results: Results) -> Section | None:
    """Table 1 beside the paper's, and the same as a picture."""
    table = _score_table(results, MAIN)
    if table is None:
        return None
    blocks: list = [table]
    drawn = MAIN if len(results.sources) <= MANY else ("macro_f1", "healthy_recall", *MAIN[4:])
    picture = scores_plot(results, [name for name in drawn if _has(results, name)])
    if picture is not None:
        blocks.append(picture)
    return Section("scores", "Scores", blocks)


def _score_table(results: Results, metrics: Sequence[str]) -> Table | None:
    shown = [name for name in metrics if _has(results, name)]
    if not shown:
        return None
    columns = [Column("Training data" if results.classes else "Source", numeric=False)]
    paper = any(_in_paper(results, name) for name in shown)
    for name in shown:
        columns += _score_columns(results, name, paper)
    best = {name: _best(results, name) for name in shown}
    word = "emulated" if results.emulated else "real"
    rows = []
    for source in order(list(results.sources)):
        one = results.sources[source]
        used = f"{word} data: {real_data(one.real_data)}"
        known = ["fault protocol known"] if one.fault_protocol_known else []
        row = [Cell(source_name(source), "; ".join([used, *known]), slot=slot(source))]
        for name in shown:
            below = f"[{span(one.interval(name))}]" if one.interval(name) else ""
            text = mean_and_spread(one.scores.get(name, []))
            row.append(Cell(text, below, best=source in best[name]))
            if _in_paper(results, name):
                row.append(Cell(results.published.get(source, {}).get(name, "–")))
        rows.append(row)
    return Table(_score_caption(results, shown), columns, rows)


def _score_columns(results: Results, name: str, paper: bool) -> list[Column]:
    """One column, or two under the score's name where the paper has it too."""
    title = METRICS[name].name
    if name in ("rmse", "crps") and results.outputs.units:
        title += f", {results.outputs.units[0]}"
    if not paper:
        return [Column(title)]
    ours = Column("this study", group=title)
    return [ours, Column("paper", group=title, paper=True)] if _in_paper(results, name) else [ours]


def _score_caption(results: Results, shown: Sequence[str]) -> str:
    runs = f"mean ± standard deviation over {results.runs} runs"
    text = runs if results.runs > 1 else "one run, so no spread over runs"
    if any(each.intervals for each in results.sources.values()):
        text += "; in brackets the 95 % bootstrap interval over test trajectories"
        if not results.classes:
            text += ", over blocks of their samples where there are fewer than five"
    text = f"{text[0].upper()}{text[1:]}. Bold: the best mean of a column, whoever has it."
    if any(_in_paper(results, name) for name in shown):
        text += (
            " The paper’s numbers (its Table 1) are from its own runs, test set and classifier, "
            "so compare the gap between rows before the level."
        )
    if any(each.fault_protocol_known for each in results.sources.values()):
        text += (
            " “Fault protocol known”: the training faults follow the published onset and sizes, "
            "which would not be known in the field."
        )
    return text


def _has(results: Results, metric: str) -> bool:
    return any(metric in each.scores for each in results.sources.values())


def _in_paper(results: Results, metric: str) -> bool:
    return any(metric in results.published.get(source, {}) for source in results.sources)


def _best(results: Results, metric: str) -> list[str]:
    """The sources with the best mean; none when there is nothing to choose from."""
    means = {
        name: each.mean(metric)
        for name, each in results.sources.items()
        if np.isfinite(each.mean(metric))
    }
    better = METRICS[metric].better
    if len(means) < 2 or better == 0:
        return []
    top = max(better * mean for mean in means.values())
    return [name for name, mean in means.items() if better * mean == top]


def further_scores(results: Results) -> Section | None:
    """Scores that the paper does not give, and how far the ECE can be trusted."""
    table = _score_table(results, MORE)
    if table is None:
        return None
    floors = {name: _floor(results, name) for name in order(list(results.sources))}
    computed = any(floor is not None for floor in floors.values())
    if _has(results, "ece") and computed:
        columns = [
            *table.columns,
            Column("ECE floor", group="ECE floor" if table.columns[-1].group else ""),
        ]
        rows = [
            [*row, Cell(number(floor))]
            for row, floor in zip(table.rows, floors.values(), strict=True)
        ]
        table = Table(table.caption, columns, rows)
    blocks: list = [table]
    if _has(results, "ece"):
        blocks.append(Prose(_floor_note(results, computed), quiet=True))
    return Section("further", "Further scores", blocks)


def _floor(results: Results, source: str) -> float | None:
    probabilities = results.probabilities(source)
    usable = probabilities.size and np.isfinite(probabilities).all()
    return ece_floor(probabilities) if usable else None


def _floor_note(results: Results, computed: bool) -> str:
    count = results.data.test.n or len(results.data.test.labels)
    text = (
        "The expected calibration error (ECE, top label, 10 bins of equal mass) cannot reach zero "
        f"on {count or 'few'} trajectories. "
    )
    if computed:
        return text + (
            "The floor is what a perfectly calibrated classifier with the same confidences would "
            "show on average; the ECE says something only where it lies clearly above."
        )
    return text + "Its floor is about 0.04 with 90 trajectories and 0.06 with 36."


def comparisons(results: Results) -> Section | None:
    """Every pair on every score: Welch over runs, bootstrap over trajectories."""
    found = [each for each in results.comparisons if each.metric in METRICS]
    if not found:
        return None
    blocks: list[Block] = []
    if len(results.sources) > MANY:
        blocks.append(_who_beats_whom(results, found))
        found = [
            each
            for each in found
            if {each.a, each.b} & set(AGAINST) and each.metric in ("macro_f1", "healthy_recall")
        ] or found
    blocks.append(_pairs(results, found))
    return Section("comparisons", "Comparisons", blocks)


def _who_beats_whom(results: Results, found: Sequence[Comparison]) -> Table:
    """A row per source: against which others it is better, and which are better than it."""
    metric = next(name for name in METRICS if any(each.metric == name for each in found))
    rows = []
    for source in order(list(results.sources)):
        pairs = [e.seen_from(source) for e in found if e.metric == metric and source in (e.a, e.b)]
        told = {
            result: [source_name(e.b) for e in pairs if outcome(e) == result]
            for result in ("better", "worse", "open")
        }
        mean = number(results.sources[source].mean(metric))
        lists = [Cell(", ".join(told[result]) or "–", tone="list") for result in told]
        rows.append([Cell(source_name(source), slot=slot(source)), Cell(mean), *lists])
    title = METRICS[metric].name
    columns = [
        Column("Source", numeric=False),
        Column(title),
        Column("Better than", numeric=False),
        Column("Worse than", numeric=False),
        Column("Undecided against", numeric=False),
    ]
    text = (
        f"Who is better than whom in {in_sentence(title)}: said only where the 95 % paired "
        "bootstrap interval over test trajectories leaves zero out. The intervals are not "
        "corrected for their number."
    )
    return Table(text, columns, rows)


def _pairs(results: Results, found: Sequence[Comparison]) -> Table:
    columns = [
        Column("Score", numeric=False),
        Column("Reading", numeric=False),
        Column("Difference"),
        Column("95 % interval"),
        Column("", numeric=False),
        Column("t (df)", group="Welch’s test over runs"),
        Column("p", group="Welch’s test over runs"),
        Column("p, Holm", group="Welch’s test over runs"),
    ]
    shown = [each.interval for each in found if each.interval is not None]
    low, high = min([0.0, *(lo for lo, _ in shown)]), max([0.0, *(hi for _, hi in shown)])
    rows: list[list[Cell]] = []
    last: tuple[str, str] | None = None
    for each in _by_pair(found):
        if (each.a, each.b) != last:
            rows.append([Cell(f"{source_name(each.a)} minus {source_name(each.b)}")])
        last = each.a, each.b
        rows.append(_comparison_row(each, low, high))
    text = _comparison_caption(results)
    if len(results.sources) > MANY:
        text += " Only pairs with the plain and the updated twin; results.json has all."
    return Table(text, columns, rows)


def _by_pair(found: Sequence[Comparison]) -> list[Comparison]:
    """What was learned most stands first in a pair; pairs together, scores in their order."""
    ranked = order(list(dict.fromkeys(name for each in found for name in (each.a, each.b))))
    turned = [each.seen_from(max(each.a, each.b, key=ranked.index)) for each in found]
    metrics = list(METRICS)
    return sorted(
        turned,
        key=lambda e: (-ranked.index(e.a), ranked.index(e.b), metrics.index(e.metric)),
    )


def _comparison_row(each: Comparison, low: float, high: float) -> list[Cell]:
    forest = None
    if each.interval is not None and np.isfinite(each.mean_diff) and high > low:
        lower, at, upper, zero = (
            100 * (value - low) / (high - low)
            for value in (each.interval[0], each.mean_diff, each.interval[1], 0.0)
        )
        forest = Forest(lower, min(max(at, 0), 100), upper, zero)
    result = outcome(each)
    reading = "undecided" if result == "open" else result or "–"
    return [
        Cell(METRICS[each.metric].name),
        Cell(reading, tone=result),
        Cell(signed(each.mean_diff)),
        Cell(span(each.interval, sign=True)),
        Cell("", forest=forest, slot=slot(each.a)),
        Cell(f"{number(each.t, 2)} ({number(each.df, 1)})" if each.t is not None else "–"),
        Cell(p_value(each.p)),
        Cell(p_value(each.p_holm)),
    ]


def _comparison_caption(results: Results) -> str:
    runs = f"{results.runs} runs" if results.runs > 1 else "one run, so there is no test"
    return (
        "“Better” and “worse” are said only where the 95 % paired bootstrap interval over test "
        "trajectories leaves zero out; the bars draw these intervals on one axis, with a line at "
        "zero. Welch’s test asks whether the mean over runs differs, so it sees the chance in "
        f"training ({runs}) but not the choice of test trajectories. Holm’s correction covers the "
        "scores that show its p; the intervals are not corrected for their number."
    )
