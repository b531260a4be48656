"""`Notifications`: somebody hears of events, from the log of the store.

The log is the outbox: what a receiver has been sent is remembered as the number of an entry, in a
file of the store's folder, so that a receiver that could not be reached, or a restart, loses none.
An entry is sent again only if the program is killed between the message and that file; messages
have the entry's number.
"""

from __future__ import annotations

import json
import os
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, time
from pathlib import Path
from typing import Protocol

from retwin.checks import needs_extra, require
from retwin.errors import brief
from retwin.monitor.models.cause import cause_text
from retwin.monitor.settings import NotifySettings, secret
from retwin.monitor.store.audit import Entry
from retwin.monitor.store.samples import SECOND
from retwin.monitor.store.store import Store
from retwin.serialisation.files import read_json, refusing, write_json

FIRST, LONGEST = 1.0, 300.0
"""Seconds after which a message that failed is sent again at first, and at most."""
FILE = "notified.json"
"""The file with the newest entry that each receiver was sent."""


class Channel(Protocol):
    """Where messages go."""

    def send(self, text: str, entry: Entry) -> None:
        """Send a message about an entry; an exception means that it has not arrived."""


@dataclass(frozen=True)
class FileChannel:
    """A file to which a line of JSON is appended."""

    path: Path

    def send(self, text: str, entry: Entry) -> None:
        """Append a line, which is on the disk then."""
        line = {"entry": entry.sequence, "kind": entry.kind, "text": text, "data": entry.data}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
            file.flush()
            os.fsync(file.fileno())


class AppriseChannel:
    """Any service that Apprise knows: mail, chats, webhooks.

    Parameters
    ----------
    url : str
        The address as Apprise writes it, such as `mailto://…` or `json://host/path`.

    Raises
    ------
    InputError
        Apprise knows no such service, or is not installed.

    """

    def __init__(self, url: str) -> None:
        apprise = needs_extra("apprise", "monitor", "sends notifications")
        self._service = apprise.Apprise()
        with warnings.catch_warnings():  # of a module of Python that its services still import
            warnings.simplefilter("ignore", DeprecationWarning)
            known = self._service.add(url)
        expected = "an address as Apprise writes it, such as mailto://… or json://host/path"
        got = "another one, which is not shown since it may hold a password"
        remedy = "see https://github.com/caronc/apprise/wiki"
        require(known, "notify", expected=expected, got=got, remedy=remedy)

    def send(self, text: str, entry: Entry) -> None:
        """Send it; OSError if the service did not take it."""
        title = f"retwin, entry {entry.sequence}: {entry.data.get('asset', entry.kind)}"
        if not self._service.notify(body=text, title=title):
            raise OSError("the service did not take the message")


@dataclass(frozen=True)
class Receiver:
    """Somebody who hears of events.

    Attributes
    ----------
    name : str
        Name in the settings, by which is remembered what was sent.
    channel : Channel
        Where messages go.
    kinds : sequence of str
        Kinds of entries.
    assets : sequence of str
        The machines; empty for all.
    quiet : sequence of (time, time)
        Times of the day, of this machine's clock, between which nothing is sent.

    """

    name: str
    channel: Channel
    kinds: Sequence[str]
    assets: Sequence[str] = ()
    quiet: Sequence[tuple[time, time]] = ()

    @classmethod
    def of(cls, name: str, settings: NotifySettings) -> Receiver:
        """Who is notified, as the settings state it."""
        address = secret("address", settings.url_env)
        channel = AppriseChannel(address) if address else FileChannel(settings.file)  # type: ignore[arg-type]
        quiet = [tuple(map(time.fromisoformat, each.split("-"))) for each in settings.quiet]
        return cls(name, channel, settings.kinds, settings.assets, quiet)  # type: ignore[arg-type]

    def hears(self, entry: Entry) -> bool:
        """Whether it is sent this entry."""
        return entry.kind in self.kinds and (
            not self.assets or entry.data.get("asset") in self.assets
        )

    def rests(self, now: time) -> bool:
        """Whether nothing is sent at that time; what ends before it begins goes past midnight."""
        return any(
            begin <= now < end if begin <= end else now >= begin or now < end
            for begin, end in self.quiet
        )


class Notifications:
    """A thread for each receiver, which sends it the entries of the log in their order.

    A context manager that ends the threads. What is in the log before the first start is not sent.

    Parameters
    ----------
    store : Store
        The store.
    receivers : sequence of Receiver
        Who hears.
    report : callable
        Takes a line when a receiver cannot be reached, and when it is again.

    """

    def __init__(
        self, store: Store, receivers: Sequence[Receiver], report: Callable[[str], None]
    ) -> None:
        self._store, self._report = store, report
        self._file = store.folder / FILE
        self._sent = _read(self._file)
        self._lock, self._stop = threading.Lock(), threading.Event()
        last = store.last
        for each in receivers:
            self._sent.setdefault(each.name, last.sequence if last else -1)
        self._write()
        self._threads = ThreadPoolExecutor(max(1, len(receivers)), "notify")
        for each in receivers:
            self._threads.submit(self._run, each)

    def __enter__(self) -> Notifications:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Send what is new, and end the threads; what fails is sent after the next start."""
        self._stop.set()
        self._threads.shutdown()

    def _run(self, receiver: Receiver) -> None:
        wait, failed, last = FIRST, False, False
        while not last:
            last = self._stop.wait(wait)  # then what is new is sent once more
            try:
                for entry in self._store.log(after=self._sent[receiver.name]):
                    self._pass_on(receiver, entry)
            except Exception as error:  # of the service or the store; the entry is sent again
                if not failed:
                    self._report(f"{receiver.name} cannot be notified: {brief(error)}")
                failed, wait = True, min(2 * wait, LONGEST)
            else:
                if failed:
                    self._report(f"{receiver.name} is notified again")
                failed, wait = False, FIRST

    def _pass_on(self, receiver: Receiver, entry: Entry) -> None:
        text = sentence(entry) if receiver.hears(entry) else ""
        if text and not receiver.rests(datetime.now().astimezone().time()):
            receiver.channel.send(text, entry)
        self._sent[receiver.name] = entry.sequence
        if text:
            self._write()

    def _write(self) -> None:
        with self._lock:
            write_json(self._file, self._sent)


def _read(file: Path) -> dict[str, int]:
    """The newest entry that each receiver was sent, as an earlier run has left it."""
    if not file.exists():
        return {}
    expected = "a file that says which entries were sent"
    with refusing(file, expected=expected, remedy="remove it: then only new entries are sent"):
        return {str(name): int(sequence) for name, sequence in read_json(file).items()}


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
