"""Labels, numbers and colours of the page."""

from __future__ import annotations

import numpy as np
import pytest

from retwin.catalog import SOURCES
from retwin.report.figures.style import CHROME, PALETTE, colour_index, dash, symbol
from retwin.report.labels import (
    class_name,
    difference,
    duration,
    number,
    p_value,
    percents,
    scored,
    signed,
    span,
)
from retwin.results.sources import Comparison


def contrast(one: str, other: str) -> float:
    """As WCAG 2.2 defines it, of two colours #rrggbb."""
    lights = []
    for colour in (one, other):
        parts = np.array([int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)])
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        lights.append(float(linear @ [0.2126, 0.7152, 0.0722]))
    return (max(lights) + 0.05) / (min(lights) + 0.05)


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_contrast(scheme: int) -> None:
    """AA: 4.5 for text, 3 for marks."""
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    for ground in (CHROME["paper"][scheme], CHROME["wash"][scheme]):
        for name in ("ink", "muted"):
            assert contrast(CHROME[name][scheme], ground) >= 4.5, name
    for name in ("go", "wait", "stop"):
        assert contrast(CHROME[name][scheme], CHROME["paper"][scheme]) >= 4.5, name
    assert contrast(CHROME["alarm"][scheme], CHROME["alarm_wash"][scheme]) >= 4.5
    for pair in (*PALETTE, CHROME["observed"]):
        assert contrast(pair[scheme], CHROME["paper"][scheme]) >= 3, pair


def test_no_two_sources_are_drawn_alike() -> None:
    points = {(colour_index(name), symbol(name)) for name in SOURCES}
    lines = {(colour_index(name), dash(name)) for name in SOURCES}
    assert len(points) == len(lines) == len(SOURCES)


def test_labels() -> None:
    assert class_name("Motor_1_Stuck") == "M1 stuck"
    assert class_name("Motor_3_Steady_state_error") == "M3 bias"
    assert class_name("Healthy") == "Healthy"
    assert (number(-0.5), number(float("nan")), number(-0.0001, 3)) == ("−0.500", "–", "0.000")
    assert (signed(0.1), signed(0.0001, 3), signed(-0.1)) == ("+0.100", "0.000", "−0.100")
    assert (p_value(0.0002), p_value(0.04), p_value(None)) == ("< 0.001", "0.040", "–")
    assert [duration(each) for each in (0.02, 5, 300, 30600, None)] == [
        "20 ms",
        "5.0 s",
        "5.0 min",
        "8.5 h",
        "–",
    ]


def test_digits_show_the_difference() -> None:
    """0.98 mV beside 1.02 mV is not 0.001 V beside 0.001 V."""
    assert (number(0.00098), number(0.00102)) == ("0.000980", "0.00102")
    assert (number(0.0106), number(0.0114), number(0.45)) == ("0.0106", "0.0114", "0.450")
    assert span((0.00098, 0.00102)) == "0.00098 to 0.00102"
    small = Comparison(a="a", b="b", metric="rmse", mean_diff=-4e-5, bootstrap_ci95=(-6e-5, -1e-6))
    assert difference(small, []) == ("−0.0000400", "−0.0000600 to −0.0000010")
    wide = Comparison(a="a", b="b", metric="rmse", mean_diff=-4e-5, bootstrap_ci95=(-0.2, 0.1))
    assert difference(wide, [])[0] == "0.000"


def test_scores_have_the_unit_of_the_outputs() -> None:
    small = Comparison(a="a", b="b", metric="rmse", mean_diff=-4e-5, bootstrap_ci95=(-6e-5, -1e-6))
    assert difference(small, ["m", "m"]) == ("−0.0400 mm", "−0.0600 to −0.0010 mm")
    assert difference(small, ["V"]) == ("−0.0000400 V", "−0.0000600 to −0.0000010 V")
    assert scored(0.0049, "crps", ["m"]) == "4.900 mm"
    assert scored(0.892, "macro_f1", ["m"]) == "0.892"


def test_ends_of_wide_intervals_are_rounded_outwards() -> None:
    assert percents((0.0002, 0.9998)) == "0 to 100 %"
    assert percents((0.57, 1.004)) == "57 to 100.4 %", "a ratio may exceed 1"
    assert percents((0.004, 0.46)) == "0.4 to 46 %"
    assert percents((0.9992, 0.9998)) == "99.9 to 99.98 %"
