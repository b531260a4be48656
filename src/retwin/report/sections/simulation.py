"""Test records beside what sources simulate from their commands alone."""

from __future__ import annotations

import numpy as np

from retwin.report.blocks import Section
from retwin.report.figures.figure import Axis, Figure, Key, Line, Mark, Panel, Row, draw_bands
from retwin.report.figures.style import colour_of, dash
from retwin.report.labels import quantity, source_name
from retwin.report.study import Study


def simulation(study: Study, *, shown: int = 2) -> Section | None:
    """Every output of the first records: measured and simulated above, the errors below.

    Parameters
    ----------
    shown : int, default 2
        Records that the figure shows, at most.

    """
    sources = _selected(study)
    measured = study.arrays.get("simulation/observed")
    if not sources or measured is None:
        return None
    banded = f"simulation/{sources[-1]}/bands" in study.arrays
    keys = [Key("measured", "ink")]
    keys += [Key(source_name(name), colour_of(name), dash(name)) for name in sources]
    if banded:
        text = f"90 % and 50 % of the draws: {source_name(sources[-1])}"
        keys.append(Key(text, colour_of(sources[-1]), "bar"))
    panels = [
        _panel(study, sources, record, output)
        for record in range(min(shown, len(measured)))
        for output in range(measured.shape[2])
    ]
    figure = Figure("simulation", panels, keys, columns=1)
    return Section("simulation", "Simulation", {"figure": figure}, [figure])


def _selected(study: Study) -> list[str]:
    """The plain twin, the best deterministic source, and the best source with bands."""
    known = [name for name in study.sources if f"simulation/{name}/mean" in study.arrays]
    if not known:
        return []
    ranked = sorted(known, key=lambda name: study.sources[name].mean("nrmse"))
    random = [name for name in ranked if f"simulation/{name}/bands" in study.arrays]
    plain = [name for name in ranked[1:] if name not in random]
    return list(dict.fromkeys([known[0], *plain[:1], (random or ranked)[0]]))


def _panel(study: Study, sources: list[str], record: int, output: int) -> Panel:
    arrays, outputs = study.arrays, study.results.outputs
    measured = arrays["simulation/observed"]
    name = (outputs.names or [f"output {output + 1}"] * (output + 1))[output]
    factor, unit = quantity(outputs.units[output] if outputs.units else "")
    time = np.arange(measured.shape[1]) / float(arrays["simulation/rate"])
    observed = factor * measured[record, :, output]
    above: list[Mark] = []
    below: list[Mark] = []
    bands = arrays.get(f"simulation/{sources[-1]}/bands")
    if bands is not None:
        quantiles = factor * bands[record, :, :, output]
        above += draw_bands(time, quantiles, colour_of(sources[-1]), 0.35)
    for source in sources:
        mean = factor * arrays[f"simulation/{source}/mean"][record, :, output]
        look = (source_name(source), colour_of(source), dash(source), 1.6)
        above.append(Line(time, mean, *look))
        below.append(Line(time, mean - observed, *look))
    above.append(Line(time, observed, "measured", "ink", width=1.3))
    record_id = str(arrays["simulation/ids"][record])
    x = Axis("time", "s", (time[0], time[-1]), count=8)
    rows = [Row(Axis(name, unit), above), Row(Axis("error", unit, count=5), below)]
    alt = f"{name} of record {record_id}, measured and simulated, and the error"
    return Panel(x, rows, alt, f"{name} ({record_id})", height=480)
