"""`Facts`: what a bundle keeps of its case, so that it is of use without the case's code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from retwin.errors import InputError
from retwin.serialisation.configs import from_config, to_config
from retwin.twins.faults import ActuatorBias, Fault, Stuck
from retwin.twins.samplers import RampSampler

__all__ = ["Facts"]

FAULTS = (Stuck, ActuatorBias)
SAMPLERS = (RampSampler,)


@dataclass(frozen=True)
class Facts:
    """The part of a `Case` that is plain values.

    Attributes
    ----------
    case: its name.
    faults: class name to fault, None for healthy, in the order of the classes.
    sensor_rate: samples per second that the measuring chain really takes.
    steps: samples per trajectory.
    movements: per trajectory, at most.
    sampler: draws commands; None for one that is code of the case.

    """

    case: str
    faults: Mapping[str, Fault | None]
    sensor_rate: float
    steps: int
    movements: int
    sampler: RampSampler | None = None

    def __post_init__(self) -> None:
        if not (self.steps >= 2 and self.movements >= 0 and self.sensor_rate > 0):
            raise InputError(
                "facts",
                expected="two steps or more, no negative number of movements, a positive rate",
                got=f"{self.steps}, {self.movements}, {self.sensor_rate}",
                remedy="take them from the case",
            )

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names in their fixed order."""
        return tuple(self.faults)

    def about(self) -> dict[str, Any]:
        """As plain values, for JSON; InputError for a fault that is not retwin's own."""
        return {
            "case": self.case,
            "faults": {
                name: None if fault is None else to_config(fault, FAULTS)
                for name, fault in self.faults.items()
            },
            "sensor_rate": self.sensor_rate,
            "steps": self.steps,
            "movements": self.movements,
            "sampler": None if self.sampler is None else to_config(self.sampler, SAMPLERS),
        }

    @classmethod
    def of(cls, about: Mapping[str, Any]) -> Facts:
        """From what `about` gave."""
        faults = {
            name: None if fault is None else from_config(fault, FAULTS)
            for name, fault in about["faults"].items()
        }
        sampler = about["sampler"]
        return cls(
            case=str(about["case"]),
            faults=faults,
            sensor_rate=float(about["sensor_rate"]),
            steps=int(about["steps"]),
            movements=int(about["movements"]),
            sampler=None if sampler is None else from_config(sampler, SAMPLERS),
        )
