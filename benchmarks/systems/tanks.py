"""The cascaded tanks, M. Schoukens and J. P. Noël (2017): the simple twin, and physics first.

The estimation record calibrates. The validation record is simulated from the state that both
records begin with, so that no level of it is used.
"""

from __future__ import annotations

from pathlib import Path

import retwin as rt
from retwin.cases.cascaded_tanks.twin import OVERFLOWING_TANKS, TANKS
from systems.system import System

PUBLISHED = (
    "0.34 nonlinear state space, 0.45 polynomial nonlinear state space (quoted in Mathematical "
    "Problems in Engineering, 2021; see results/tanks.md)"
)


def tanks(folder: Path, row: str, twin: rt.ParametricTwin) -> System:
    records = rt.cases.get("tanks").records
    assert records is not None
    calibration, test = records(folder / "cascaded_tanks" / "dataBenchmark.csv")
    return System(twin, calibration, {row: test}, "V", published=PUBLISHED, data="tanks")


SYSTEMS = {
    "tanks": lambda folder: tanks(folder, "tanks, simple twin", TANKS.parametric()),
    "tanks_physics": lambda folder: tanks(
        folder, "tanks, physics first", OVERFLOWING_TANKS.parametric()
    ),
}
