"""`identification_page`: one self-contained HTML page about an identification."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from retwin.data.quality.check import Checked
from retwin.evaluation.identification.validation import Identification
from retwin.report.assets import environment, render_page
from retwin.report.blocks import Cell, Table, grouped, tabulate, text_column
from retwin.report.identification import texts
from retwin.report.identification.figures import INPUTS, OUTPUTS, figures
from retwin.report.labels import behind, number, p_value, shown_unit, signed, significant
from retwin.report.records import TITLE, records_part
from retwin.update.dynamics.unknowns import state_names

STRONG = 0.9
"""Correlation from which a cell is emphasised."""
DIRECTIONS = 8
"""Combinations of parameters that are shown, at most."""
MATRIX = 12
"""Parameters of which a table of all correlations is shown, at most."""


def identification_page(
    found: Identification,
    values: Mapping[str, Any],
    start_values: Mapping[str, float],
    checked: Checked,
    *,
    command: str,
    folder: str,
) -> str:
    """The page as text, which needs no other file and no network.

    Parameters
    ----------
    found : Identification
        What `validate_identification` returned.
    values : mapping
        The contents of identification.json.
    start_values : mapping of str to float
        Start values of an FMU; empty for another twin.
    checked : Checked
        What was found in the records.
    command : str
        The command that makes it again; "" if there is none.
    folder : str
        The folder in which the page lies, as it was given.

    """
    drawn, part = figures(found), records_part(checked)
    return render_page(
        environment(emulated=bool(values["emulated"])),
        "identification",
        [*drawn.values(), *([part.figure] if part.figure else [])],
        part=part,
        records_title=TITLE,
        found=found,
        values=values,
        start_values=start_values,
        command=command,
        folder=folder,
        states=bool(state_names(found.twin)),
        findings=texts.findings(found, values["notes"]),
        interval_remark=texts.interval_remark(found),
        steps=texts.next_steps(found),
        figures=drawn,
        parameters=_parameters(found),
        directions=_directions(found),
        correlations=_correlations(found),
        errors=_errors(found),
        tests=_tests(found),
        limited=len(found.outputs) > OUTPUTS or len(found.twin.inputs) > INPUTS,
    )


def _parameters(found: Identification) -> Table:
    rows = [
        [
            Cell(each.name, shown_unit(each.unit)),
            "–" if each.own else significant(each.start),
            Cell(texts.value(each), best=True),
            texts.interval(each),
            f"{significant(each.low)} to {significant(each.high)}",
            Cell(texts.state(each) or "identified", tone="open" if texts.state(each) else ""),
        ]
        for each in found.parameters
    ]
    bayes = found.basis == "posterior"
    error = "posterior mean ± standard deviation" if bayes else "after ± standard error"
    heads = ["parameter", "before", error, "95 % interval", "searched in", text_column("")]
    return tabulate("Parameters", heads, rows)


def _directions(found: Identification) -> Table:
    rows = [
        [
            texts.combination(each),
            significant(each.error) if each.error < 1e6 else "infinite",
            Cell("open" if each.open else "determined", tone="open" if each.open else ""),
        ]
        for each in found.directions[: -DIRECTIONS - 1 : -1]
    ]
    title = "Combinations of parameters, from the least determined on"
    return tabulate(title, ["combination", "standard error", text_column("")], rows)


def _correlations(found: Identification) -> Table | None:
    names = [each.name for each in found.parameters]
    if not 1 < len(names) <= MATRIX:
        return None

    def cell(r: float) -> Cell:
        return Cell(signed(r, 2) if abs(r) <= 1.001 else "–", best=abs(r) > STRONG)

    rows = [
        [name, *map(cell, found.correlation[i, :i].tolist()), *[""] * (len(names) - 1 - i)]
        for i, name in enumerate(names)
    ]
    return tabulate("Correlation of the estimates", ["", *names[:-1]], rows[1:])


def _errors(found: Identification) -> Table:
    rows = []
    held = found.compared == "validation"
    for each in found.outputs:
        if not (each.identification.samples or (each.validation and each.validation.samples)):
            continue
        row = [Cell(each.name, shown_unit(each.unit)), Cell(significant(each.mean))]
        for error in filter(None, (each.identification, each.validation)):
            share = error.after / each.mean if each.mean > 0 else float("nan")
            row += [
                Cell(significant(error.before)),
                Cell(significant(error.after), best=True),
                # Worse than the mean.
                Cell(behind(number(100 * share, 1), "%"), tone="open" if share > 1 else ""),
                Cell(
                    texts.change(error, interval=False),
                    " to ".join(map(texts.percent, error.interval or ())),
                ),
            ]
        rows.append(row)
    group = ("before", "after", "of the mean's", "change")
    heads: list[object] = ["output", "record's mean", *grouped("measurements used", *group)]
    heads += grouped("held out", *group) if held else []
    what = "free simulation"
    if isfinite(found.horizon):
        what = f"predictions over {found.horizon:.3g} s"
    return tabulate(f"RMS error of {what}", heads, rows)


def _tests(found: Identification) -> Table:
    rows = []
    measured = found.errors(found.compared)
    for each in found.residuals:
        if each.name not in measured:
            continue
        known = [test for test in each.inputs if isfinite(test.p_value)]
        first = min(known, key=lambda test: test.p_value, default=None)
        own = [each.name, p_value(each.p_white), significant(each.first_correlation, 0.1)]
        strongest = ["–"] * 4
        if first:
            size, lag = significant(first.correlation, 0.1), f"{significant(first.lag)} s"
            strongest = [first.name, size, lag, p_value(first.p_value)]
        rows.append([*own, *strongest])
    group = "strongest dependence on a command"
    heads: list[object] = [
        "output",
        *grouped("white noise", "p", "next sample"),
        text_column("command", group),
    ]
    heads += grouped(group, "correlation", "lag", "p")
    return tabulate("Tests of the residuals after identification", heads, rows)
