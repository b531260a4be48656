"""The Silverbox, T. Wigren and J. Schoukens (2013): an electronic Duffing oscillator.

Realisations 1 to 9 of the multisine calibrate; realisation 10 and the arrow, whose last quarter
extrapolates in amplitude, test, without their first 50 samples. The twin is the linear oscillator.
"""

from __future__ import annotations

from pathlib import Path

import retwin as rt
from retwin.cases.silver_box.twin import SILVERBOX
from systems.system import System


def silverbox(folder: Path) -> System:
    records = rt.cases.get("silverbox").records
    assert records is not None
    calibration, test = records(folder / "silverbox" / "SNLS80mV.csv")
    tests = {"Silverbox, multisine": test[[0]], "Silverbox, arrow": test[[1]]}
    twin = SILVERBOX.parametric().holding("square", "cubic", "feedthrough")
    published = "about 0.3 (nonlinear state space)"
    return System(twin, calibration, tests, "mV", 1000.0, published=published)


SYSTEMS = {"silverbox": silverbox}
