"""What became of samples, and how machines are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from retwin.monitor.live.machine import Counts, Machine


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
    def of(cls, machine: Machine[Any], arl: float) -> AssetStatus:
        """The status of a machine whose alarms have that threshold."""
        same = ("alarms", "last_alarm", "event", "void", "outside", "rate", "impossible")
        return cls(
            asset=machine.asset.name,
            twin=machine.asset.settings["twin"],
            version=machine.asset.version or 0,
            time=machine.newest,
            ratio=machine.evidence / arl,
            counts=vars(machine.counts).copy(),
            **{name: getattr(machine, name) for name in same},
        )
