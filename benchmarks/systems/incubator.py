"""The incubator, H. Feng et al. (2021): heater and room temperature to that of the air in a box.

Four records of four days, the last one until the lid is opened; each calibrates, and the next one
tests. The starts of a test record are inferred from its first 120 s.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from retwin.cases.styrofoam_incubator.case import WARM_UP, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from systems.system import System

GUESS = {"c_air": 500.0, "g_box": 0.5, "c_heater": 50.0, "g_heater": 1.0}
"""Parameters before identification: those of the built-in twin have seen the first record."""
DAYS = ("2020-09-18", "2020-12-21", "2020-12-22", "2021-01-22")


def incubator(folder: Path, index: int) -> System:
    first, others = measurements(warm_up=0)(folder / "incubator")
    records = [first, *(others[[i]] for i in range(len(others)))]
    records = [each.between(0, float(each.lengths[0]) / each.rate) for each in records]
    after = (index + 1) % len(DAYS)
    row = f"incubator, {DAYS[index]} → {DAYS[after]}"
    tests = {row: records[after]}
    return System(
        INCUBATOR.parametric().with_values(GUESS), records[index], tests, "K", warm_up=WARM_UP
    )


SYSTEMS = {f"incubator_{i + 1}": partial(incubator, index=i) for i in range(len(DAYS))}
