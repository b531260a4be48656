"""`fit_page`: one self-contained HTML page about an updated twin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.evaluation.choice.fitted import Fitted
from retwin.report.assets import environment, render_page
from retwin.report.blocks import Table, tabulate
from retwin.report.choice import tables
from retwin.report.figures.figure import Band, Figure, Key, Line, Mark, record_panel
from retwin.report.identification.page import OUTPUTS, SAMPLES
from retwin.report.labels import significant
from retwin.report.records import TITLE, records_part
from retwin.update.forecast_errors import BEYOND, USUAL

MEASURED, PREDICTED = "muted", "c0"


def fit_page(found: Fitted, folder: str, *, title: str) -> str:
    """The page as text, which needs no other file and no network.

    Parameters
    ----------
    found : Fitted
        What `rt.fit` returned.
    folder : str
        The folder of the model, as it was given.
    title : str
        The name of the system.

    """
    figures = {"predictions": _predictions(found)} if found.parts else {}
    part = records_part(found.checked)
    forecast = found.twin.forecast
    return render_page(
        environment(emulated=found.records.emulated),
        "fit",
        [*figures.values(), *([part.figure] if part.figure else [])],
        part=part,
        records_title=TITLE,
        found=found,
        title=title,
        folder=folder,
        taken=found.score(found.chosen),
        parts=", ".join(dict.fromkeys(found.parts)),
        units=tables.units_of(found),
        comparison=tables.comparison_table(found),
        parameters=tables.parameter_table(found),
        terms=tables.term_table(found),
        sentences=tables.model_sentences(found),
        bands=_bands(found),
        promised=forecast is not None and forecast.promised,
        beyond=_beyond(found),
        figures=figures,
    )


def _beyond(found: Fitted) -> dict[str, float]:
    """By channel, how far it may leave its range in widths of that, where that is far."""
    forecast, records = found.twin.forecast, found.records
    if forecast is None:
        return {}
    names = (*records.inputs.names, *records.outputs.names)
    shares = dict(zip(names, forecast.beyond.tolist(), strict=True))
    return {name: share for name, share in shares.items() if share > BEYOND}


def _bands(found: Fitted) -> Table:
    forecast, units = found.twin.forecast, tables.units_of(found)
    if forecast is None:
        return Table("", [], [])
    rows = []
    for lead, deviation, number in zip(
        forecast.leads, forecast.deviation, forecast.independent, strict=True
    ):
        ahead = f"{significant(lead)} s ahead" if np.isfinite(lead) else "free simulation"
        widths = zip(deviation, units.values(), strict=True)
        cells = [f"± {significant(USUAL * each)}{unit}" for each, unit in widths]
        rows.append([ahead, *cells, f"{number.min():.0f}"])
    return tabulate("Bands by time ahead", ["prediction", *units, "independent samples"], rows)


def _predictions(found: Fitted) -> Figure:
    """Measured and predicted outputs of the record of which most was left out."""
    row = int(np.argmax(np.isfinite(found.predicted).any(axis=2).sum(axis=1)))
    return draw_prediction(found.records, found.predicted, found.deviation, row)


def draw_prediction(
    records: Trajectories, mean: NDArray, deviation: NDArray, row: int = 0
) -> Figure:
    """Predictions (n, T, d_y) of one of some records with 90 % bands, and what was measured."""
    last, seen = int(records.lengths[row]), records.mask[row].any(axis=1)
    first, measured = int(np.argmax(seen)), bool(seen.any())  # after a transient
    chosen = np.arange(first, last, max(1, -(-(last - first) // SAMPLES)))
    times = chosen / records.rate
    panels = []
    for i in range(min(OUTPUTS, len(records.outputs))):
        values = records.measured[row, chosen, i]
        own, half = mean[row, chosen, i], USUAL * deviation[row, chosen, i]
        marks: list[Mark] = [
            Band(times, own - half, own + half, "90 % band", PREDICTED),
            Line(times, values, "measured", MEASURED, width=2.2),
            Line(times, own, "predicted", PREDICTED, width=1.6),
        ]
        name, unit = records.outputs.names[i], records.outputs.units[i]
        panels.append(record_panel(times, name, unit, marks))
    keys = [Key("measured", MEASURED), Key("predicted, with its 90 % band", PREDICTED)]
    keys = keys if measured else keys[1:]
    return Figure("predictions", panels, keys, str(records.ids[row]), columns=1)
