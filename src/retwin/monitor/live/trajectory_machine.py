"""`TrajectoryMachine`: one watched machine whose work is trajectories, each of which is complete.

A trajectory is used as a whole: its samples, the state after it and its alarm are one commit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import UNKNOWN
from retwin.errors import InputError, brief
from retwin.monitor.live.machine import KEPT, Machine, Recent
from retwin.monitor.models.cause import cause_data
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor
from retwin.monitor.models.trajectory.state import REMARKS, TrajectoryState, WatchedTrajectories
from retwin.monitor.store.gridded import record_of
from retwin.monitor.store.samples import Asset, Samples, Trajectory, Update

UNUSUAL = ("unmeasured", "unranked", "implausible")
"""What trajectories may be that is an event of the log when it begins and when it ends. Commands
outside their range are a status of the machine."""


@dataclass(frozen=True, eq=False)
class Diagnosed:
    """What a trajectory changes, before it is stored: its samples, the state after it, and what was
    found in it.
    """

    samples: Samples
    state: TrajectoryState
    watched: WatchedTrajectories


class TrajectoryMachine(Machine[TrajectoryMonitor]):
    """The trajectories of one asset. It changes in place; see `Live`.

    Parameters
    ----------
    asset : Asset
        The asset, with the version of its twin.
    monitor : TrajectoryMonitor
        That version.
    digest : str
        The hexadecimal hash of its files: its states are of no use to another one.

    """

    def __init__(self, asset: Asset, monitor: TrajectoryMonitor, digest: str = "") -> None:
        super().__init__(asset, monitor)
        self._digest = np.frombuffer(bytes.fromhex(digest), dtype=np.uint8)
        self._state = monitor.start()
        self._known = np.zeros((0, 3), dtype=np.int64)
        """Begin, end and number of samples of the newest trajectories."""
        self._remark = 0
        """Why the newest trajectory was not used as usual, as a place in UNUSUAL from 1; or 0."""
        self._new: Samples | None = None
        self._recent: deque[tuple[int, float, float]] = deque(maxlen=KEPT)

    def placed(self, given: object, limit: int, known: set[int]) -> str:
        """What is done with a trajectory, as the name of a count: "used" if it is to be diagnosed.

        Parameters
        ----------
        given : Trajectory
            Of this machine; single samples are refused.
        limit : int
            The latest time at which one may begin.
        known : set of int
            Times of samples that the store has.

        """
        if not isinstance(given, Trajectory):
            return "refused"
        if given.begin > limit:
            return "ahead"
        if given.begin in known:
            return "repeated"
        if self.newest is not None and given.begin <= self.newest:
            return "late"
        first = given.values[:1, : len(self.monitor.twin.inputs)]
        return "used" if np.isfinite(first).all() and len(first) else "unknown"

    def refuse(self, moment: int, why: str) -> None:
        """Log why a trajectory is not used."""
        self.log("event", moment, what="trajectory", text=f"trajectory not used: {why}")

    def diagnose(self, given: Trajectory) -> Diagnosed | str:
        """What a trajectory changes, or why it cannot be used.

        Nothing is changed yet, so that no lock is needed.
        """
        samples = given.samples(self.monitor.twin.rate)
        try:
            record = record_of(self.monitor.twin, given.values)
            return Diagnosed(samples, *self.monitor.watch(record, self._state))
        except Exception as error:  # Whatever fails, the next trajectory is diagnosed.
            return str(error) if isinstance(error, InputError) else f"not diagnosed: {brief(error)}"

    def take(self, found: Diagnosed, *, remembered: int = 1000) -> int:
        """Continue after a diagnosed trajectory; the number of its alarms.

        Parameters
        ----------
        remembered : int, default 1000
            Newest trajectories of which the store knows where they begin, for comparisons of
            versions.

        """
        watched, samples = found.watched, found.samples
        last = int(samples.times[-1])
        for alarm in watched.alarms:  # with its cause, which is known at once
            shares = alarm.probability, alarm.shares.get(UNKNOWN, 0.0), alarm.shares
            self.log(
                "alarm",
                last,
                sample=alarm.number,
                begin=int(samples.times[0]),
                output=f"trajectory {alarm.number + 1}",
                change="unlike the healthy machine" + ", with commands outside" * alarm.outside,
                evidence=alarm.evidence,
                cause=cause_data(alarm.name, *shares),
            )
        if watched.void[-1] and not self.void:
            self.log("void", last)
        remark = next((i for i, name in enumerate(UNUSUAL, 1) if getattr(watched, name)[-1]), 0)
        if remark != self._remark:
            again = "measured as those of the calibration again"
            text = f"trajectory {REMARKS[UNUSUAL[remark - 1]] if remark else again}"
            self.log("event", last, what="trajectory", text=text)
        self._remark, self._state, self.newest = remark, found.state, last
        self.evidence = float(watched.evidence[-1])
        self.void, self.outside = bool(watched.void[-1]), bool(watched.outside[-1])
        new = np.array([[*samples.times[[0, -1]], len(samples.times)]], dtype=np.int64)
        self._known = np.concatenate([self._known, new])[-remembered:]
        self._recent.append((last, float(watched.score[-1]), self.evidence))
        if watched.alarms:
            self.alarms += len(watched.alarms)
            self.last_alarm = last
        self._new = samples
        return len(watched.alarms)

    def update(self) -> Update | None:
        """The samples of the trajectory that is not stored yet, with the state after it."""
        if self._new is None:
            return None
        status = self.evidence, self.void, self.outside, self._remark
        arrays = {
            **{f"trajectory.{name}": each for name, each in self._state.arrays().items()},
            "version": np.array([self.asset.version], dtype=np.int64),
            "status": np.array(status, dtype=float),
            "digest": self._digest,
            "trajectories": self._known,
        }
        return Update(self._new.asset, self._new.times, self._new.values, arrays, self.newest)

    def committed(self) -> None:
        """Everything is stored."""
        super().committed()
        self._new = None

    def restore(self, time: int, arrays: Mapping[str, NDArray]) -> None:
        """Continue where a state was stored, anew if it is that of another version or monitor."""
        self.newest = time
        self._known = arrays.get("trajectories", self._known)
        same = np.array_equal(arrays.get("digest", ()), self._digest)
        if not same or "version" not in arrays or arrays["version"][0] != self.asset.version:
            return
        own = {name.partition(".")[2]: each for name, each in arrays.items() if "." in name}
        self._state = TrajectoryState.of_arrays(own).checked(self._state)
        self.evidence, void, outside, *remark = arrays["status"].tolist()
        self._remark = int(remark[0]) if remark else 0  # not in states of development versions
        self.void, self.outside = bool(void), bool(outside)

    def recent(self) -> Recent:
        """Scores of the newest trajectories, which are standard Gaussian for a healthy machine."""
        times, score, evidence = np.array(self._recent, dtype=object).reshape(-1, 3).T
        values = score.astype(float)[:, None]
        whole, commands = times.astype(np.int64), values[:, :0]
        standard = np.zeros_like(values), np.ones_like(values)
        return Recent(whole, commands, values, *standard, evidence.astype(float))
