"""Error of the surrogate (IBG) against the twin, per output."""

from __future__ import annotations

from retwin.report.blocks import Section, tabulate
from retwin.report.labels import behind, number, quantity, with_unit
from retwin.report.sections.discrepancy import latents
from retwin.report.study import Study


def surrogate(study: Study) -> Section | None:
    """RMSE, and NRMSE where it is known."""
    error = study.results.surrogate
    if not error.rmse:
        return None
    factor, unit = quantity(error.unit)
    heads, rows = ["Output", with_unit("RMSE", unit)], []
    heads += ["NRMSE, %"] if error.nrmse else []
    for name, value in error.rmse.items():
        relative = error.nrmse.get(name)
        both = number(factor * value), number(None if relative is None else 100 * relative, 2)
        rows.append([name, *both][: len(heads)])
    compared = any(latents(study, source) for source in study.results.fidelity)
    worst = behind(number(factor * max(error.rmse.values())), unit)
    table = tabulate("Error of the surrogate", heads, rows)
    values = {"table": table, "compared": compared, "worst": worst}
    return Section("surrogate", "Surrogate error", values)
