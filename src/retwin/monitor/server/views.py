"""What the page shows, as plain values: times in s since the epoch, NaN for what is missing."""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from fastapi import Path, Query
from fastapi.responses import JSONResponse
from pydantic_core import to_jsonable_python

from retwin.checks import given, require
from retwin.data.trajectories import HEALTHY
from retwin.monitor.live.explanations import Explanations
from retwin.monitor.live.live import Live
from retwin.monitor.live.machine import AssetStatus, Recent
from retwin.monitor.models.cause import possible_causes
from retwin.monitor.models.kinds import AnyMonitor, load_monitor, pace
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor
from retwin.monitor.server.journal import Journal
from retwin.monitor.store.gridded import gridded
from retwin.monitor.store.samples import SECOND
from retwin.monitor.versions.registry import Registry
from retwin.twins.faults.system_faults import (
    ActuatorGain,
    ParameterDrift,
    ParameterShift,
    SensorBias,
    SensorDrift,
    SensorError,
    SensorFreeze,
    SensorGain,
)
from retwin.update.dynamics.filter.noise import CERTAIN

SILENT_SECONDS = 30.0
LEARNED, SHOWN, AFTER = 400, 80, 60
"""Samples before an alarm from which the filter starts anew, those that are shown, and samples
after it."""
KEPT = 16
"""Monitors that are kept in memory, besides those that watch."""

Sequence = Annotated[int, Path(ge=0, lt=2**63)]
Number = Annotated[int, Path(ge=1, lt=2**31)]


class JSON(JSONResponse):
    """An answer in ASCII, with null for numbers that JSON does not have."""

    def render(self, content: Any) -> bytes:
        """The bytes of the answer; texts may contain halves of surrogate pairs."""
        return json.dumps(to_jsonable_python(content, inf_nan_mode="null")).encode()


