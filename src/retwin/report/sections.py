"""The sections of the page, in their order; each is left out when its data are not there."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from retwin.report.blocks import (
    Block,
    Cell,
    Column,
    Facts,
    Fold,
    Matrices,
    Matrix,
    Prose,
    Section,
    SectionMaker,
    Table,
)
from retwin.report.curves import Roc, latents, micro_roc
from retwin.report.decisions import decisions
from retwin.report.explorer import explorer
from retwin.report.fidelity import discrepancy, fidelity
from retwin.report.learning import learning_curve
from retwin.report.plots import caption, roc_plot
from retwin.report.results import Dataset, Results, Source
from retwin.report.scores import comparisons, further_scores, scores
from retwin.report.simulation import simulation
from retwin.report.words import (
    MANY,
    class_name,
    duration,
    label,
    number,
    order,
    quantity,
    real_data,
    slot,
    source_name,
)

__all__ = ["SECTIONS", "recalls", "roc_curves"]

BULK = 3600
"""Trajectories for which the time of generation is told."""


def confusion(results: Results) -> Section | None:
    """Confusion matrices side by side (the paper's figure 3)."""
    shown = []
    for source in order(list(results.sources)):
        counts = results.sources[source].confusion
        if counts is None or not results.classes:
            continue
        shares = [[round(100 * share) for share in row] for row in recalls(counts)]
        right = sum(counts[i][i] for i in range(len(counts)))
        total = sum(map(sum, counts))
        below = f"{right} of {total} right ({100 * right / max(total, 1):.0f} %)"
        shown.append(Matrix(source_name(source), slot(source), below, counts, shares))
    if not shown:
        return None
    runs = f"summed over {results.runs} runs" if results.runs > 1 else "of the one run"
    text = (
        f"Counts {runs}; rows are the true class, columns the answer, colour the share of the "
        "row. A good classifier has only its diagonal; the first row shows false alarms on "
        "healthy trajectories."
    )
    if results.published:
        text += " The paper’s figure 3."
    if any("teady_state_error" in name for name in results.classes):
        text += " M1 is motor 1; bias is a steady-state error."
    names = [class_name(name) for name in results.classes]
    block = Matrices("confusion", caption(results, text), names, shown)
    return Section("confusion", "Confusions", [block])


def recalls(counts: Sequence[Sequence[int]]) -> list[list[float]]:
    """Share of its row that each count is; a class without trajectories has none."""
    table = np.asarray(counts, dtype=float)
    rows: list[list[float]] = (table / np.maximum(table.sum(axis=1, keepdims=True), 1)).tolist()
    return rows


def roc_curves(results: Results) -> dict[str, Roc]:
    """Micro-averaged ROC of every source that has probabilities; of many, the twin and the best."""
    found = {}
    for source in order(_telling(results)):
        probabilities = results.probabilities(source)
        if probabilities.size and results.classes and np.isfinite(probabilities).all():
            found[source] = micro_roc(probabilities, results.truth)
    return found


def _telling(results: Results) -> list[str]:
    """All sources; of many, the first one and those with the best micro-averaged AUROC."""
    sources = order(list(results.sources))
    ranked = sorted(sources[1:], key=lambda name: -_or_zero(results.sources[name]))
    return [*sources[:1], *ranked[:MANY]]


def _or_zero(source: Source) -> float:
    mean = source.mean("auroc_micro")
    return mean if math.isfinite(mean) else 0.0


def roc(results: Results) -> Section | None:
    """ROC with bands (the paper's figure 4)."""
    curves = roc_curves(results)
    if not curves:
        return None
    return Section("roc", "ROC", [roc_plot(results, curves)])


def surrogate(results: Results) -> Section | None:
    """Error of the surrogate against the twin, per output."""
    told = results.surrogate
    if not told.rmse:
        return None
    factor, unit = quantity(told.unit)
    columns = [Column("Output", numeric=False), Column(f"RMSE, {unit}" if unit else "RMSE")]
    if told.nrmse:
        columns.append(Column("NRMSE, %"))
    rows = []
    for name, value in told.rmse.items():
        row = [Cell(name), Cell(number(factor * value))]
        if told.nrmse:
            relative = told.nrmse.get(name)
            row.append(Cell("–" if relative is None else number(100 * relative, 2)))
        rows.append(row)
    runs = f", mean over {results.runs} runs" if results.runs > 1 else ""
    text = (
        f"Error of the surrogate (IBG) on twin trajectories that it was not fitted to{runs}. It "
        "should be small beside the discrepancy above, or the residual model learns the "
        "surrogate’s errors instead of the real system’s."
        if any(latents(results, source) for source in results.fidelity)
        else f"Error of the surrogate (IBG) on twin trajectories that it was not fitted to{runs}."
    )
    return Section("surrogate", "Surrogate error", [Table(text, columns, rows)])


def time(results: Results) -> Section | None:
    """What each source costs, and how long the stages took."""
    blocks: list[Block] = []
    costs = _costs(results)
    if costs is not None:
        blocks.append(costs)
    parts = results.timing.get("seconds")
    told = {**(parts if isinstance(parts, dict) else {}), "total_s": results.timing.get("total_s")}
    numbers = {
        key: float(value)
        for key, value in told.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }
    stages = {key: value for key, value in numbers.items() if key != "total_s"}
    rows = [[Cell(label(key)), Cell(duration(value))] for key, value in stages.items()]
    if "total_s" in numbers:
        rows.append([Cell("All jobs"), Cell(duration(numbers["total_s"]))])
    if rows:
        columns = [Column("Stage", numeric=False), Column("Time")]
        blocks.append(
            Table(
                "Mean time of a job of each kind, on one core; and of all jobs together.",
                columns,
                rows,
            )
        )
    return Section("time", "Time", blocks) if blocks else None


def _costs(results: Results) -> Table | None:
    sources = order(list(results.sources))
    parts = results.sources
    bulky = f"{BULK} trajectories"
    shown = {
        "Twin runs": [
            "–" if parts[each].twin_runs is None else str(parts[each].twin_runs) for each in sources
        ],
        "Update": [duration(parts[each].update_s) for each in sources],
        bulky: [duration(_bulk_seconds(parts[each])) for each in sources],
        "Training": [duration(parts[each].train_s) for each in sources],
        "One diagnosis": [duration(parts[each].predict_s) for each in sources],
    }
    kept = {name: texts for name, texts in shown.items() if set(texts) != {"–"}}
    if not kept:
        return None
    told = any("generate" in results.published.get(source, {}) for source in sources)
    paper = told and bulky in kept
    word = "Emulated" if results.emulated else "Real"
    head = "Training data" if results.classes else "Source"
    columns = [Column(head, numeric=False), Column(f"{word} data used", numeric=False)]
    columns += [
        Column("this study", group=bulky) if paper and name == bulky else Column(name)
        for name in kept
    ]
    if paper:
        place = 1 + next(i for i, each in enumerate(columns) if each.group == bulky)
        columns.insert(place, Column("paper", group=bulky, paper=True))
    rows = []
    for place, each in enumerate(sources):
        row = [Cell(source_name(each), slot=slot(each)), Cell(real_data(parts[each].real_data))]
        for name, texts in kept.items():
            row.append(Cell(texts[place]))
            if paper and name == bulky:
                row.append(Cell(results.published.get(each, {}).get("generate", "–")))
        rows.append(row)
    text = (
        "What a source costs in one run, with all that must be made before it: runs of the twin, "
        "the update (fitting what makes its data), the generation of trajectories"
    )
    if results.classes:
        text += ", the training of the diagnoser, and the diagnosis of one trajectory"
    text += ". Each job on one core."
    if paper:
        text += (
            " The paper’s times are from another machine (Apple M1 Pro) and another twin, so "
            "only the order of magnitude compares."
        )
    return Table(text, columns, rows)


def _bulk_seconds(source: Source) -> float | None:
    if source.generate_s is None or not source.generated:
        return None
    return source.generate_s * BULK / source.generated


def provenance(results: Results) -> Section | None:
    """Data, versions, and the command that makes this report again."""
    blocks: list[Block] = []
    told = dict(results.provenance)
    command = told.pop("command", None)
    if command:
        blocks.append(Prose("This command makes the same study again:"))
        blocks.append(Facts([], [("", str(command))]))
    data = _data_table(results)
    if data is not None:
        blocks.append(data)
    setup = {"preset": results.preset, "classifier": results.classifier, "runs": results.runs}
    facts = {**setup, **told}
    pairs = [
        (key.replace("_", " "), str(value))
        for key, value in facts.items()
        if value not in (None, "")
    ]
    blocks.append(Facts(pairs))
    used = results.data.calibration.used
    if used:
        blocks.append(Fold(f"{len(used)} calibration trajectories used", used))
    if results.data.test.ids:
        count = len(results.data.test.ids)
        blocks.append(Fold(f"{count} test trajectories", results.data.test.ids))
    return Section("provenance", "Provenance", blocks)


def _data_table(results: Results) -> Table | None:
    told = results.data
    roles = (
        ("Twin", told.twin),
        ("Calibration", told.calibration),
        ("Test", told.test),
    )
    rows = [_data_row(role, each) for role, each in roles if each.n is not None or each.sha256]
    if not rows:
        return None
    columns = [
        Column("Role", numeric=False),
        Column("File", numeric=False),
        Column("Trajectories"),
        Column("used"),
        Column("SHA-256", numeric=False),
    ]
    text = "The data, known by their SHA-256."
    if told.protocol:
        text += f" Protocol: {told.protocol.rstrip('.')}."
    return Table(caption(results, text), columns, rows)


def _data_row(role: str, each: Dataset) -> list[Cell]:
    return [
        Cell(role),
        Cell(each.name or "–"),
        Cell("–" if each.n is None else str(each.n)),
        Cell("all" if each.used is None else str(len(each.used))),
        Cell(each.sha256 or "–", tone="code"),
    ]


SECTIONS: tuple[SectionMaker, ...] = (
    scores,
    comparisons,
    confusion,
    roc,
    decisions,
    simulation,
    discrepancy,
    fidelity,
    learning_curve,
    explorer,
    surrogate,
    further_scores,
    time,
    provenance,
)
"""What the page shows, in this order; a new section is one more function in this list."""
