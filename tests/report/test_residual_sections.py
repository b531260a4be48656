"""Residual diagnostics and learned curves on the page, of records whose errors are known."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.report.figures.figure import Band, Figure, Line, Points, Spans
from retwin.report.figures.plotly_specs import panel_spec
from retwin.report.figures.png import draw
from retwin.report.labels import source_name
from retwin.report.page import render
from retwin.report.sections import sections_of
from retwin.report.sections.delta import delta
from retwin.report.sections.residuals import residuals
from retwin.report.study import Study
from retwin.report.summary import picture
from retwin.results import Results

RATE, LAG = 50.0, 5
Content = tuple[dict[str, Any], dict[str, NDArray]]


@pytest.fixture
def simulated() -> Content:
    """Two records: the twin lacks 0.3 of the command 0.1 s before, the other one is exact.

    In the last second the command is beyond its range in the calibration.
    """
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, size=(2, 1000, 1))
    commands[:, 950:] *= 3
    observed = rng.normal(size=(2, 1000, 1))
    twin = observed + 0.01 * rng.normal(size=observed.shape)
    twin[:, LAG:] -= 0.3 * commands[:, :-LAG]
    exact = observed + 0.01 * rng.normal(size=observed.shape)
    observed[0, 100:130] = np.nan
    errors = {"twin": 0.2, "pi_ls": 0.01}
    about = {
        "schema": 1,
        "case": "plant",
        "runs": 1,
        "classes": [],
        "sources": {name: {"rmse": [e], "nrmse": [e]} for name, e in errors.items()},
        "inputs": {"names": ["valve"], "units": ["%"]},
        "outputs": {"names": ["level"], "units": ["V"]},
    }
    arrays = {
        "simulation/observed": observed,
        "simulation/commands": commands,
        "simulation/twin/mean": twin,
        "simulation/pi_ls/mean": exact,
        "simulation/ids": np.array(["a", "b"]),
        "simulation/rate": np.array(RATE),
        "simulation/range": np.array([[-1.0, -9.0], [1.0, 9.0]]),
    }
    return about, arrays


def study_of(content: Content) -> Study:
    return Study(Results.model_validate(content[0]), content[1])


def figures_of(content: Content) -> dict[str, Figure]:
    section = residuals(study_of(content))
    assert section is not None
    return {each.name: each for each in section.figures}


def marks(figure: Figure, kind: type, panel: int = 0) -> list[Any]:
    return [each for each in figure.panels[panel].rows[0].marks if isinstance(each, kind)]


def test_the_table_finds_what_the_twin_lacks(simulated: Content) -> None:
    section = residuals(study_of(simulated))
    assert section is not None
    twin, exact = section.values["table"].rows
    assert float(exact[1].text) == pytest.approx(0.01, rel=0.05)
    assert float(exact[4].text) > 0.05
    assert float(twin[5].text.replace("−", "-")) == pytest.approx(1, abs=0.05)
    assert twin[5].below.startswith("valve, 0.1 s earlier; limit 0.0")
    assert float(exact[5].text.replace("−", "-")) == pytest.approx(0, abs=0.1)
    assert float(twin[6].text) > 1.5 * float(twin[1].text), "it extrapolates"
    share = float(twin[6].below.removesuffix(" % of the samples"))
    assert share == pytest.approx(100 / 20 * 2 / 3, abs=0.5)


def test_the_figures_show_it(simulated: Content) -> None:
    found = figures_of(simulated)
    names = ["autocorrelation", "crosscorrelation", "spectra", "amplitude", "overtime"]
    assert list(found) == names
    white = marks(found["autocorrelation"], Line)
    (limits,) = marks(found["autocorrelation"], Band)
    assert np.mean(np.abs(white[1].y) > limits.high) < 0.2
    lines = marks(found["crosscorrelation"], Line)
    assert lines[0].x[np.argmax(lines[0].y)] == pytest.approx(LAG / RATE)
    measured, twin, exact = (np.median(each.y) for each in marks(found["spectra"], Line))
    assert measured > twin > exact
    by_valve = marks(found["amplitude"], Points, 1)
    assert len(by_valve[0].x) == len(by_valve[0].y) > 10
    (beyond,) = marks(found["amplitude"], Spans, 1)
    np.testing.assert_allclose(beyond.intervals, [(-3, -1), (1, 3)], atol=0.2)
    (late,) = marks(found["overtime"], Spans)
    assert late.intervals == [(19.0, 20.0)]
    rms = np.asarray(marks(found["overtime"], Line)[0].y)
    assert rms[-1] > 1.5 * rms[:-2].max()


def test_both_renderers_draw_them(simulated: Content) -> None:
    for figure in figures_of(simulated).values():
        assert draw(figure).axes
        assert all(panel_spec(panel)["data"] for panel in figure.panels)


def test_the_first_figure_shows_the_source_of_its_errors(simulated: Content) -> None:
    about, arrays = simulated
    about["sources"] |= {"ibg_rg": {"rmse": [0.1], "nrmse": [0.1]}}
    about["comparisons"] = [{"a": "ibg_rg", "b": "twin", "metric": "rmse", "mean_diff": -0.1}]
    arrays["simulation/ibg_rg/mean"] = arrays["simulation/twin/mean"] + 1.0
    drawn = picture(study_of(simulated))
    assert drawn is not None
    assert drawn.keys[2].text.startswith(f"after: {source_name('pi_ls')}")
    after = [each for each in marks(drawn, Line) if each.name.startswith("after")]
    np.testing.assert_array_equal(after[0].y, arrays["simulation/pi_ls/mean"][0, :, 0])


def test_older_studies_mark_no_extrapolation(simulated: Content) -> None:
    del simulated[1]["simulation/range"]
    assert not any(
        marks(figure, Spans, i)
        for figure in figures_of(simulated).values()
        for i in range(len(figure.panels))
    )
    del simulated[1]["simulation/commands"]
    assert residuals(study_of(simulated)) is None


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_outputs_never_measured_or_without_error(simulated: Content, value: float) -> None:
    simulated[1]["simulation/observed"][:] = value
    for name in ("twin", "pi_ls"):
        simulated[1][f"simulation/{name}/mean"][:] = 0.0
    for figure in figures_of(simulated).values():
        assert draw(figure).axes


@pytest.fixture
def learned(simulated: Content) -> Content:
    simulated[0]["sources"]["dynamics"] = {"rmse": [0.01], "nrmse": [0.01]}
    grid = np.linspace(-0.25, 1.25, 121)[None]
    simulated[1].update(
        {
            "delta/values": grid,
            "delta/discrepancy": grid**2,
            "delta/deviation": 0.1 * np.ones_like(grid),
            "delta/range": np.array([[0.0, 1.0]]),
            "delta/about": np.array([["level", "level", "V", "V/s"]]),
            "delta/parameters": np.array([["pump", "V/s", "level: 1"], ["leak", "1", ""]]),
            "delta/estimates": np.array([[0.1, 0.1234, 0.0021, -0.8], [0.2, 0.3, np.nan, np.nan]]),
        }
    )
    return simulated


def test_each_section_of_a_simulation_begins_with_its_answer(learned: Content) -> None:
    study = study_of(learned)
    page = render(study, sections_of(study))
    bodies = re.findall(r'<section id="(\w+)">.*?</h2><span>(.*?)</span></summ', page, re.DOTALL)
    answers = {name: re.sub(r"<[^>]+>", "", text) for name, text in bodies}
    assert {"scores", "simulation", "residuals", "delta", "card"} <= set(answers)
    assert answers["simulation"].startswith("From the commands alone, the error of the test")
    assert "has a mean of" in answers["residuals"]
    assert answers["delta"].startswith("1 curve of the corrected state equations differs")
    assert all(re.search(r"\d", text) for name, text in answers.items()), answers


def test_the_learned_curve_has_a_band_and_the_ends_of_its_domain(
    learned: Content, write: Callable[[Content], Path], rendered: Callable[[Path], str]
) -> None:
    section = delta(study_of(learned))
    assert section is not None
    (figure,) = section.figures
    (spans,), (band,), (_, line) = (marks(figure, kind) for kind in (Spans, Band, Line))
    assert spans.intervals == [(-0.25, 0.0), (1.0, 1.25)]
    np.testing.assert_allclose(np.asarray(band.high) - line.y, 0.16449, rtol=1e-3)
    assert draw(figure).axes
    page = rendered(write(learned))
    assert all(f'<section id="{name}">' in page for name in ("residuals", "delta"))


def test_parameters_stand_beside_what_was_learned(
    learned: Content, write: Callable[[Content], Path], rendered: Callable[[Path], str]
) -> None:
    section = delta(study_of(learned))
    assert section is not None
    rows = [[cell.text for cell in row] for row in section.values["parameters"].rows]
    assert rows == [
        ["pump", "0.100", "0.12340", "0.00210", "−0.80 with level: 1"],
        ["leak", "0.200", "not determined", "–", "–"],
    ]
    assert "Parameters beside the discrepancy" in rendered(write(learned))


NAMES = ["simulation/range", "delta/range", "delta/about", "delta/parameters", "delta/estimates"]


@pytest.mark.parametrize("name", NAMES)
def test_arrays_that_do_not_fit_are_refused(learned: Content, name: str) -> None:
    learned[1][name] = learned[1][name][..., :-1]
    with pytest.raises(InputError, match=name):
        study_of(learned)
