"""What to check on the machine, by the kind of fault that explains an alarm."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from retwin.data.trajectories import HEALTHY
from retwin.monitor.models.kinds import AnyMonitor
from retwin.twins.faults.system_faults import (
    ActuatorGain,
    ParameterDrift,
    ParameterShift,
    SensorBias,
    SensorDrift,
    SensorFreeze,
)

SENTENCES: Mapping[type, Callable[[Any, AnyMonitor], str]] = {
    ParameterShift: lambda fault, monitor: (
        "The machine has changed. Look for something that is open, leaks, is clogged, worn, loose "
        f"or was replaced. Details: parameter {fault.parameter} of the twin."
    ),
    ParameterDrift: lambda fault, monitor: (
        "The machine changes slowly. Look for what wears, fouls, ages, heats up or loosens, and "
        f"compare it with earlier records. Details: parameter {fault.parameter} of the twin."
    ),
    ActuatorGain: lambda fault, monitor: (
        f"The machine does not do what the command {_input(fault, monitor)} demands. Check the "
        "actuator: its supply, its connection, its wear, and whether something limits or overrides "
        "the command."
    ),
    SensorBias: lambda fault, monitor: (
        f"The sensor of {_output(fault, monitor)} is offset. Compare it with a second instrument, "
        "and check its mounting, its reference and its calibration."
    ),
    SensorDrift: lambda fault, monitor: (
        f"The error of the sensor of {_output(fault, monitor)} grows with time. Compare it with a "
        "second instrument now and again later, and check it for dirt, moisture and ageing."
    ),
    SensorFreeze: lambda fault, monitor: (
        f"The sensor of {_output(fault, monitor)} repeats the same value. Check its cable, its bus "
        "and the program that reads it, and whether its value changes when it must."
    ),
}
NOTHING = (
    "None of the known faults explains the alarm better than the healthy machine does. Look at the "
    "samples around it; a single disturbance from outside is possible, and so is a false alarm."
)
UNNAMED = (
    "Compare what the machine does on site with what it is commanded and with what its sensors "
    "show, and find out what was changed on it."
)
"""Where the cause is of another kind."""


def what_to_check(name: str, fault: object, monitor: AnyMonitor) -> str:
    """A sentence or two on what to check first, for the fault that a cause names."""
    if name == HEALTHY:
        return NOTHING
    found = SENTENCES.get(type(fault))
    return found(fault, monitor) if found else UNNAMED


def _input(fault: ActuatorGain, monitor: AnyMonitor) -> str:
    return monitor.twin.inputs.names[fault.actuator]


def _output(fault: SensorBias | SensorDrift | SensorFreeze, monitor: AnyMonitor) -> str:
    return monitor.twin.outputs.names[fault.output]
