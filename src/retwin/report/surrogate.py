"""Error of the surrogate (IBG) against the twin, per output."""

from __future__ import annotations

from retwin.report.blocks import Cell, Column, Section, Table
from retwin.report.curves import latents
from retwin.report.results import Results
from retwin.report.words import number, quantity

__all__ = ["surrogate"]


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
    table = Table("Error of the surrogate", text, columns, rows)
    return Section("surrogate", "Surrogate error", [table])
