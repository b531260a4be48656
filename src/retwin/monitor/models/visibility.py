"""What a monitor sees: sizes of faults that raise an alarm nine times of ten within a stated time.

The effect of a fault is that which the twin simulates, added to healthy records as they were
measured, and the monitor watches the sum. So noise and dependence are those of the machine.
"""

from __future__ import annotations

import sys
import warnings
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.monitor.models.cause import output_levels, size_unit
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.state import SHARE, Visible
from retwin.progress import Progress, tracked
from retwin.twins.collected import SimulationError
from retwin.twins.faults.actuator_faults import Fault, Stuck
from retwin.twins.faults.system_faults import (
    ActuatorGain,
    ParameterFault,
    SensorBias,
    SensorError,
    SensorFreeze,
    SensorGain,
    SizedFault,
    TimedFault,
    measured_with,
)
from retwin.twins.twin import check_channels
from retwin.update.dynamics.twin import DynamicsTwin

ONSETS = 20
"""Onsets that are tried of each fault and size, at most."""
LONGER = 10
"""Samples within which an alarm counts, over those in which a shift by one deviation is seen."""
HALVINGS = 12
"""Times that the largest size is halved, at most."""


def visible_sizes(
    monitor: Monitor,
    healthy: Trajectories,
    faults: Mapping[str, Fault | None],
    *,
    progress: Progress | None = None,
) -> list[Visible]:
    """Which faults the monitor sees, and from what size on.

    Parameters
    ----------
    monitor : Monitor
        The monitor.
    healthy : Trajectories
        Healthy records of the machine, to which the effects of faults are added.
    faults : mapping of str to Fault or None
        The faults, such as `possible_causes`; of those that have no onset nothing is said. The
        largest size of a range is halved until it is not seen any more.
    progress : callable, optional
        Called with the share of the faults that were tried.

    Raises
    ------
    InputError
        Other channels or another rate than those of the twin.

    """
    check_channels(monitor.twin, healthy, "healthy")
    windows = _windows(monitor, healthy)
    within = (windows.steps - windows.lead) / healthy.rate
    made = []
    for name, fault in tracked(faults.items(), len(faults), progress):
        if not isinstance(fault, TimedFault | Stuck):
            continue
        ends = np.atleast_1d(fault.size).tolist() if isinstance(fault, SizedFault) else []
        largest = max(ends, key=abs, default=None)
        sizes = [None] if largest is None else [largest / 2**i for i in range(HALVINGS + 1)]
        best, share = _smallest(sizes, partial(_share, monitor, windows, fault))
        if np.isfinite(share):  # of a fault that the twin can simulate
            unit = size_unit(fault, monitor.twin)
            value = _value_behind(fault, monitor.twin)
            compared = "range" if isinstance(fault, SensorBias) else "value"
            made.append(Visible(name, best, largest, share, within, unit, value, compared))
    return made


def _smallest(
    sizes: Sequence[float | None], share: Callable[[float | None], float]
) -> tuple[float | None, float]:
    """The smallest of sizes that is seen, of which the largest is first, and its share.

    None where the largest one is not seen, with the share of that one.
    """
    known = cache(share)
    if not known(sizes[0]) >= SHARE:
        return None, known(sizes[0])
    # Larger sizes are seen, smaller ones are not.
    unseen = bisect_left(sizes, True, lo=1, key=lambda size: not known(size) >= SHARE)
    return sizes[unseen - 1], known(sizes[unseen - 1])


def _value_behind(fault: Fault | None, twin: DynamicsTwin) -> float | None:
    """What a fault's size is compared with, see `Visible`."""
    if isinstance(fault, ParameterFault) and not fault.grows:
        values = dict(zip(twin.equations.names, twin.values.tolist(), strict=True))
        return values.get(fault.parameter)
    if isinstance(fault, SensorBias):
        return output_levels(twin)[1][fault.output]
    return 1.0 if isinstance(fault, ActuatorGain | SensorGain) else None


@dataclass(frozen=True)
class _Windows:
    """Parts of healthy records: the records that they are in, and their first samples."""

    commands: NDArray
    observed: NDArray
    mask: NDArray
    first: NDArray
    lead: int
    steps: int

    def cut(self, values: NDArray) -> NDArray:
        """The parts (n, steps, ...) of values of their records."""
        pairs = zip(values, self.first, strict=True)
        return np.stack([record[first : first + self.steps] for record, first in pairs])


def _windows(monitor: Monitor, healthy: Trajectories) -> _Windows:
    """Parts that begin evenly in the records, with the number of samples before the onset."""
    wanted = monitor.rules.wanted
    lead = round(monitor.warm_up * monitor.twin.rate) + wanted
    count = healthy.mask.any(axis=2).sum(axis=1)
    steps = min(lead + LONGER * wanted, max(int(count.max()) // 2, 2))
    lead = min(lead, steps // 2)
    starts = [
        (i, first)
        for i in range(len(healthy))
        for first in range(0, int(count[i]) - steps + 1, max(1, steps // 8))
    ]
    even = np.linspace(0, len(starts) - 1, min(ONSETS, len(starts)))
    chosen = np.array(starts)[even.round().astype(int)]
    rows, first = chosen.T
    observed, mask = healthy.observed[rows], healthy.mask[rows]
    return _Windows(healthy.commands[rows], observed, mask, first, lead, steps)


def _share(
    monitor: Monitor, windows: _Windows, fault: TimedFault | Stuck, size: float | None
) -> float:
    """The share of windows with an alarm after the onset, of those without one before.

    NaN if the fault cannot be simulated, or all windows have an alarm before.
    """
    changed: dict[str, Any] = ({} if size is None else {"size": size}) | (
        {"end": None} if isinstance(fault, TimedFault) else {}
    )
    rate, observed = monitor.twin.rate, windows.observed
    onsets = (windows.first + windows.lead) / rate
    faults = [replace(fault, onset=onset, **changed) for onset in onsets.tolist()]
    if isinstance(fault, SensorError | SensorFreeze):
        observed = measured_with(observed, faults, rate)
    else:
        with warnings.catch_warnings():  # of ranges, which faults may leave
            warnings.simplefilter("ignore")
            try:
                faulty, calm = (
                    monitor.twin.simulate(windows.commands, faults=each, seed=0).observed
                    for each in (faults, None)
                )
            except SimulationError:
                return np.nan
        observed = observed + (faulty - calm)
    measured = windows.cut(np.where(windows.mask, observed, np.nan))
    # Only the first alarm counts: one that never alarms does not begin anew after each of them.
    silent = replace(monitor, arl=sys.float_info.max)
    state, known = silent.start(len(measured)), windows.cut(windows.commands)
    alarm = monitor.rules.alarms(silent.step(state, known, measured)[1].evidence)
    quiet = np.flatnonzero(~alarm[:, : windows.lead].any(axis=1))
    return float(alarm[quiet, windows.lead :].any(axis=1).mean()) if len(quiet) else np.nan