class Views:
    """The state of the live monitor for the page; its methods answer requests.

    Parameters
    ----------
    live : Live
        The monitor.
    explanations : Explanations, optional
        What explains alarms, for the kinds of faults; by default any change of the machine.
    emulated : bool
        Whether the page states that the machines are emulated.

    """

    def __init__(self, live: Live, explanations: Explanations | None, *, emulated: bool) -> None:
        self._live = live
        self._emulated = emulated
        self.journal = Journal(live.store)
        self._newest: dict[str, tuple[float | None, float]] = {}

        @lru_cache(KEPT)
        def loaded(twin: str, version: int) -> AnyMonitor:
            return load_monitor(Registry(live.store, twin).folder(version))

        @lru_cache(KEPT)
        def causes(twin: str, version: int) -> Mapping[str, Any]:
            monitor = loaded(twin, version)
            if isinstance(monitor, TrajectoryMonitor):
                return monitor.diagnoser.faults
            if explanations is None:
                return possible_causes(monitor.twin)
            return explanations.causes(twin, monitor)

        self._monitor, self._causes = loaded, causes

    def assets(self) -> Any:
        """All assets, the worst first."""
        alarms, twins = self.journal.open(), self._twins()
        made = [self._status(each, alarms, twins) for each in self._live.status()]
        # Evidence by decades, so that healthy machines keep their order.
        made.sort(
            key=lambda each: (
                ORDER.index(each["state"]),
                -math.floor(math.log10(max(each["evidence"], 1e-3))),
                each["asset"],
            )
        )
        about = {"emulated": self._emulated, "revision": self._live.revision}
        return JSON({"assets": made, **about})

    def asset(self, name: str, after: float | None = None) -> Any:
        """An asset with its newest samples, or with those after a time in s since the epoch."""
        found = {each.asset: each for each in self._live.status()}.get(name)
        got, remedy = repr(name)[:80], "see /assets"
        status = given("asset", found, "one that is watched", got=got, remedy=remedy)
        monitor, twins = self._live.monitor(name), self._twins()
        scores, recent = isinstance(monitor, TrajectoryMonitor), self._live.recent(name)
        names = ([], [("score", "1")]) if scores else _channels(monitor.twin)
        times = recent.times / SECOND
        new = slice(0 if after is None else int(np.searchsorted(times, after, "right")), None)
        shown = {
            "status": self._status(status, self.journal.open(), twins),
            "arl": monitor.arl,
            "run_length": getattr(monitor, "run_length", monitor.arl),
            "tried": tried(monitor),
            "rate": pace(monitor),
            "kind": "scores" if scores else "samples",
            "promise": {name: str(each) for name, each in monitor.promises.items()},
            "events": [
                self._explained(each, twins) if each["kind"] == "alarm" else each
                for each in self.journal.events(name)
            ],
            "evidence": recent.evidence[new].tolist(),
        }
        return JSON(shown | _drawn(*names, recent, new))

    def around(self, sequence: Sequence) -> Any:
        """The samples around an alarm, and what its version of the twin predicts of them."""
        # None if they were removed. Of a trajectory it is what the twin does for its commands.
        alarm = self.journal.alarm(sequence)
        asset = next(each for each in self._live.store.assets() if each.name == alarm["asset"])
        monitor = self._monitor(asset.settings["twin"], alarm["version"])
        period = SECOND / monitor.twin.rate
        moment = round(alarm["time"] * SECOND)
        first, last = moment - round(LEARNED * period), moment + round(AFTER * period)
        if "begin" in alarm:
            first, last = round(alarm["begin"] * SECOND - period / 2), moment
        times, rows = gridded(self._live.store, asset.name, monitor.twin, first, last)
        commands, measured = np.split(rows, [len(monitor.twin.inputs)], axis=1)
        mean, deviation = np.full((2, *measured.shape), np.nan)
        whole = "begin" in alarm
        if len(times) and isinstance(monitor, Monitor):
            watched = monitor.step(monitor.start(1), commands[None], measured[None])[1]
            mean, deviation = watched.mean[0], watched.deviation[0]
        elif len(times):
            with warnings.catch_warnings():  # commands outside their range are in the alarm
                warnings.simplefilter("ignore")
                mean = monitor.twin.simulate(commands[None], seed=0).nominal[0]
        recent = Recent(times, commands, measured, mean, deviation, np.zeros(len(times)))
        shown = 0 if whole else int(np.searchsorted(times, moment - round(SHOWN * period)))
        kind, drawn = "trajectory" if whole else "samples", slice(shown, None)
        return JSON({"kind": kind, **_drawn(*_channels(monitor.twin), recent, drawn)})

    def alarms(
        self,
        asset: str | None = None,
        before: Annotated[int | None, Query(ge=0, lt=2**63)] = None,
        limit: Annotated[int, Query(ge=1, le=500)] = 50,
    ) -> Any:
        """Alarms with causes and acknowledgements, the newest first; `next` continues them."""
        found, following = self.journal.alarms(asset, before, limit)
        twins = self._twins()
        alarms = [self._explained(each, twins) for each in found]
        return JSON({"alarms": alarms, "next": following})

    def alarm(self, sequence: Sequence) -> Any:
        """One alarm."""
        return JSON(self._explained(self.journal.alarm(sequence), self._twins()))

    def versions(self, twin: str) -> Any:
        """The versions of a twin."""
        found = Registry(self._live.store, twin).versions()
        require(
            found, "twin", expected="one with versions", got=repr(twin)[:80], remedy="see /assets"
        )
        return JSON({"twin": twin, "versions": [vars(each) for each in found]})

    def _twins(self) -> dict[str, str]:
        """The name of the twin of each asset."""
        return {each.name: each.settings.get("twin", "") for each in self._live.store.assets()}

    def _status(
        self, status: AssetStatus, alarms: Mapping[str, Any], twins: Mapping[str, str]
    ) -> dict[str, Any]:
        now = time.monotonic()
        newest, since = self._newest.get(status.asset, (None, now))
        if newest != status.time:
            since = now
        self._newest[status.asset] = status.time, since
        idle = now - since
        alarm = alarms.get(status.asset)
        # Sample periods without a new sample after which an asset counts as stopped, 30 s at least.
        silent = max(SILENT_SECONDS, 20 / pace(self._live.monitor(status.asset)))
        states = {
            "alarm": alarm is not None,
            "void": status.void,
            "stopped": status.time is not None and idle > silent,
            "impossible": bool(status.impossible),
            "rate": bool(status.rate),
            "outside": status.outside,
            "ok": True,
        }
        return {
            **{name: getattr(status, name) for name in SHARED},
            "time": None if status.time is None else status.time / SECOND,
            "evidence": status.ratio,
            "void_since": self.journal.void(status.asset) if status.void else None,
            "alarm": None if alarm is None else self._explained(alarm, twins),
            "state": next(name for name, holds in states.items() if holds),
            "idle": idle,
        }

    def _explained(self, alarm: Mapping[str, Any], twins: Mapping[str, str]) -> dict[str, Any]:
        """An alarm of the log, its cause and what to check."""
        twin = twins[alarm["asset"]]
        monitor = self._monitor(twin, alarm["version"])
        made = {**alarm, "arl": monitor.arl}
        if alarm["cause"] is not None:
            cause = dict(alarm["cause"])
            fault = self._causes(twin, alarm["version"]).get(cause["name"])
            cause["onset"] = [None if each is None else each / SECOND for each in cause["onset"]]
            cause["check"] = what_to_check(cause["name"], fault, monitor)
            made["cause"] = cause
        return made


