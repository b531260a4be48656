"""`identification_page`: one self-contained HTML page about an identification."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from types import SimpleNamespace
from typing import Any

from retwin.evaluation.identification import Identification, RMSError
from retwin.report.assets import environment, plotly_js, script_json
from retwin.report.blocks import Cell, Column, Table, columns, grouped
from retwin.report.identification.figures import INPUTS, OUTPUTS, figures
from retwin.report.identification.texts import (
    change,
    combination,
    findings,
    interval,
    next_steps,
    percent,
    significant,
    state,
    value,
)
from retwin.report.labels import counted, duration, p_value
from retwin.report.plotly_specs import figure_specs

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
    command : str
        The command that makes it again; "" if there is none.
    folder : str
        The folder in which the page lies, as it was given.

    """
    templates = environment()
    templates.filters |= {
        "counted": counted,
        "duration": duration,
        "significant": significant,
    }
    templates.globals |= {
        "results": SimpleNamespace(emulated=bool(values["emulated"])),
        "anchors": set(),
        "images": {},
    }
    drawn = figures(found)
    return templates.get_template("identification.html.j2").render(
        found=found,
        values=values,
        start_values=start_values,
        command=command,
        folder=folder,
        findings=findings(found),
        steps=next_steps(found),
        figures=drawn,
        parameters=_parameters(found),
        directions=_directions(found),
        correlations=_correlations(found),
        errors=_errors(found),
        tests=_tests(found),
        limited=len(found.outputs) > OUTPUTS or len(found.twin.inputs) > INPUTS,
        specs=script_json(figure_specs(drawn.values())),
        plotly=plotly_js(),
    )


def _unit(text: str) -> str:
    return "" if text == "1" else text


def _parameters(found: Identification) -> Table:
    rows = [
        [
            Cell(each.name, _unit(each.unit)),
            Cell(significant(each.start)),
            Cell(value(each), best=True),
            Cell(interval(each)),
            Cell(f"{significant(each.low)} to {significant(each.high)}"),
            Cell(state(each) or "identified", tone="open" if state(each) else ""),
        ]
        for each in found.parameters
    ]
    bayes = found.basis == "posterior"
    error = "posterior mean ± standard deviation" if bayes else "after ± standard error"
    heads = [
        *columns("parameter", "before", error, "95 % interval", "searched in"),
        Column("", numeric=False),
    ]
    return Table("Parameters", heads, rows)


def _directions(found: Identification) -> Table:
    rows = [
        [
            Cell(combination(each)),
            Cell(significant(each.error) if each.error < 1e6 else "infinite"),
            Cell("open" if each.open else "determined", tone="open" if each.open else ""),
        ]
        for each in found.directions[: -DIRECTIONS - 1 : -1]
    ]
    heads = [*columns("combination", "standard error"), Column("", numeric=False)]
    return Table("Combinations of parameters, from the least determined on", heads, rows)


def _correlations(found: Identification) -> Table | None:
    names = [each.name for each in found.parameters]
    if not 1 < len(names) <= MATRIX:
        return None
    rows = [
        [
            Cell(name),
            *(
                Cell(
                    f"{found.correlation[i, j]:+.2f}".replace("-", "−")
                    if abs(found.correlation[i, j]) <= 1.001
                    else "–",
                    best=bool(abs(found.correlation[i, j]) > STRONG),
                )
                if j < i
                else Cell("")
                for j in range(len(names) - 1)
            ),
        ]
        for i, name in enumerate(names)
    ][1:]
    return Table("Correlation of the estimates", columns("", *names[:-1]), rows)


def _errors(found: Identification) -> Table:
    rows = []
    held = found.compared == "validation"
    for each in found.outputs:
        if not (each.identification.samples or (each.validation and each.validation.samples)):
            continue
        row = [Cell(each.name, _unit(each.unit)), Cell(significant(each.mean))]
        for error in (each.identification, each.validation):
            if error is None:
                continue
            share = error.after / each.mean if each.mean > 0 else float("nan")
            row += [
                Cell(significant(error.before)),
                Cell(significant(error.after), best=True),
                Cell(f"{100 * share:.1f} %" if isfinite(share) else "–", tone=_worse(share)),
                Cell(change(error, interval=False), _range_of(error)),
            ]
        rows.append(row)
    group = ("before", "after", "of the mean's", "change")
    heads = [*columns("output", "record's mean"), *grouped("measurements used", *group)]
    heads += grouped("held out", *group) if held else []
    what = "free simulation"
    if isfinite(found.horizon):
        what = f"predictions over {found.horizon:.3g} s"
    return Table(f"RMS error of {what}", heads, rows)


def _worse(share: float) -> str:
    """The tone of an error that is larger than that of the mean."""
    return "open" if share > 1 else ""


def _range_of(error: RMSError) -> str:
    """The interval of a change, as a smaller line."""
    if error.interval is None:
        return ""
    return " to ".join(map(percent, error.interval))


def _tests(found: Identification) -> Table:
    rows = []
    measured = found.errors(found.compared)
    for each in found.residuals:
        if each.name not in measured:
            continue
        known = [test for test in each.inputs if isfinite(test.p_value)]
        first = min(known, key=lambda test: test.p_value, default=None)
        rows.append(
            [
                Cell(each.name),
                Cell(p_value(each.p_white)),
                Cell(significant(each.first_correlation, 0.1)),
                Cell(first.name if first else "–"),
                Cell(significant(first.correlation, 0.1) if first else "–"),
                Cell(f"{significant(first.lag)} s" if first else "–"),
                Cell(p_value(first.p_value) if first else "–"),
            ]
        )
    strongest = "strongest dependence on a command"
    heads = [*columns("output"), *grouped("white noise", "p", "next sample")]
    heads += [Column("command", strongest, numeric=False)]
    heads += grouped(strongest, "correlation", "lag", "p")
    return Table("Tests of the residuals after identification", heads, rows)
