"""A version of a twin compared with the active one, on samples that are stored."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import agree, at_least, at_most, given, require
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.inversion.trajectories import InversionDiagnoser
from retwin.evaluation.fidelity.simulation import simulate_records
from retwin.monitor.detect.promise import FalseAlarmTest
from retwin.monitor.models.cause import BEFORE
from retwin.monitor.models.kinds import load_monitor
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor
from retwin.monitor.store.gridded import gridded, record_of
from retwin.monitor.store.samples import SECOND
from retwin.monitor.store.store import Store
from retwin.monitor.versions.decision import MIN_SAMPLES, Decision, decide, padded
from retwin.monitor.versions.registry import Registry
from retwin.scores.bootstrap import BLOCKS
from retwin.scores.distributions import crps_normal
from retwin.twins.twin import Twin
from retwin.update.corrected import CorrectedTwin

MIN_TRAJECTORIES, MAX_TRAJECTORIES = 2 * BLOCKS, 6 * BLOCKS
"""Healthy trajectories of all assets together that are compared: at least, so that a block of the
bootstrap has two, and at most, since diagnosing each may take seconds."""
FRESH, PATIENCE, QUEUE = 60.0, 20.0, 16
"""A comparison is kept for so many seconds, or for so many times as long as it took, whichever is
longer; and comparisons that may be made or kept."""
LATER = "compare the versions later"
"""What to do where too little is stored."""
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
    expected = f"a monitor of {KINDS[type(old)]}, as version {active.number} is"
    got = f"one of {KINDS[type(new)]}"
    remedy = "reject it, and watch its machine under the name of a new twin"
    require(type(old) is type(new), f"version {number}", expected=expected, got=got, remedy=remedy)
    whose, remedy = f"that of version {active.number}", "fit it to records of the same machine"
    agree(f"version {number}", new.twin, old.twin, whose, remedy=remedy)
    first = registry.reference
    others = [first.number] if first and first.number not in (active.number, number) else []
    watching = [old, new, *(load_monitor(registry.folder(each)) for each in others)]
    scored = _of_trajectories if isinstance(old, TrajectoryMonitor) else _of_samples
    scores, (test, *beside) = scored(store, twin, watching)
    old_crps, new_crps = map(padded, zip(*scores, strict=True))
    return decide(old_crps, new_crps, test, reference=beside[0] if beside else None)


Scored = tuple[Sequence[ArrayLike], list[FalseAlarmTest]]
"""The CRPS (2, T) of the old and the new version in each record; and the tests of the new version
and of the reference, if there is one."""


def _of_samples(store: Store, twin: str, watching: Sequence[Any]) -> Scored:
    """One-step predictions of the old version, the new one and the reference."""
    old, scores, alarms = watching[0], [], np.zeros(len(watching), dtype=int)
    for part in _healthy_samples(store, twin, old):
        if len(part) < 2 * MIN_SAMPLES:
            continue
        commands, measured = np.split(part[None], [len(old.twin.inputs)], axis=2)
        seen = [each.step(each.start(1), commands, measured)[1] for each in watching]
        if seen[0].events:  # an alarm that was not raised when the samples came, after another one
            continue
        known = np.where(np.isfinite(seen[0].score) & np.isfinite(seen[1].score), measured, np.nan)
        found = [crps_normal(known, each.mean, each.deviation) for each in seen[:2]]
        relative = np.ma.masked_invalid(np.stack(found)[:, 0] / _deviation(measured[0]))
        scores.append(relative.mean(axis=2).filled(np.nan))  # over the outputs that are measured
        alarms += [len(each.events) for each in seen]
    expected = f"at least {2 * MIN_SAMPLES} without an alarm, of one asset"
    require(scores, "samples", expected=expected, got="fewer", remedy=LATER)
    samples = max(sum(int(np.isfinite(each[1]).sum()) for each in scores), 1)
    counted = list(zip(alarms.tolist(), watching, strict=True))[1:]
    return scores, [FalseAlarmTest(count, samples, each.arl) for count, each in counted]


def _of_trajectories(store: Store, twin: str, watching: Sequence[Any]) -> Scored:
    """Simulations of trajectories from their commands, each scored by its mean CRPS.

    It is the mean over samples and outputs, each output in the unit of its standard deviation. What
    is resampled are 16 blocks or more of consecutive trajectories of one asset, since those of a
    machine that changes slowly resemble each other.
    """
    old = watching[0]
    machines = [
        [record_of(old.twin, each) for each in part]
        for part in _healthy_trajectories(store, twin, old)
    ]
    every = [each for part in machines for each in part]
    what = "healthy ones that are stored, of all machines together"
    at_least("trajectories", every, MIN_TRAJECTORIES, what, remedy=LATER)
    outputs = np.concatenate([each.measured[0] for each in every])
    unit = _deviation(outputs.astype(float))
    twins = [_predicting(each) for each in watching[:2]]
    length = len(every) // BLOCKS
    scores: list[NDArray] = []
    for part in machines:
        pairs = np.array([[_crps(own, each, unit) for each in part] for own in twins])
        scores += np.array_split(pairs, max(1, len(part) // length), axis=1)
    return scores, [_tested(each, machines) for each in watching[1:]]


def _machines(store: Store, twin: str) -> Iterator[tuple[str, int, Mapping[str, NDArray]]]:
    """Name, newest time and state of each asset of a twin that has one."""
    for asset in store.assets():
        state = store.state(asset.name)
        if asset.settings.get("twin") == twin and state is not None:
            yield asset.name, *state


def collect_times(store: Store, key: str, *kinds: str) -> dict[str, list[int]]:
    """The times of that name of the entries of some kinds of the log, by their assets."""
    found: dict[str, list[int]] = {}
    for entry in (each for kind in kinds for each in store.log(kind)):
        if key in entry.data:
            found.setdefault(entry.data["asset"], []).append(entry.data[key])
    return found


def _healthy_samples(store: Store, twin: str, monitor: Monitor) -> Iterator[NDArray]:
    """The healthy samples (T, d_u + d_y) of each asset of a twin."""
    alarms = collect_times(store, "time", "alarm", "remark", "end")
    period = SECOND / monitor.twin.rate
    for name, newest, _ in _machines(store, twin):
        # Newest samples of each asset that are compared, which bounds time and memory.
        first = newest - round(20_000 * period)
        times, rows = gridded(store, name, monitor.twin, first, newest)
        ends = np.searchsorted(times, sorted(alarms.get(name, [])))
        ends = np.unique(np.concatenate([[0], ends[ends > 0], [len(times) + BEFORE]]))
        first = int(np.argmax(np.diff(ends)))
        yield rows[ends[first] : ends[first + 1] - BEFORE]


def _tested(monitor: TrajectoryMonitor, machines: list[list[Trajectories]]) -> FalseAlarmTest:
    """The alarms of a monitor on healthy trajectories, those of each machine in their order."""
    alarms = count = 0
    for part in machines:
        state = monitor.start()
        for each in part:
            state, found = monitor.watch(each, state)
            alarms += len(found.alarms)
            count += int((~found.unmeasured).sum())
    return FalseAlarmTest(alarms, count, monitor.arl, "trajectories")


def _healthy_trajectories(
    store: Store, twin: str, monitor: TrajectoryMonitor, *, trajectories_before: int = 10
) -> Iterator[list[NDArray]]:
    """The longest healthy part of each asset: trajectories (T, d_u + d_y) that follow each other.

    Those with nothing measured are left out.

    Parameters
    ----------
    trajectories_before : int, default 10
        Trajectories before an alarm that are left out: its cause may already act in them.

    """
    alarms, machines = collect_times(store, "begin", "alarm"), list(_machines(store, twin))
    for asset, _, state in machines:
        known = state.get("trajectories", np.zeros((0, 3), dtype=np.int64))
        ends = np.flatnonzero(np.isin(known[:, 0], alarms.get(asset, [])))
        begins = np.concatenate([[0], ends + 1])
        lasts = np.maximum(np.concatenate([ends - trajectories_before, [len(known)]]), begins)
        longest = int(np.argmax(lasts - begins))
        part = known[begins[longest] : lasts[longest]][-max(1, MAX_TRAJECTORIES // len(machines)) :]
        made = []
        for begin, last, count in part.tolist():
            _, rows = gridded(store, asset, monitor.twin, begin, last)
            if len(rows) == count and np.isfinite(rows[:, len(monitor.twin.inputs) :]).any():
                made.append(rows)
        yield made


def _predicting(monitor: TrajectoryMonitor) -> Twin:
    """The corrected twin of a monitor's diagnoser, whose outputs are random."""
    own = monitor.diagnoser
    if isinstance(own, InversionDiagnoser):
        return CorrectedTwin(own.surrogate, own.residual)
    return own.twin


