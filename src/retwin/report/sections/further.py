"""The scores that the paper does not give."""

from __future__ import annotations

from retwin.catalog import METRICS
from retwin.report.blocks import Section
from retwin.report.sections.scores import table_values
from retwin.report.study import Study
from retwin.scores.calibration import calibration_floor

FURTHER = tuple(
    name for name, metric in METRICS.items() if not metric.headline and metric.unit == "1"
)
"""The metrics of the second table."""


def further(study: Study) -> Section | None:
    """The scores that the paper does not give, and the noise floor of the calibration error."""
    shown = [name for name in FURTHER if study.results.has(name)]
    if not shown:
        return None
    ece = study.results.has("ece")
    floors = {
        name: calibration_floor(study.probabilities(name)) if name in study.diagnosing else None
        for name in (study.sources if ece else ())
    }
    computed = any(floor is not None for floor in floors.values())
    title = "Further scores of all sources"
    values = table_values(study, shown, title, floors if computed else {})
    values |= {"ece": ece, "computed": computed, "count": study.results.data.test.size or "few"}
    return Section("further", "Further scores", values)
