"""`Machine`: what is known of a machine that is watched, whichever kind of monitor watches it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from numpy.typing import NDArray

from retwin.monitor.store.samples import Asset

KEPT = 600
"""Newest samples or trajectories that are kept for pages."""
Watching = TypeVar("Watching")


@dataclass
class Counts:
    """Samples by what was done with them.

    Attributes
    ----------
    used : int
        Stored, and used or waiting for an earlier one.
    repeated : int
        Stored before, with the same time.
    late : int
        Not stored: their place was passed.
    ahead : int
        Not stored: their time is in the future.
    extra : int
        Not stored: their place has another sample.
    unknown : int
        Not stored: before the first sample of which all commands are known.
    refused : int
        Not stored: trajectories that their monitor cannot use, and samples outside of one.

    """

    used: int = 0
    repeated: int = 0
    late: int = 0
    ahead: int = 0
    extra: int = 0
    unknown: int = 0
    refused: int = 0

    def add(self, other: Counts) -> None:
        """Add the counts of further samples."""
        for name, count in vars(other).items():
            setattr(self, name, getattr(self, name) + count)


@dataclass(frozen=True, eq=False)
class Recent:
    """The newest samples of a machine.

    Attributes
    ----------
    times : NDArray
        (n,), of the places, in nanoseconds since the epoch.
    commands, measured : NDArray
        (n, d_u) and (n, d_y); NaN where missing.
    mean, deviation : NDArray
        (n, d_y), predictions of each sample from those before.
    evidence : NDArray
        (n,), that of a change.

    """

    times: NDArray
    commands: NDArray
    measured: NDArray
    mean: NDArray
    deviation: NDArray
    evidence: NDArray


class Machine(Generic[Watching]):
    """A watched machine; its streams or trajectories are those of a class of its own.

    Parameters
    ----------
    asset : Asset
        The asset, with the version of its twin.
    monitor : Monitor or TrajectoryMonitor
        That version.

    Attributes
    ----------
    entries : list of (str, dict)
        New entries of the log, which are stored with the next commit.
    counts : Counts
        Samples or trajectories since the program was started, by what was done with them.
    newest : int or None
        Time of the newest sample in nanoseconds; None before the first.
    evidence : float
        That of a change, after the newest sample.
    alarms : int
        Events since the program was started.
    last_alarm : int or None
        Time of the begin of the last one of these.
    event, void, outside : bool
        Whether an event lasts, whether the promise does not apply any more, and whether commands
        have left their range in calibration.

    """

    def __init__(self, asset: Asset, monitor: Watching) -> None:
        self.asset = asset
        self.monitor = monitor
        self.entries: list[tuple[str, dict[str, Any]]] = []
        self.counts = Counts()
        self.newest: int | None = None
        self.evidence = 0.0
        self.alarms = 0
        self.last_alarm: int | None = None
        self.event = self.void = self.outside = False

    @property
    def rate(self) -> str:
        """How the sample rate differs from the twin's; "" if it does not."""
        return ""

    @property
    def impossible(self) -> str:
        """Which channels have had impossible values; "" for none."""
        return ""

    def committed(self) -> None:
        """Everything is stored."""
        self.entries = []

    def log(self, kind: str, moment: int, **data: Any) -> None:
        """Add an entry about this machine at a time in nanoseconds."""
        about = {"asset": self.asset.name, "version": self.asset.version, "time": moment}
        self.entries.append((kind, {**about, **data}))


@dataclass(frozen=True)
class Received:
    """What became of samples or of a trajectory of one machine; see docs/monitor.md.

    Attributes
    ----------
    asset : str
        Its name.
    counts : Counts
        Samples by what was done with them; a trajectory counts once.
    alarms : int
        Events that began when they were used.

    """

    asset: str
    counts: Counts
    alarms: int


@dataclass(frozen=True)
class AssetStatus:
    """How a machine is.

    Attributes
    ----------
    asset, twin : str
        Its name, and that of its twin.
    version : int
        The version of the twin that watches it.
    time : int, optional
        Time of its newest sample in nanoseconds; None before the first.
    ratio : float
        Evidence for a change, over the threshold of an alarm.
    alarms : int
        Events since the program was started.
    last_alarm : int, optional
        Time of the last one of these.
    event, void, outside : bool
        Whether an event lasts, whether the promise does not apply any more, and whether commands
        have left their range in calibration.
    rate : str
        How the sample rate differs from the twin's; "" if it does not.
    counts : dict of str to int
        Samples since the program was started, by what was done with them.
    impossible : str
        Which channels have had impossible values; "" for none.

    """

    asset: str
    twin: str
    version: int
    time: int | None
    ratio: float
    alarms: int
    last_alarm: int | None
    event: bool
    void: bool
    outside: bool
    rate: str
    counts: dict[str, int]
    impossible: str = ""

    @classmethod
    def of(cls, machine: Machine[Any]) -> AssetStatus:
        """The status of a machine."""
        same = ("alarms", "last_alarm", "event", "void", "outside", "rate", "impossible")
        return cls(
            asset=machine.asset.name,
            twin=machine.asset.settings["twin"],
            version=machine.asset.version or 0,
            time=machine.newest,
            ratio=machine.evidence / machine.monitor.arl,
            counts=vars(machine.counts).copy(),
            **{name: getattr(machine, name) for name in same},
        )
