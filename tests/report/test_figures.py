"""Figures: what is prepared for both renderers, and what these make of it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from numpy.typing import NDArray

from retwin.data.quality.finding import Finding
from retwin.report.figures.figure import Axis, Band, Figure, Line, Matrices, Matrix, Panel, Row
from retwin.report.figures.plotly_specs import panel_spec
from retwin.report.figures.png import draw, png
from retwin.report.sections import SECTIONS, sections_of
from retwin.report.sections.discrepancy import latents, segment
from retwin.report.sections.fidelity import fidelity
from retwin.report.study import Study
from retwin.results import Results

Content = tuple[dict[str, Any], dict[str, NDArray]]


def study_of(content: Content) -> Study:
    return Study(Results.model_validate(content[0]), content[1])


def test_a_segment_has_the_delay_and_the_offset_that_were_put_in(study: Content) -> None:
    """Two ramps of 100 mm in 0.6 s, of which the measured second one has 80 ms and 5 mm more."""
    time = np.arange(21) / 10
    arrays = study[1]
    nominal, observed = (np.zeros((90, 21, 3)) for _ in range(2))
    nominal[..., 1] = np.interp(time, [0.1, 0.7, 1.0, 1.6], [0, 0.1, 0.1, 0.2])
    observed[..., 1] = np.interp(time, [0.1, 0.7, 1.08, 1.68], [0, 0.1, 0.1, 0.205])
    arrays |= {"portrait/nominal": nominal, "portrait/observed": observed}
    arrays["portrait/times"] = np.tile([[0.1, 0.7, 1.0], [1.0, 1.7, 2.0]], (90, 1, 1))
    found = segment(study_of(study))
    assert found is not None
    assert (found.output, found.unit) == ("y", "mm")
    assert found.error.midpoints[0][1] == pytest.approx(150)
    assert found.labels == ("delay 80 ms", "offset 5.0 mm")


def test_no_segment_without_one_that_was_measured(study: Content) -> None:
    study[1]["portrait/observed"][:, 3] = np.nan
    assert segment(study_of(study)) is None


def test_latents_count_what_lies_outside(study: Content) -> None:
    delay, x, *_ = latents(study_of(study), "ibg_rg")
    assert (delay.values.counts, delay.values.outside) == ((200, 4000), (9, 0))
    assert delay.values.observed.sum() == pytest.approx(191 / 200)
    assert x.unit == "mm"
    assert 8 < x.values.edges[-1] < 50, "the outliers at 200 mm do not stretch it"


def test_bands_are_what_was_measured_minus_the_nominal_output(study: Content) -> None:
    section = fidelity(study_of(study))
    assert section is not None
    shown = section.figures[1]
    assert isinstance(shown, Figure)
    titles = [panel.title for panel in shown.panels]
    assert titles == [
        f"{output}, {which} ({trajectory})"
        for which, trajectory in (("typical", "real_a/000"), ("worst", "real_a/001"))
        for output in "xyz"
    ]
    last = shown.panels[-1]
    light, _, measured = last.rows[0].marks
    assert isinstance(measured, Line)
    assert last.rows[0].y.unit == "mm"
    assert last.x.limits == (0, pytest.approx(1.9))
    assert np.isfinite(measured.y).sum() == 15
    np.testing.assert_allclose(light.high[0] - light.low[0], 4 * 2 * 1.64)
    del study[1]["bands/ibg_rg/seen"]
    section = fidelity(study_of(study))
    assert section is not None
    assert [figure.name for figure in section.figures] == ["pit"]


def test_figures_are_valid_for_both_renderers(study: Content) -> None:
    def coloured(value: object) -> object:
        if isinstance(value, dict):
            return {key: coloured(each) for key, each in value.items()}
        if isinstance(value, list):
            return [coloured(each) for each in value]
        return "#123456" if isinstance(value, str) and value.startswith("@") else value

    sections = sections_of(study_of(study))
    own = len(SECTIONS) - 4
    assert len(sections) == own, "all but findings of records, and those of a case without classes"
    shown = [figure for section in sections for figure in section.figures]
    assert [figure.name for figure in shown] == [
        "scores",
        "confusion",
        "roc",
        "reliability",
        "movement",
        "tde",
        "tpe",
        "noise",
        "pit",
        "bands",
        "learning",
    ]
    for figure in shown:
        assert draw(figure).axes
        for panel in figure.panels if isinstance(figure, Figure) else ():
            spec = panel_spec(panel)
            assert go.Figure(coloured({key: spec[key] for key in ("data", "layout")})).data


def test_names_with_dollars_are_no_formulas() -> None:
    """Such text ended with an error of matplotlib's, or was set as a formula."""
    bad, other = r"$\frac{", "a$b$"
    matrix = Matrix(bad, "ibg_rg", [[3, 1], [0, 4]], np.array([[0.75, 0.25], [0.0, 1.0]]), 7, 8)
    image = png(Matrices("confusion", [bad, other], [matrix]), emulated=False)
    assert image.startswith(b"\x89PNG")


