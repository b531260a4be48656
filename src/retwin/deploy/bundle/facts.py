"""`Facts`: the values of a case that a bundle keeps, so that it works without the case's code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from retwin.checks import same_names, whole
from retwin.serialisation.configs import from_config, to_config
from retwin.times import sample_rate
from retwin.twins.commands.samplers import RampSampler
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import FAULTS

SAMPLERS = (RampSampler,)
"""Kinds of command samplers that a bundle can describe; others remain code of the case."""


@dataclass(frozen=True)
class Facts:
    """The part of a `Case` that is plain values.

    Attributes
    ----------
    case : str
        Name of the case.
    faults : mapping of str to Fault or None
        Fault of each class, None for the healthy one, in the order of the classes.
    sensor_rate : float
        Measurements per second of the real sensor, in Hz.
    steps : int
        Samples per trajectory, at least 2.
    max_segments : int
        Greatest number of segments in a trajectory, at most `steps`.
    sampler : RampSampler or None
        Command sampler; None if commands are drawn by code of the case.

    Raises
    ------
    InputError
        If a number is outside its range.

    """

    case: str
    faults: Mapping[str, Fault | None]
    sensor_rate: float
    steps: int
    max_segments: int
    sampler: RampSampler | None = None

    def __post_init__(self) -> None:
        remedy = "take it from the case"
        whole("facts.steps", self.steps, at_least=2, remedy=remedy)
        whole("facts.max_segments", self.max_segments, at_most=self.steps, remedy=remedy)
        sample_rate("facts.sensor_rate", self.sensor_rate, remedy=remedy)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes in their fixed order."""
        return tuple(self.faults)

    def check_classes(self, diagnoser: Any) -> None:
        """Raise InputError unless a diagnoser, if there is one, has these classes, each once."""
        given = self.classes if diagnoser is None else diagnoser.classes
        what, remedy = (
            f"one of the classes of {self.case},",
            "train it on trajectories of this case",
        )
        same_names("diagnoser", given, self.classes, what, remedy=remedy)

    def about(self) -> dict[str, Any]:
        """The facts as JSON values; InputError for a fault that is none of `FAULTS`."""
        return {
            "case": self.case,
            "faults": {
                name: None if fault is None else to_config(fault, FAULTS)
                for name, fault in self.faults.items()
            },
            "sensor_rate": self.sensor_rate,
            "steps": self.steps,
            "movements": self.max_segments,
            "sampler": None if self.sampler is None else to_config(self.sampler, SAMPLERS),
        }

    @classmethod
    def of(cls, about: Mapping[str, Any]) -> Facts:
        """The facts from the JSON values of `about`."""
        faults = {
            name: None if fault is None else from_config(fault, FAULTS)
            for name, fault in about["faults"].items()
        }
        sampler = about["sampler"]
        return cls(
            case=str(about["case"]),
            faults=faults,
            sensor_rate=about["sensor_rate"],
            steps=about["steps"],
            max_segments=about["movements"],
            sampler=None if sampler is None else from_config(sampler, SAMPLERS),
        )