Named = list[tuple[str, str]]
"""Names and units of channels."""


def tried(monitor: AnyMonitor) -> dict[str, Any] | None:
    """What happened on the records of the calibration that were left out; None for others."""
    if isinstance(monitor, TrajectoryMonitor):
        return None
    found = monitor.tried
    counts = {name: sum(getattr(found, name).values()) for name in ("events", "samples")}
    return {**counts, "run_length": found.run_length}


def _channels(twin: Any) -> tuple[Named, Named]:
    """The commands and outputs."""
    inputs, outputs = (zip(e.names, e.units, strict=True) for e in (twin.inputs, twin.outputs))
    return list(inputs), list(outputs)


def _drawn(inputs: Named, outputs: Named, recent: Recent, part: slice) -> dict[str, Any]:
    """What plots of samples need."""
    mean, half = recent.mean[part], CERTAIN * recent.deviation[part]
    return {
        "inputs": inputs,
        "outputs": outputs,
        "times": (recent.times[part] / SECOND).tolist(),
        "commands": recent.commands[part].tolist(),
        "measured": recent.measured[part].tolist(),
        "mean": mean.tolist(),
        "low": (mean - half).tolist(),
        "high": (mean + half).tolist(),
    }


SHARED = ("asset", "twin", "version", "event", "rate", "impossible", "counts")
"""What the page shows of a status as it is."""
ORDER = ("alarm", "void", "impossible", "stopped", "rate", "outside", "ok")
"""The states of assets, the worst first."""


SENTENCES: Mapping[type, str] = {
    ParameterShift: "The machine has changed. Look for something that is open, leaks, is clogged, "
    "worn, loose or was replaced. Details: parameter {fault.parameter} of the twin.",
    ParameterDrift: "The machine changes slowly. Look for what wears, fouls, ages, heats up or "
    "loosens, and compare it with earlier records. Details: parameter {fault.parameter} of the "
    "twin.",
    ActuatorGain: "The machine does not do what the command {channel} demands. Check the actuator: "
    "its supply, its connection, its wear, and whether something limits or overrides the command.",
    SensorBias: "The sensor of {channel} is offset. Compare it with a second instrument, and check "
    "its mounting, its reference and its calibration.",
    SensorGain: "The sensor of {channel} reads too high or too low in proportion to its value. "
    "Compare it with a second instrument at a low and at a high value, and check its span and the "
    "factor by which its signal is scaled.",
    SensorDrift: "The error of the sensor of {channel} grows with time. Compare it with a second "
    "instrument now and again later, and check it for dirt, moisture and ageing.",
    SensorFreeze: "The sensor of {channel} repeats the same value. Check its cable, its bus and "
    "the program that reads it, and whether its value changes when it must.",
}
"""What to check for each kind of fault; `channel` is the command or the output that it changes."""
NOTHING = (
    "None of the known faults explains the alarm better than the healthy machine does. Look at the "
    "samples around it; a single disturbance from outside is possible, and so is a false alarm."
)
UNNAMED = (
    "Compare what the machine does on site with what it is commanded and with what its sensors "
    "show, and find out what was changed on it."
)
"""Where the cause is of another kind."""


def what_to_check(name: str, fault: object, monitor: AnyMonitor) -> str:
    """A sentence or two on what to check first, for the fault that a cause names."""
    if name == HEALTHY:
        return NOTHING
    channel = ""
    if isinstance(fault, ActuatorGain):
        channel = monitor.twin.inputs.names[fault.actuator]
    elif isinstance(fault, SensorError | SensorFreeze):
        channel = monitor.twin.outputs.names[fault.output]
    return SENTENCES.get(type(fault), UNNAMED).format(fault=fault, channel=channel)
