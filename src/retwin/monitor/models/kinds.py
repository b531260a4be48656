"""The two kinds of monitors: of samples of a machine with a state, and of whole trajectories."""

from __future__ import annotations

from pathlib import Path

from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.trajectory.monitor import KIND, TrajectoryMonitor
from retwin.serialisation.models import kind_of

AnyMonitor = Monitor | TrajectoryMonitor


def load_monitor(folder: str | Path) -> AnyMonitor:
    """Read a monitor of either kind; InputError if the folder holds none or is damaged."""
    kind = TrajectoryMonitor if kind_of(Path(folder)) == KIND else Monitor
    return kind.load(folder)


def pace(monitor: AnyMonitor) -> float:
    """What the average run length counts, samples or trajectories, in a second of work."""
    if isinstance(monitor, TrajectoryMonitor):
        return 1 / monitor.duration
    return float(monitor.twin.rate)