def test_very_many_samples_are_drawn_as_their_envelope() -> None:
    """No peak is lost, and the page stays small: 40 000 samples, as the Silverbox has."""
    x = np.linspace(0, 65, 40_000)
    y = np.sin(7 * x)
    y[12_345] = 3.0
    marks = [Line(x, y, "measured", "ink"), Band(x, y - 1, y + 1, "band", "c0")]
    panel = Panel(Axis("time", "s"), [Row(Axis("output"), marks)], "a long record")
    line, band = panel_spec(panel)["data"]
    assert len(line["x"]) == len(line["y"]) <= 4000
    assert (max(line["y"]), min(line["y"])) == pytest.approx((3.0, -1.0), abs=1e-3)
    assert max(band["y"]) == pytest.approx(4.0)
    assert len(band["x"]) <= 4000
    short = Line(x[:100], y[:100], "measured", "ink")
    few = panel_spec(Panel(Axis("time"), [Row(Axis("output"), [short])], "short"))["data"][0]
    assert len(few["y"]) == 100


def test_gaps_neither_join_a_band_nor_empty_the_envelope_of_a_line() -> None:
    """A sensor that samples every tenth time still has a line; a gap divides a band in two."""
    x, low = np.arange(6.0), np.array([0.0, 1.0, np.nan, np.nan, 4.0, 5.0])
    marks = [Band(x, low, low + 1, "band", "c0")]
    (band,) = panel_spec(Panel(Axis("time"), [Row(Axis("output"), marks)], "gap"))["data"]
    assert band["x"] == [0, 1, 1, 0, None, 4, 5, 5, 4]
    assert band["y"] == [1, 2, 1, 0, None, 5, 6, 5, 4]
    y = np.full(40_000, np.nan)
    y[::10] = 1.0
    slow = [Line(np.arange(40_000.0), y, "measured", "ink")]
    (line,) = panel_spec(Panel(Axis("time"), [Row(Axis("output"), slow)], "slow"))["data"]
    assert set(line["y"]) == {1.0}


def test_records_with_findings_are_a_section_with_their_picture(study: Content) -> None:
    results, arrays = study
    names = results["outputs"]["names"]
    finding = Finding("r1", names[0], "frozen", "stays at exactly 1", 0.1, 0.3)
    about = {"findings": [asdict(finding)], "explained": {"healthy": {names[0]: 0.9}}}
    shape, inputs = (1, 50, len(names)), len(results["inputs"]["names"])
    added = {
        "records/commands": np.zeros((1, 50, inputs)),
        "records/nominal": np.zeros(shape),
        "records/observed": np.ones(shape),
        "records/mask": np.ones(shape, dtype=bool),
        "records/ids": np.array(["r1"]),
        "records/rate": np.array(100.0),
    }
    sections = sections_of(study_of((results | {"records": about}, arrays | added)))
    (section,) = [each for each in sections if each.key == "records"]
    assert [each.name for each in section.figures] == ["records"]
    row = section.values["part"].table.rows[0]
    assert "stays at exactly 1" in str(row)
