"""Error of the surrogate (IBG) against the twin, per output."""

from __future__ import annotations

from retwin.report.blocks import Cell, Section, Table, columns
from retwin.report.labels import number, quantity, with_unit
from retwin.report.sections.discrepancy import latents
from retwin.report.study import Study


def surrogate(study: Study) -> Section | None:
    """RMSE, and NRMSE where it is known."""
    error = study.results.surrogate
    if not error.rmse:
        return None
    factor, unit = quantity(error.unit)
    heads = columns("Output", with_unit("RMSE", unit), *(["NRMSE, %"] if error.nrmse else []))
    rows = []
    for name, value in error.rmse.items():
        row = [Cell(name), Cell(number(factor * value))]
        if error.nrmse:
            relative = error.nrmse.get(name)
            row.append(Cell("–" if relative is None else number(100 * relative, 2)))
        rows.append(row)
    compared = any(latents(study, source) for source in study.results.fidelity)
    values = {"table": Table("Error of the surrogate", heads, rows), "compared": compared}
    return Section("surrogate", "Surrogate error", values)
