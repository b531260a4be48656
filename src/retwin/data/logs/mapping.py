"""`mapping.toml`: which signals of a log are which channels, and what a trajectory is in it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from retwin.data.logs.signals import Clock, TimeUnit
from retwin.data.resampling import Resampling
from retwin.serialisation.configs import Part, settings_of

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=500)]
NO_NOMINAL = "no nominal outputs: they are 0; give the case, whose twin simulates them"
"""What the provenance says of a log that was read without a twin."""
REMEDY = "see docs/data.md for what it holds"


class TimeSettings(Part):
    """Where the log has its times; formats with times of their own need nothing of it."""

    column: str = ""
    """Column of the times, or channel of a TDMS group; by default one that is named so."""
    unit: TimeUnit = ""
    """Its unit, or ISO 8601 text; by default the one that the file states, else by the size of the
    numbers."""
    format: Annotated[str, Field(max_length=100)] = ""
    """Format of other text, as Python's strptime reads it, such as "%d.%m.%Y %H:%M:%S,%f"."""
    rate: Positive | None = None
    """Rows per s, where there is no column of times."""
    stamps: Literal["log", "header"] = "log"
    """Whether ROS messages have the time of their recording, or the stamp of their header, where
    they have one."""

    @property
    def clock(self) -> Clock:
        """The same for readers."""
        return Clock(self.column, self.unit, self.format, self.rate, self.stamps)


class Cut(Part):
    """What starts a trajectory, and what ends it."""

    by: Literal["none", "gap", "trigger", "length"] = "none"
    """`none`: the log is one trajectory. `gap`: one begins after each interval in which nothing was
    logged. `trigger`: one begins when a signal crosses a level. `length`: one after the other, of
    the same length."""
    gap: Positive | None = None
    """Interval in s without any value of the mapped signals that ends a trajectory; for `gap`."""
    signal: Name | None = None
    """Signal that triggers; it need not be a channel."""
    level: Finite = 0.5
    """Level that it crosses."""
    edge: Literal["rising", "falling"] = "rising"
    """Direction in which it crosses the level."""
    before: Seconds = 0.0
    """Time in s before the trigger at which the trajectory begins."""
    length: Positive | None = None
    """Length in s of a trajectory, which for `trigger` ends when the next one begins, at the
    latest."""
    min_length: Positive | None = None
    """Shorter trajectories are left out; in s, by default two samples."""

    @model_validator(mode="after")
    def _complete(self) -> Cut:
        needed = {"gap": self.gap, "trigger": self.signal, "length": self.length}
        if self.by in needed and needed[self.by] is None:
            key = "signal" if self.by == "trigger" else self.by
            raise ValueError(f'`{key}` with by = "{self.by}"')
        return self


class ChannelMapping(Part):
    """A channel, and the signal that it is made from."""

    signal: Name | Annotated[list[Name], Field(min_length=1)]
    """Signal of the log: a column, "group/channel", or "/topic.field"; or several with the same
    times, of which it is the mean."""
    unit: Annotated[str, Field(max_length=100)] | None = None
    """Unit of the channel; by default that of the case, else that of the signal."""
    from_unit: Annotated[str, Field(max_length=100)] | None = None
    """Unit of the signal, where the log states none or a wrong one."""
    scale: Finite = 1.0
    """Factor by which values are multiplied, before units are converted."""
    shift: Finite = 0.0
    """What is then added to them."""
    clock_offset: Finite = 0.0
    """What is added to the times of the signal, in s; below 0 where its clock is ahead."""
    resample: Resampling | None = None
    """How values come to the sample rate: `hold` (by default for commands), `linear` (by default
    for outputs) or `none`, which takes a value at most half a sample period away."""
    max_gap: Positive | None = None
    """Longest interval in s between values that is bridged, and missing beyond; by default 2.5
    times the sample period or the median interval, whichever is longer."""

    @property
    def signals(self) -> tuple[str, ...]:
        """The signal, or the several of which it is the mean."""
        return (self.signal,) if isinstance(self.signal, str) else tuple(self.signal)

    @field_validator("signal", mode="before")
    @classmethod
    def _named(cls, signal: object) -> object:
        if signal == "":
            raise ValueError("the name of a signal: `retwin data map` lists them in comments")
        return signal


class Mapping(Part):
    """The keys of a mapping.toml; see docs/data.md."""

    rate: Positive | None = None
    """Sample rate of the trajectories in Hz; by default that of the case."""
    label: Annotated[str, Field(max_length=200)] = ""
    """Class of all trajectories of the log, such as "Healthy"; by default unknown."""
    time: TimeSettings = TimeSettings()
    """Where the log has its times."""
    cut: Cut = Cut()
    """What starts a trajectory."""
    commands: dict[Name, ChannelMapping] = Field(default={})
    """The commands by their names, in their order."""
    outputs: Annotated[dict[Name, ChannelMapping], Field(min_length=1)]
    """The measured outputs by their names, in their order."""
    nominal: dict[Name, ChannelMapping] = Field(default={})
    """The ideal outputs, where the log holds them: one for each output. By default the twin of the
    case simulates them."""

    @model_validator(mode="after")
    def _nominal_of_every_output(self) -> Mapping:
        if self.nominal and set(self.nominal) != set(self.outputs):
            raise ValueError("[nominal] for each of the outputs, or for none")
        return self

    @property
    def signals(self) -> frozenset[str]:
        """The signals that are needed of the log."""
        tables = (self.commands, self.outputs, self.nominal)
        found = {name for table in tables for each in table.values() for name in each.signals}
        return frozenset(found | ({self.cut.signal} if self.cut.signal else set()))


def read_mapping(path: str | os.PathLike[str]) -> Mapping:
    """The mapping in a file.

    Raises
    ------
    InputError
        The file is no TOML, a key is unknown or missing, or a value is refused. The message names
        the file and the key.

    """
    return settings_of(Mapping, Path(path), expected="a mapping.toml", remedy=REMEDY)
