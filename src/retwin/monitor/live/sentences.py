"""Entries of the log as sentences, for the terminal and for who is notified."""

from __future__ import annotations

from datetime import UTC, datetime

from retwin.monitor.models.cause import cause_text
from retwin.monitor.store.audit import Entry
from retwin.monitor.store.samples import SECOND

REMEDY = (
    "Look for a fault first. Only if it is healthy, recalibrate: until then what follows are "
    "remarks, and no alarms"
)
"""What to do where a promise is void."""


def sentence(entry: Entry) -> str:
    """An entry of the log in a line; "" for one that is not reported."""
    data = entry.data
    if entry.kind == "version":
        reason = f": {data['reason']}" if data.get("reason") else ""
        return f"twin {data['twin']}: {data['step']} version {data['version']}{reason}"
    if entry.kind == "cause":
        onset = data["onset"][0]
        if data.get("same"):
            return ""  # the event has its cause
        found = cause_text(data, "" if onset is None else moment_text(onset))
        return f"{data['asset']}: cause of alarm {data['alarm']}: {found}"
    texts = {
        "alarm": "ALARM {sequence}: {output}, {change}",
        "remark": "remark, for which nothing is promised: {output}, {change}",
        "end": "event ended, {how}",
        "void": "promise VOID: the machine is not the one of the calibration. " + REMEDY,
        "event": "{text}",
    }
    opens = data.get("event", data.get("time")) == data.get("time")
    if entry.kind not in texts or not (opens or entry.kind == "end"):
        return ""  # an event is one line, though more alarms belong to it
    text = texts[entry.kind].format(sequence=entry.sequence, **data)
    if "cause" in data:
        text += f", cause: {cause_text(data['cause'], '')}"
    return f"{data['asset']}: {text} ({moment_text(data['time'])})"


def moment_text(time: int) -> str:
    """A time in ns, to the second."""
    moment = datetime.fromtimestamp(round(time / SECOND), UTC)
    return moment.isoformat().replace("+00:00", "Z")
