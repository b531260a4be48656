"""`System`: the classes, faults and commands from which labelled trajectories are generated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from retwin.twins.commands.samplers import CommandSampler
from retwin.twins.faults.actuator_faults import Fault


class System(Protocol):
    """What `generate` requires of a system; a `Case` satisfies it."""

    @property
    def faults(self) -> Mapping[str, Fault | None]:
        """Fault of each class, None for the healthy class, in the fixed order of the classes."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names in their fixed order."""

    @property
    def sampler(self) -> CommandSampler:
        """Distribution of the commands."""
