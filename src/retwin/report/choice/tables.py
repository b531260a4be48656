"""Tables on an updated twin, which the command line prints and the page shows."""

from __future__ import annotations

from math import isfinite

from retwin.evaluation.choice.fitted import Fitted
from retwin.report.blocks import Cell, Column, Table, columns
from retwin.report.identification.texts import significant
from retwin.report.labels import duration

LARGEST = 8
"""Number of terms of the state equations that are shown."""


def units_of(found: Fitted) -> dict[str, str]:
    """The units of the outputs, as they stand behind a number."""
    pairs = zip(found.records.outputs.names, found.records.outputs.units, strict=True)
    return {name: "" if unit == "1" else f" {unit}" for name, unit in pairs}


def comparison_table(found: Fitted) -> Table:
    """The candidates and the models without the twin, unless nothing was compared."""
    rows, units = [], units_of(found)
    for head, own in (("with the twin", True), ("without the twin", False)):
        some = [each for each in found.scores if each.uses_twin is own and found.parts]
        if some and not own:
            rows.append([Cell(head)])
        for each in some:
            best = each.name == found.chosen
            if not each.rmse:
                rows.append([Cell(each.title, each.reason), *[Cell("–")] * (len(units) + 4)])
                continue
            behind = significant(each.difference) if isfinite(each.difference) else "–"
            error = f"± {significant(each.standard_error)}" if isfinite(each.standard_error) else ""
            rows.append(
                [
                    Cell(each.title, "taken" if best else "", best=best),
                    *(
                        Cell(significant(each.rmse[name]) + units[name], best=best)
                        for name in units
                    ),
                    Cell(significant(each.crps), best=best),
                    Cell(behind, error),
                    Cell(f"{each.coverage:.0%}"),
                    Cell(duration(each.seconds)),
                ]
            )
    heads = [
        Column("candidate", numeric=False),
        *(Column(name, "RMS error") for name in units),
        *map(Column, ("CRPS", "behind the best", "90 % bands hold", "time")),
    ]
    how = "free simulation" if found.horizon is None else f"{found.horizon:g} s ahead"
    title = f"Errors of parts that were left out ({how}), the simplest candidate first"
    return Table(title, heads, rows)


def parameter_table(found: Fitted) -> Table:
    """The parameters before, identified, and in the model."""
    rows = [
        [Cell(name), *(Cell(significant(each)) for each in values)]
        for name, values in found.parameters.items()
    ]
    heads = columns("parameter", "before", "identified", "in the model")
    return Table("Parameters", heads, rows)


def term_table(found: Fitted) -> Table:
    """The largest terms that state equations learned."""
    terms = {} if found.learned is None else found.learned.terms
    rows = [[Cell(name), Cell(f"{size:.3f}")] for name, size in list(terms.items())[:LARGEST]]
    title = "The largest terms, over the usual time derivative of their state"
    return Table(title, columns("term", "size"), rows)
