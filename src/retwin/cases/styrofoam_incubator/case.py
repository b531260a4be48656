"""The incubator: from a heater's switch and the room's temperature to that of the air in a box.

A folder of CSV files has a record of random heating, which calibrates, and three with a controller,
which test; the last ends where the lid is opened. A sample every 3 s, quantised to 1/16 K; the
air's temperature is the mean of two sensors.
"""

from __future__ import annotations

from collections.abc import Mapping

from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords, Record
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.cases.time_column import TimeColumn
from retwin.nets.networks import LSTM
from retwin.twins.commands.samplers import HoldSampler
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import (
    ActuatorGain,
    ParameterShift,
    SensorBias,
    SensorDrift,
    SensorFreeze,
)
from retwin.update.corrections import Additive
from retwin.update.residual import SequenceMixture

COLUMNS: Mapping[str, str | tuple[str, ...]] = {
    "heater": "heater_on",
    "room": "t1",
    "air": ("t2", "t3"),
}
CONTROLLED = ("2020-12-21_controller_1.csv", "2020-12-22_controller_2.csv")
LID = 220
"""Row of the record of 2021-01-22 at which the lid is first open."""
WARM_UP = 120.0
"""Duration in s at the begin of a test record that is not scored: the heater's temperature at the
first sample is unknown, and is inferred from it."""

CAUSES: Mapping[str, Fault] = {
    "lid": ParameterShift("g_box", size=(0.3, 20.0)),
    "heater": ActuatorGain(0, size=(-1.0, -0.1)),
    "sensor bias": SensorBias(0, size=(-10.0, 10.0)),
    "sensor drift": SensorDrift(0, size=(-0.1, 0.1)),
    "frozen sensor": SensorFreeze(0),
}
"""What may cause an alarm."""


def measurements(warm_up: float = WARM_UP) -> ColumnRecords:
    """The records in the folder of the CSV files.

    Parameters
    ----------
    warm_up : float
        Duration in s at the begin of the test records whose outputs are masked.

    Returns
    -------
    ColumnRecords
        A function from the folder to both sets.

    """
    seconds, nanoseconds = TimeColumn("time"), TimeColumn("time", "ns")
    return ColumnRecords(
        INCUBATOR,
        Record(COLUMNS, files="2020-09-18_calibration.csv", time=seconds),
        (
            Record(COLUMNS, transient=warm_up, files=CONTROLLED, time=seconds),
            Record(COLUMNS, (0, LID), warm_up, "2021-01-22_lid.csv", nanoseconds),
        ),
    )


def incubator() -> Case:
    """The case with the twin of four parameters; it has no faults, so nothing is diagnosed.

    A monitor distinguishes an open lid, a weak heater and faults of the sensor.

    Returns
    -------
    Case
        The case `incubator`.

    """
    return Case(
        name="incubator",
        title="Incubator",
        twin=INCUBATOR,
        sampler=HoldSampler((0.0, 20.0), (1.0, 25.0), INCUBATOR.rate, 3000.0, (30.0, 600.0)),
        correction=Additive(),
        output_correction=Additive(),
        sensor_rate=INCUBATOR.rate,
        parametric=INCUBATOR.parametric(),
        network=LSTM(64),
        density=SequenceMixture(block=64, margin=32),
        records=measurements(),
        causes=CAUSES,
    )