def _deviation(measured: NDArray) -> NDArray:
    """The standard deviation (d_y,) of each output (T, d_y); 1 for one that is constant."""
    found = np.ma.masked_invalid(measured).std(axis=0).filled(1.0)
    return np.where(found > 0, found, 1.0)


def _crps(twin: Twin, record: Trajectories, unit: NDArray, *, draws: int = 200) -> float:
    """The mean CRPS of a trajectory over its measured samples and outputs.

    Parameters
    ----------
    draws : int, default 200
        Simulations of each trajectory; the CRPS has no bias by their number.

    """
    with warnings.catch_warnings():  # both versions see the same commands
        warnings.simplefilter("ignore")
        found = simulate_records(twin, record, draws=draws, seed=0).crps[0] / unit
    return float(found[record.mask[0]].mean())


class Comparisons:
    """Comparisons in a thread of their own, one after the other, each kept for a while.

    Parameters
    ----------
    store : Store
        The store.

    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._worker = ThreadPoolExecutor(1, "comparison")
        self._made: dict[tuple[str, int], Future[Decision]] = {}
        self._until: dict[Future[Decision], float] = {}
        """Until when a comparison is kept that is done."""
        self._lock = threading.Lock()

    def of(self, twin: str, number: int) -> Future[Decision]:
        """The comparison of a version with the active one."""
        key, now = (twin, number), time.monotonic()
        with self._lock:
            for each, made in list(self._made.items()):
                if now >= self._until.get(made, np.inf):
                    del self._made[each], self._until[made]
            if key not in self._made:
                count = len(self._made) + 1
                at_most("comparison", count, QUEUE, "at a time", remedy="wait for a minute")
                self._made[key] = self._worker.submit(compare, self._store, twin, number)
                self._made[key].add_done_callback(partial(self._keep, now))
            return self._made[key]

    def _keep(self, begun: float, made: Future[Decision]) -> None:
        """Note until when a comparison is kept."""
        now = time.monotonic()
        self._until[made] = now + max(FRESH, PATIENCE * (now - begun))
