"""`StreamMachine`: one watched stream, from samples as they arrive to complete parts in order.

Samples have a place on a grid of the twin's sample rate. A place without a sample is waited for,
and then missing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.monitor.live.machine import KEPT, Counts, Machine, Recent
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.state import Layout, Watched
from retwin.monitor.store.gridded import Limits
from retwin.monitor.store.samples import EARLIEST, SECOND, Asset, Samples, Update

ALARM = ("sample", "output", "change", "evidence", "machine")
"""What the log has of an alarm, beside its time and that of its event."""
LONGEST_GAP = 10_000
LONGEST_GAP_SECONDS = 3600.0
"""A pause of more places, or of a longer time, begins a new stream: what was known is too old."""
PART = 4096
"""Samples that are stepped at once at most."""
PLACES = 4 * PART
"""Places, most of them perhaps without a sample, from which on they are stepped before others are
taken: that bounds the memory for any times of the samples."""
WINDOW, TOLERATED = 100, 20
"""Places of a check of the sample rate, and how many may be missing or have further samples; as
many places without an impossible value of a channel are needed until it counts as possible again.
"""
BEHIND = 10
"""Late samples in a row from which on the clock of the machine counts as set back."""


@dataclass(frozen=True, eq=False)
class Work:
    """Complete samples (T, d_u + d_y) from a place on; the first ones of a stream `begin` it."""

    origin: int
    first: int
    values: NDArray
    begins: bool


class StreamMachine(Machine[Monitor]):
    """The stream of one asset. It changes in place; see `Live`.

    Parameters
    ----------
    asset : Asset
        The asset, with the version of its twin.
    monitor : Monitor
        That version.
    layout : Layout
        Of that monitor.
    wait : float or None
        Time in s for which a place is waited for; None for two sample periods.

    """

    def __init__(self, asset: Asset, monitor: Monitor, layout: Layout, wait: float | None) -> None:
        super().__init__(asset, monitor)
        rate = monitor.twin.rate
        self.layout = layout
        self.changed = False
        self._period = SECOND / rate
        # Sample periods for which a place is waited for, unless it is given.
        self._wait = 2 if wait is None else int(np.ceil(wait * rate))
        self._gap = min(LONGEST_GAP, max(2, round(LONGEST_GAP_SECONDS * rate)))
        self._commands = len(monitor.twin.inputs)
        self._missing = np.full(asset.channels, np.nan)
        self._origin: int | None = None
        self._done = -1
        self._pending: dict[int, NDArray] = {}
        self._farthest = -1
        self._rows: list[NDArray] = []
        self._work: deque[Work] = deque()
        self._begins = True
        self.state = layout.start
        """That of the monitor after the samples that were stepped, as a row of the layout."""
        self._new: dict[int, NDArray] = {}
        self._window = [0, 0, 0]
        self._wrong = [0, 0, 0]
        """The newest full window if its rate was another one than the twin's."""
        self._late = 0
        self._limits = Limits.of(monitor.twin, asset.settings.get("limits", {}))
        self._doubtful = np.zeros(asset.channels)
        """Places until each channel counts as possible again; 0 for one that is."""
        commands, measured = np.split(self._missing[None, :][:0], [self._commands], axis=1)
        none = np.zeros(0, dtype=np.int64), commands, measured, measured, measured, np.zeros(0)
        self._recent: deque[tuple[NDArray, ...]] = deque([none])
        self._kept = 0

    @property
    def rate(self) -> str:
        """How the sample rate differs from the twin's; "" if it does not."""
        places, absent, further = self._wrong
        if not places:
            return ""
        rate = self.monitor.twin.rate
        return f"{rate * (places - absent + further) / places:.4g} Hz instead of {rate:.4g} Hz"

    @property
    def impossible(self) -> str:
        """Which channels have had impossible values; "" for none."""
        return "; ".join(map(self._limits.text, np.flatnonzero(self._doubtful).tolist()))

    @property
    def stepped_time(self) -> int:
        """A time in nanoseconds after which are all samples that were not stepped."""
        return max(EARLIEST, self._moment(self._done - 0.5))

    def unsure(self, times: NDArray) -> NDArray:
        """Those times that may be of samples which are stored already."""
        return times if self.newest is None else times[times <= self.newest]

    def accept(self, samples: Samples, limit: int, known: set[int], counts: Counts) -> Samples:
        """Take samples in the order of their arrival, until there is enough to step.

        Parameters
        ----------
        samples : Samples
            Of this machine.
        limit : int
            The latest time that counts.
        known : set of int
            Times of samples that the store has.
        counts : Counts
            To which what was done is added.

        Returns
        -------
        Samples
            Those that were not taken yet, and have to be after the work so far was stepped: each
            may end a hole of many places.

        """
        own, taken = Counts(), 0
        for moment, row in zip(samples.times.tolist(), samples.values, strict=True):
            if len(self._rows) >= PLACES:
                break
            what = self._placed(moment, row, limit, known)
            setattr(own, what, getattr(own, what) + 1)
            taken += 1
        self._complete()
        for each in (self.counts, counts):
            each.add(own)
        return Samples(samples.asset, samples.times[taken:], samples.values[taken:])

    def hold(self, times: NDArray, values: NDArray) -> None:
        """Take samples of the store that were not stepped."""
        for moment, row in zip(times.tolist(), values, strict=True):
            place = self._place(moment)
            if place > self._done:
                self._pending[place] = row
                self._farthest = max(self._farthest, place)
                self.newest = max(self.newest or moment, moment)

    def next_work(self) -> Work | None:
        """The next complete samples, which must be stepped before any others; None if none are."""
        return self._work.popleft() if self._work else None

    def stepped(self, work: Work, state: NDArray, watched: Watched, row: int) -> None:
        """Take the state after these samples, and what was found in them, a row of `watched`."""
        name = self.asset.name
        alarms = [each for each in watched.alarms if each.trajectory == name]
        endings = [each for each in watched.endings if each.trajectory == name]
        self.state, self.changed = state, True
        self.evidence = float(watched.evidence[row, -1])
        self.outside = bool(watched.outside[row])
        places = work.first + np.arange(len(work.values))
        times = work.origin + np.round(places * self._period).astype(np.int64)
        self.event = bool(watched.event[row, -1]) and not any(
            each.sample == places[-1] for each in endings
        )
        for alarm in alarms:
            moment = int(times[alarm.sample - work.first])
            if alarm.opens and alarm.promised:
                self.alarms += 1
                self.last_alarm = moment
            data = {name: getattr(alarm, name) for name in ALARM}
            event = self._moment(alarm.event, work)
            self.log("alarm" if alarm.promised else "remark", moment, **data, event=event)
        for ending in endings:
            moment, event = (self._moment(each, work) for each in (ending.sample, ending.event))
            self.log("end", moment, event=event, how=ending.how)
        void = watched.void[row]
        if void.any() and not self.void:
            self.log("void", int(times[int(np.argmax(void))]))
        self.void = bool(void[-1])
        commands, measured = np.split(work.values, [self._commands], axis=1)
        predicted = (watched.mean[row], watched.deviation[row], watched.evidence[row])
        self._recent.append((times, commands, measured, *predicted))
        self._kept += len(times)
        while self._kept - len(self._recent[0][0]) >= KEPT:
            self._kept -= len(self._recent.popleft()[0])

    def recent(self) -> Recent:
        """The newest samples."""
        return Recent(*(np.concatenate(each)[-KEPT:] for each in zip(*self._recent, strict=True)))

    def update(self) -> Update | None:
        """Samples that are not stored yet, and the state after those that were stepped."""
        if not self._new and not self.changed:
            return None
        times = np.array(list(self._new), dtype=np.int64)
        rows = np.array(list(self._new.values())).reshape(-1, self.asset.channels)
        state = self._arrays() if self.changed else None
        return Update(self.asset.name, times, rows, state, self.newest or 0)

    def committed(self) -> None:
        """Everything is stored."""
        super().committed()
        self._new, self.changed = {}, False

    def _arrays(self) -> dict[str, NDArray]:
        own = (self._origin, self._done, self.newest, self.asset.version, *self._window)
        return {
            "stream": np.array(own, dtype=np.int64),
            "monitor": self.state,
            "status": np.array([self.evidence, *self._wrong, *self._doubtful], dtype=float),
            "digest": self.layout.digest,
        }

    def restore(self, arrays: Mapping[str, NDArray]) -> bool:
        """Continue where a state was stored; False if another version or monitor watched."""
        if not {"stream", "status"} <= arrays.keys():  # of a monitor of trajectories, or older
            return False
        origin, done, self.newest, version, *window = arrays["stream"].tolist()
        other = not np.array_equal(arrays.get("digest", self.layout.digest), self.layout.digest)
        shape = arrays["monitor"].shape
        if version != self.asset.version or other or shape != self.state.shape:
            return False  # it begins anew
        self._origin, self._done, self._farthest, self._window = origin, done, done, window
        self.state, self._begins = arrays["monitor"], False
        before = self.layout.state(self.state[None])
        self.void, self.event = bool(before.void[0]), bool(before.course.event[0] >= 0)
        self.evidence, *more = arrays["status"].tolist()
        self._wrong = [int(each) for each in more[:3]]
        self._doubtful = np.array(more[3:] or self._doubtful)  # states of before have no limits
        return True

    def _moment(self, place: float, work: Work | None = None) -> int:
        """The time of a place of the stream, or of that of some work, in nanoseconds."""
        origin = work.origin if work else self._origin
        assert origin is not None
        return origin + round(place * self._period)

    def _place(self, moment: int) -> int:
        assert self._origin is not None
        return round((moment - self._origin) / self._period)

    def _placed(self, moment: int, row: NDArray, limit: int, known: set[int]) -> str:
        """What is done with a sample: the name of a count."""
        if moment > limit:
            return "ahead"
        if moment in known or moment in self._new:
            return "repeated"
        begins = self._origin is None
        if self.newest is not None and moment <= self.newest and begins:
            return self._too_late(moment)
        if not begins:
            place = self._place(moment)
            if place in self._pending:
                return self._further()
            if place <= self._done:
                later = self.newest is not None and moment > self.newest
                return self._further() if later else self._too_late(moment)
            begins = place - self._farthest > self._gap
        if begins:
            if not np.isfinite(self._limits.kept(row)[: self._commands]).all():
                return "unknown"
            self._begin(moment)
        place = self._place(moment)
        self._pending[place] = self._new[moment] = row
        self._farthest = max(self._farthest, place)
        self.newest = moment if self.newest is None else max(self.newest, moment)
        self._late = 0
        self._advance(self._wait)
        return "used"

    def _begin(self, moment: int) -> None:
        """Begin a stream with its first sample; the one before it is complete."""
        if self._origin is not None:
            self._advance(0)
            self._complete()
            assert self.newest is not None
            pause = (moment - self.newest) / SECOND
            text = f"no sample for {pause:.6g} s: the monitor begins anew"
            self.log("event", moment, what="gap", text=text)
        self._origin, self._done, self._farthest, self._begins = moment, -1, -1, True

    def _further(self) -> str:
        self._window[2] += 1
        return "extra"

    def _too_late(self, moment: int) -> str:
        self._late += 1
        if self._late == BEHIND and self.newest is not None:
            behind = (self.newest - moment) / SECOND
            text = f"samples are {behind:.6g} s behind the newest one and not used"
            self.log("event", self.newest, what="clock", text=f"{text}: a clock set back?")
        return "late"

    def _advance(self, wait: int) -> None:
        """Pass all places that have a sample, or were waited for."""
        while self._done < self._farthest:
            place = self._done + 1
            found = self._pending.pop(place, None)
            if found is None and self._farthest - place < wait:
                return
            self._rows.append(self._measured(place, self._missing if found is None else found))
            self._done = place
            self._checked_rate(place, missing=found is None)

    def _measured(self, place: int, row: NDArray) -> NDArray:
        """The values of a place that are possible; when others begin and end is logged."""
        outside, before = self._limits.outside(row), self._doubtful
        self._doubtful = np.where(outside, WINDOW, np.maximum(before - 1, 0))
        for channel in np.flatnonzero((before > 0) != (self._doubtful > 0)).tolist():
            text = f"{self._limits.names[channel]} is within its limits again"
            if outside[channel]:
                text = f"impossible: {self._limits.text(channel, row[channel])}; it is not used"
            self.log("event", self._moment(place), what="impossible", text=text)
        return self._limits.kept(row)

    def _complete(self) -> None:
        """Make work of the places that were passed."""
        first = self._done + 1 - len(self._rows)
        for i in range(0, len(self._rows), PART):
            assert self._origin is not None
            part = np.array(self._rows[i : i + PART])
            self._work.append(Work(self._origin, first + i, part, self._begins))
            self._begins = False
        self._rows = []

    def _checked_rate(self, place: int, *, missing: bool) -> None:
        """Count a place; after every hundred, compare the rate with the twin's."""
        self._window[0] += 1
        self._window[1] += missing
        places, absent, further = self._window
        if places < WINDOW:
            return
        before, wrong = self.rate, absent + further > TOLERATED
        self._wrong = self._window if wrong else [0, 0, 0]
        self._window = [0, 0, 0]
        if wrong != bool(before):
            text = f"samples come at {self.rate or 'the right rate again'}"
            self.log("event", self._moment(place), what="rate", text=text)


def step(together: Sequence[tuple[StreamMachine, Work]]) -> dict[str, int]:
    """Step machines of one monitor, each by as many samples; their numbers of alarms."""
    machines = [each for each, _ in together]
    monitor = machines[0].monitor
    layout = machines[0].layout
    known = [layout.start if work.begins else machine.state for machine, work in together]
    before = layout.state(np.stack(known))
    values = np.stack([work.values for _, work in together])
    commands, measured = np.split(values, [len(monitor.twin.inputs)], axis=2)
    names = [each.asset.name for each in machines]
    after, watched = monitor.step(before, commands, measured, names)
    states = layout.rows(after)
    for i, (machine, work) in enumerate(together):
        machine.stepped(work, states[i], watched, i)
    return {name: sum(each.trajectory == name for each in watched.events) for name in names}
