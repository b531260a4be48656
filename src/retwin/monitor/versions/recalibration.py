"""A new calibration of a machine's monitor, from the last quiet hours that are stored."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite, given, instance, require
from retwin.data.trajectories import Trajectories
from retwin.monitor.detect.events import CHANGED
from retwin.monitor.live.notifications import sentence
from retwin.monitor.models.cause import BEFORE
from retwin.monitor.models.fitting import fit_monitor
from retwin.monitor.models.kinds import load_monitor
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.store.gridded import gridded, record_of
from retwin.monitor.store.samples import SECOND
from retwin.monitor.store.store import Store
from retwin.monitor.versions.comparison import collect_times
from retwin.monitor.versions.decision import MIN_SAMPLES
from retwin.monitor.versions.registry import Registry, Version


def recalibrate(store: Store, asset: str, *, hours: float = 24.0, new_normal: str = "") -> Version:
    """Calibrate the monitor of a machine anew, as a version that runs in the shadow first.

    The twin stays; its errors are those of the machine's newest samples outside of events, each
    quiet part a record. The promised rate is the one that was wanted of the active version.

    Parameters
    ----------
    store : Store
        The store, open to write.
    asset : str
        Name of the machine.
    hours : float
        Newest hours from which quiet parts are taken.
    new_normal : str
        The name of somebody who says that what has changed the machine is its new normal, which
        the version keeps: then the samples since the change calibrate, and none before it.

    Raises
    ------
    InputError
        There is no such machine or no active version; an event lasts, or the last one was a change,
        and nobody says that it is the new normal: then the message states what is known of it; or
        too few samples are quiet.

    """
    assets = {each.name: each for each in store.assets()}
    known = ", ".join(assets) or "none"
    machine = given("asset", assets.get(asset), f"one of {known}", got=asset, remedy="name one")
    registry = Registry(store, machine.settings.get("twin", "twin"))
    remedy = "promote the first version"
    active = given("versions", registry.active, "an active version", remedy=remedy)
    stored = load_monitor(registry.folder(active.number))
    monitor = instance("monitor", stored, Monitor, remedy="calibrate it by retwin monitor fit")
    state = given("samples", store.state(asset), "stored samples", remedy="watch it first")
    newest, span = state[0], finite("hours", hours, at_least=0.01, at_most=1e5, unit="h")
    begun, quiet = _events(store, asset, new_normal)
    first = max(newest - round(span * 3600 * SECOND), begun)
    times, rows = gridded(store, asset, monitor.twin, first, newest)
    parts = _parts(times, rows, quiet, round(BEFORE * SECOND / monitor.twin.rate))
    inputs = len(monitor.twin.inputs)
    seen = sum(int(np.isfinite(each[:, inputs:]).any(axis=1).sum()) for each in parts)
    expected = f"at least {2 * MIN_SAMPLES / monitor.twin.rate:g} s outside of events in the "
    expected += f"last {span:g} h"
    got = f"{seen / monitor.twin.rate:g} s"
    remedy = "wait until the machine has run for longer without an event"
    require(seen >= 2 * MIN_SAMPLES, "samples", expected=expected, got=got, remedy=remedy)
    records = [record_of(monitor.twin, each) for each in parts]
    names = [f"quiet part {i + 1}" for i in range(len(records))]
    healthy = Trajectories.concatenate(
        [each.replace(ids=np.array([name])) for each, name in zip(records, names, strict=True)]
    )
    new = fit_monitor(
        monitor.twin, healthy, monitor.arl, lasting=monitor.lasting, alpha=monitor.alpha
    )
    with tempfile.TemporaryDirectory(prefix="retwin-") as folder:
        new.save(Path(folder) / "monitor")
        reason = f"{seen / monitor.twin.rate / 3600:.3g} quiet hours of {asset}"
        reason += f", a new normal as {new_normal} says" if new_normal else ""
        proposed = registry.propose(Path(folder) / "monitor", reason)
    return registry.shadow(proposed.number)


def _events(store: Store, asset: str, new_normal: str) -> tuple[int, list[tuple[int, int]]]:
    """When the machine of now began, and when the events since then did, and ended.

    Raises
    ------
    InputError
        An event lasts, or was a change, and nobody says that it is the new normal.

    """
    opened = set(collect_times(store, "event", "alarm", "remark").get(asset, []))
    ends = [entry.data for entry in store.log("end") if entry.data["asset"] == asset]
    closed = {int(each["event"]): int(each["time"]) for each in ends}
    lasting = sorted(opened - closed.keys())
    changes = [int(each["event"]) for each in ends if each["how"] == CHANGED]
    last = max((*lasting, *changes), default=None)
    require(
        last is None or new_normal.strip(),
        "new_normal",
        expected="a machine that is as it was, or the name of who says that its change is normal",
        got="an event that "
        + ("lasts" if lasting else "did not end until it was a change")
        + (f": {_describe_event(store, asset, last)}" if last is not None else ""),
        remedy="find out whether it is a fault, and repair that; if it is the new normal, say so "
        "with your name: --new-normal NAME",
    )
    begun = last if last is not None else np.iinfo(np.int64).min
    return int(begun), [(start, end) for start, end in closed.items() if start > begun]


def _describe_event(store: Store, asset: str, event: int) -> str:
    """What the log says of an event of a machine, from which somebody decides what it is."""
    alarms, found = set[int](), list[str]()
    for entry in store.log():
        data = entry.data
        if data.get("asset") == asset and data.get("event") == event:
            alarms.add(entry.sequence)
        elif entry.kind != "cause" or data["alarm"] not in alarms:
            continue
        found.append(sentence(entry))
    return "; ".join(filter(None, found))


def _parts(
    times: NDArray, rows: NDArray, events: list[tuple[int, int]], margin: int
) -> list[NDArray]:
    """The parts (T, d_u + d_y) of samples that are in no event, nor `margin` ns before one."""
    calm = np.ones(len(times), dtype=bool)
    for start, end in events:
        calm &= (times < start - margin) | (times > end)
    edges = np.flatnonzero(np.diff(calm.astype(int))) + 1
    cut = zip(np.split(rows, edges), np.split(calm, edges), strict=True)
    return [part for part, quiet in cut if len(part) >= MIN_SAMPLES and quiet[0]]
