"""`identification_page`: one self-contained HTML page about an identification.

Its figures are estimates in their ranges, records before and after, and residuals.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.check import Checked
from retwin.data.trajectories import Trajectories
from retwin.evaluation.identification.validation import Identification
from retwin.report.assets import environment, render_page
from retwin.report.blocks import Cell, Table, grouped, tabulate, text_column
from retwin.report.figures.figure import (
    Axis,
    Figure,
    Key,
    Line,
    Mark,
    Panel,
    Points,
    Row,
    record_panel,
)
from retwin.report.figures.residual_panels import ChannelRecords, Errors, residual_figures
from retwin.report.identification import texts
from retwin.report.labels import behind, number, p_value, shown_unit, signed, significant
from retwin.report.records import TITLE, records_part
from retwin.update.dynamics.unknowns import state_names

OUTPUTS, INPUTS = 6, 3
"""Outputs and inputs of which figures are drawn, at most."""
SAMPLES = 1500
"""Samples of a record that are drawn, at most."""
BEFORE, AFTER, MEASURED = "c1", "c0", "ink"
KEYS = (Key("before", BEFORE, "dash"), Key("after", AFTER))
ROW_HEIGHT, MARGIN = 34, 80
"""Pixels of a parameter in the figure of estimates, and of its axis."""


def figures(found: Identification) -> dict[str, Figure]:
    """The figures that have something to show, by name."""
    measured, before, after = found.simulated[found.compared]
    errors = [measured.measured.astype(float) - each for each in (before, after)]
    shown = [i for i in range(len(measured.outputs)) if measured.mask[..., i].any()][:OUTPUTS]
    made = [_estimates(found), _records(found, shown), *_residuals(measured, errors, shown)]
    return {each.name: each for each in made if each.panels}


def _estimates(found: Identification) -> Figure:
    """Each estimate and its interval within its range, the first parameter on top."""
    known = found.parameters
    place = np.arange(len(known))[::-1].astype(float)
    low = np.array([each.low for each in known])
    width = np.array([each.high for each in known]) - low

    def shares(values: Iterable[float]) -> NDArray:
        return (np.array(list(values)) - low) / width

    ends = [each.interval or (each.value, each.value) for each in known]
    start, value = (shares(getattr(each, name) for each in known) for name in ("start", "value"))
    inside = [np.clip(shares(values), 0, 1).tolist() for values in zip(*ends, strict=True)]
    bars = list(zip(*inside, strict=True))
    texts = [behind(f"{each.name}: {each.value:.4g}", each.unit) for each in known]
    first = [f"{each.name} before: {each.start:.4g}" for each in known]
    marks: list[Mark] = [
        Points(start, place, "before", BEFORE, "diamond-open", texts=first),
        Points(value, place, "after", AFTER, ends=bars, texts=texts, bar_width=3),
    ]
    ticks = {at: each.name for at, each in zip(place.tolist(), known, strict=True)}
    panel = Panel(
        Axis("place in its range", "", (-0.03, 1.03), "percent", step=0.25),
        [Row(Axis("", kind="names", limits=(-0.6, len(known) - 0.4), ticks=ticks), marks)],
        "Estimates of the parameters and their 95 % intervals within their ranges",
        height=MARGIN + ROW_HEIGHT * len(known),
    )
    keys = [Key("before", BEFORE, "diamond"), Key("after, with its 95 % interval", AFTER, "circle")]
    return Figure("estimates", [panel], keys, columns=1)


def _records(found: Identification, shown: list[int]) -> Figure:
    """Measured and simulated outputs of the trajectory with the median error after."""
    measured, before, after = found.simulated[found.compared]
    row = _typical(measured, after)
    seen = measured.mask[row].any(axis=1)
    samples = np.flatnonzero(seen)
    first, last = int(samples[0]), int(samples[-1]) + 1
    chosen = np.arange(first, last, max(1, -(-(last - first) // SAMPLES)))
    times = chosen / measured.rate
    panels = []
    for i in shown:
        values = measured.measured[row, chosen, i]
        marks: list[Mark] = [
            Line(times, values, "measured", MEASURED, width=2.6, alpha=0.45),
            Line(times, before[row, chosen, i], "before", BEFORE, "dash", 1.6),
            Line(times, after[row, chosen, i], "after", AFTER, width=1.6),
        ]
        name, unit = measured.outputs.names[i], measured.outputs.units[i]
        panels.append(record_panel(times, name, unit, marks))
    keys = [Key("measured", MEASURED), *KEYS]
    return Figure("records", panels, keys, str(measured.ids[row]), columns=1)


def _typical(measured: Trajectories, after: NDArray) -> int:
    """The trajectory whose error, over all outputs in units of their spread, is the median."""
    error = measured.measured - after
    values = [measured.observed[..., i][measured.mask[..., i]] for i in range(error.shape[2])]
    spread = np.array([each.std() if len(each) else 0.0 for each in values])
    scaled = error / np.where(spread > 0, spread, 1.0)
    seen = np.isfinite(scaled)
    count = np.maximum(seen.sum(axis=(1, 2)), 1)
    mean = np.where(seen, scaled**2, 0.0).sum(axis=(1, 2)) / count
    known = np.flatnonzero(seen.any(axis=(1, 2)))
    return int(known[np.argsort(mean[known])[(len(known) - 1) // 2]])


def _residuals(measured: Trajectories, errors: list[NDArray], shown: list[int]) -> list[Figure]:
    """Correlations and spectra of the residuals after and before, of outputs that have some."""
    about, rate = measured.outputs, measured.rate
    drawn = []
    for i in shown:
        pair = [each[..., i] for each in errors]
        if all(map(_useful, pair)):
            values = measured.measured[..., i].astype(float)
            output = ChannelRecords(about.names[i], about.units[i], values)
            drawn.append(Errors(output, dict(zip(reversed(KEYS), reversed(pair), strict=True))))
    commands = [
        ChannelRecords(name, "", measured.commands[..., j].astype(float))
        for j, name in enumerate(measured.inputs.names[:INPUTS])
        if np.ptp(measured.commands[..., j]) > 0
    ]
    return residual_figures(drawn, commands, KEYS, rate)


def _useful(residual: NDArray) -> bool:
    """Whether correlations of a residual are defined."""
    values = residual[np.isfinite(residual)]
    return len(values) > 16 and bool(np.ptp(values) > 0)


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
    # Combinations of parameters that are shown, at most.
    rows = [
        [
            texts.combination(each),
            significant(each.error) if each.error < 1e6 else "infinite",
            Cell("open" if each.open else "determined", tone="open" if each.open else ""),
        ]
        for each in found.directions[:-9:-1]
    ]
    title = "Combinations of parameters, from the least determined on"
    return tabulate(title, ["combination", "standard error", text_column("")], rows)


def _correlations(found: Identification) -> Table | None:
    names = [each.name for each in found.parameters]
    # Parameters of which a table of all correlations is shown, at most.
    if not 1 < len(names) <= 12:
        return None

    def cell(r: float) -> Cell:
        # Correlation from which a cell is emphasised.
        return Cell(signed(r, 2) if abs(r) <= 1.001 else "–", best=abs(r) > 0.9)

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
