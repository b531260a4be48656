"""Steps of many machines of one monitor at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.monitor.stream_machine import StreamMachine, Work
from retwin.monitor.watched import Alarm, Watched

__all__ = ["step"]


def step(together: Sequence[tuple[StreamMachine, Work]]) -> dict[str, int]:
    """Step machines of one monitor, each by as many samples; their numbers of alarms."""
    machines = [each for each, _ in together]
    monitor = machines[0].monitor
    layout = machines[0].layout
    before = layout.state(np.stack([machine.state_for(work) for machine, work in together]))
    values = np.stack([work.values for _, work in together])
    commands, measured = np.split(values, [len(monitor.twin.inputs)], axis=2)
    names = [each.asset.name for each in machines]
    after, watched = monitor.step(before, commands, measured, names)
    states = layout.rows(after)
    alarms: dict[str, list[Alarm]] = {name: [] for name in names}
    for alarm in watched.alarms:
        alarms[alarm.trajectory].append(alarm)
    for i, (machine, work) in enumerate(together):
        machine.stepped(work, states[i], _row(watched, i), alarms[machine.asset.name])
    return {name: len(each) for name, each in alarms.items()}


def _row(watched: Watched, i: int) -> dict[str, NDArray]:
    return {
        name: getattr(watched, name)[i]
        for name in ("mean", "deviation", "evidence", "void", "outside")
    }
