"""A version of a twin compared with the active one, on samples that are stored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from retwin.checks import agree, given, require
from retwin.monitor.detect.promise import FalseAlarmTest
from retwin.monitor.models.cause import BEFORE
from retwin.monitor.models.kinds import load_monitor
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.trajectories import TrajectoryMonitor
from retwin.monitor.store.gridded import gridded
from retwin.monitor.store.samples import SECOND
from retwin.monitor.store.store import Store
from retwin.monitor.versions.decision import MIN_SAMPLES, Decision, decide, padded
from retwin.monitor.versions.registry import Registry
from retwin.monitor.versions.trajectory_comparison import compared_trajectories
from retwin.scores.distributions import crps_normal

MAX_SAMPLES = 20_000
"""Newest samples of each asset that are compared, which bounds time and memory."""
KINDS: Mapping[type, str] = {Monitor: "samples", TrajectoryMonitor: "trajectories"}


def compare(store: Store, twin: str, number: int) -> Decision:
    """Compare a version with the active one on the stored samples of all assets of the twin.

    Healthy samples or trajectories are needed. Those of an asset are the longest part of its newest
    ones without an alarm of the active version, without those before the next alarm in which its
    cause may already act. Of streams, the CRPS is that of one-step predictions; an asset is left
    out where the active version, begun anew, raises an alarm in that part. Of trajectories, it is
    that of simulations from their commands alone, see `retwin.evaluation.fidelity`: the evidence of
    two diagnosers is no score by which they could be compared, since it is divided by the
    autocorrelation that each has learned.

    The reference, the first version that was active, watches the same samples if it is neither of
    the two: its alarms are part of the decision, so that no update absorbs a slow fault unseen.

    Parameters
    ----------
    store : Store
        The store.
    twin : str
        The name of the twin.
    number : int
        The version.

    Raises
    ------
    InputError
        No version is active, there is no such version, it is a monitor of another kind, its
        channels or rate differ, or too few healthy samples or trajectories are stored.

    """
    registry = Registry(store, twin)
    remedy = "promote the first version"
    active = given("versions", registry.active, "an active version", remedy=remedy)
    old, new = (load_monitor(registry.folder(each)) for each in (active.number, number))
    require(
        type(old) is type(new),
        f"version {number}",
        expected=f"a monitor of {KINDS[type(old)]}, as version {active.number} is",
        got=f"one of {KINDS[type(new)]}",
        remedy="reject it, and watch its machine under the name of a new twin",
    )
    whose, remedy = f"that of version {active.number}", "fit it to records of the same machine"
    agree(f"version {number}", new.twin, old.twin, whose, remedy=remedy)
    first = registry.reference
    others = [first.number] if first and first.number not in (active.number, number) else []
    watching = [old, new, *(load_monitor(registry.folder(each)) for each in others)]
    if isinstance(old, TrajectoryMonitor):
        return compared_trajectories(
            store, twin, *(each for each in watching if isinstance(each, TrajectoryMonitor))
        )
    return _compared_streams(store, twin, *(each for each in watching if isinstance(each, Monitor)))


def _compared_streams(
    store: Store, twin: str, old: Monitor, new: Monitor, reference: Monitor | None = None
) -> Decision:
    scores, alarms, of_reference = [], 0, 0
    for part in _healthy(store, twin, old):
        if len(part) < 2 * MIN_SAMPLES:
            continue
        commands, measured = np.split(part[None], [len(old.twin.inputs)], axis=2)
        seen = [each.step(each.start(1), commands, measured)[1] for each in (old, new)]
        if seen[0].events:  # an alarm that was not raised when the samples came, after another one
            continue
        known = np.where(np.isfinite(seen[0].score) & np.isfinite(seen[1].score), measured, np.nan)
        unit = np.nanstd(measured, axis=1, keepdims=True)
        unit = np.where(unit > 0, unit, 1.0)
        found = [crps_normal(known, each.mean, each.deviation) for each in seen]
        scores.append([_mean((each / unit)[0]) for each in found])
        alarms += len(seen[1].events)
        if reference is not None:
            seen = [reference.step(reference.start(1), commands, measured)[1]]
            of_reference += len(seen[0].events)
    require(
        scores,
        "samples",
        expected=f"at least {2 * MIN_SAMPLES} without an alarm, of one asset",
        got="fewer",
        remedy="compare the versions later",
    )
    old_crps, new_crps = map(padded, zip(*scores, strict=True))
    samples = int(np.isfinite(new_crps).sum())
    test = FalseAlarmTest(alarms, max(samples, 1), new.arl)
    beside = None
    if reference is not None:
        beside = FalseAlarmTest(of_reference, max(samples, 1), reference.arl)
    return decide(old_crps, new_crps, test, reference=beside)


def _mean(scores: NDArray) -> NDArray:
    """The mean over outputs (T, d_y) of those that are measured; NaN where none is."""
    seen = np.isfinite(scores)
    count = seen.sum(axis=1)
    total = np.where(seen, scores, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _healthy(store: Store, twin: str, monitor: Monitor) -> Iterator[NDArray]:
    """The healthy samples (T, d_u + d_y) of each asset of a twin."""
    alarms: dict[str, list[int]] = {}
    for entry in (*store.log("alarm"), *store.log("remark"), *store.log("end")):
        alarms.setdefault(entry.data["asset"], []).append(entry.data["time"])
    for asset in store.assets():
        newest = store.state(asset.name)
        if asset.settings.get("twin") == twin and newest is not None:
            period = SECOND / monitor.twin.rate
            first = newest[0] - round(MAX_SAMPLES * period)
            times, rows = gridded(store, asset.name, monitor.twin, first, newest[0])
            ends = np.searchsorted(times, sorted(alarms.get(asset.name, [])))
            ends = np.unique(np.concatenate([[0], ends[ends > 0], [len(times) + BEFORE]]))
            first = int(np.argmax(np.diff(ends))) if len(ends) > 1 else 0
            part = rows[ends[first] : ends[first + 1] - BEFORE]
            known = np.isfinite(part[:, : len(monitor.twin.inputs)]).all(axis=1)
            yield part[int(np.argmax(known)) :] if known.any() else part[:0]
