"""Two monitors of trajectories compared, on trajectories that are stored."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.inversion import InversionDiagnoser
from retwin.evaluation.fidelity.simulation import simulate_records
from retwin.monitor.detect.promise import FalseAlarmTest
from retwin.monitor.models.trajectories import TrajectoryMonitor
from retwin.monitor.store.gridded import gridded, record_of
from retwin.monitor.store.store import Store
from retwin.monitor.versions.decision import Decision, decide, padded
from retwin.scores.bootstrap import BLOCKS
from retwin.twins.twin import Twin
from retwin.update.corrected import CorrectedTwin

MIN_TRAJECTORIES, MAX_TRAJECTORIES = 2 * BLOCKS, 6 * BLOCKS
"""Healthy trajectories of all assets together that are compared: at least, so that a block of the
bootstrap has two, and at most, since diagnosing each may take seconds."""
BEFORE = 10
"""Trajectories before an alarm that are left out: its cause may already act in them."""
DRAWS = 200
"""Simulations of each trajectory; the CRPS has no bias by their number."""


def compared_trajectories(
    store: Store,
    twin: str,
    old: TrajectoryMonitor,
    new: TrajectoryMonitor,
    reference: TrajectoryMonitor | None = None,
) -> Decision:
    """Compare two monitors on the stored healthy trajectories of all assets of a twin.

    Every trajectory has one score, the mean CRPS over its samples and outputs, each output in the
    unit of its standard deviation. What is resampled are 16 blocks or more of consecutive
    trajectories of one asset, since those of a machine that changes slowly resemble each other.
    With a reference, its alarms on the same trajectories are part of the decision.

    Raises
    ------
    InputError
        Fewer than 32 healthy trajectories are stored.

    """
    machines = [[record_of(old.twin, each) for each in part] for part in _healthy(store, twin, old)]
    every = [each for part in machines for each in part]
    require(
        len(every) >= MIN_TRAJECTORIES,
        "trajectories",
        expected=f"at least {MIN_TRAJECTORIES} healthy ones that are stored, of all machines "
        "together",
        got=len(every),
        remedy="compare the versions later",
    )
    unit = _deviation(every)
    twins = [_predicting(each) for each in (old, new)]
    length = len(every) // BLOCKS
    scores: list[NDArray] = []
    for part in machines:
        pairs = np.array([[_crps(own, each, unit) for each in part] for own in twins])
        scores += np.array_split(pairs, max(1, len(part) // length), axis=1)
    old_crps, new_crps = map(padded, zip(*scores, strict=True))
    beside = None if reference is None else _tested(reference, machines)
    return decide(old_crps, new_crps, _tested(new, machines), reference=beside)


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


def _healthy(store: Store, twin: str, monitor: TrajectoryMonitor) -> Iterator[list[NDArray]]:
    """The longest healthy part of each asset: trajectories (T, d_u + d_y) that follow each other.

    Those with nothing measured are left out.
    """
    alarms: dict[str, list[int]] = {}
    for entry in store.log("alarm"):
        if "begin" in entry.data:
            alarms.setdefault(entry.data["asset"], []).append(entry.data["begin"])
    assets = [each.name for each in store.assets() if each.settings.get("twin") == twin]
    for asset in assets:
        state = store.state(asset)
        if state is None or "trajectories" not in state[1]:
            continue
        known = state[1]["trajectories"]
        ends = np.flatnonzero(np.isin(known[:, 0], alarms.get(asset, [])))
        begins = np.concatenate([[0], ends + 1])
        lasts = np.maximum(np.concatenate([ends - BEFORE, [len(known)]]), begins)
        longest = int(np.argmax(lasts - begins))
        part = known[begins[longest] : lasts[longest]][-max(1, MAX_TRAJECTORIES // len(assets)) :]
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


def _deviation(records: list[Trajectories]) -> NDArray:
    """The standard deviation (d_y,) of what was measured of each output; 1 for a constant one."""
    measured = np.concatenate([np.where(each.mask, each.observed, np.nan)[0] for each in records])
    seen = np.isfinite(measured).any(axis=0)
    found = np.ones(measured.shape[1])
    found[seen] = np.nanstd(measured[:, seen].astype(float), axis=0)
    return np.where(found > 0, found, 1.0)


def _crps(twin: Twin, record: Trajectories, unit: NDArray) -> float:
    """The mean CRPS of a trajectory over its measured samples and outputs."""
    with warnings.catch_warnings():  # both versions see the same commands
        warnings.simplefilter("ignore")
        found = simulate_records(twin, record, draws=DRAWS, seed=0).crps[0] / unit
    return float(found[record.mask[0]].mean())
