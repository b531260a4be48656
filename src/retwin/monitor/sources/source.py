"""What all sources have in common: when samples count as stored, and which lines are reported."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, wait

from retwin.errors import InputError
from retwin.monitor.live.gate import Gate
from retwin.monitor.store.samples import Samples, Trajectory

AGAIN = 2.0
"""Seconds after which what failed is tried again, so that a source is back within ten."""
QUIET = 10.0
"""Seconds between two lines about refused messages, however many come."""


class Source(ABC):
    """A stream of samples into the monitor.

    Parameters
    ----------
    name : str
        What lines that are reported begin with.
    report : callable
        Takes a line about an event.

    Attributes
    ----------
    connected : bool
        Whether it is there; False before the first connection.
    refused : int
        Messages or rows that held no samples.

    """

    def __init__(self, name: str, report: Callable[[str], None]) -> None:
        self.name = name
        self.connected = False
        self.refused = 0
        self._report = report
        self._complained = False
        self._unreported = 0
        self._reported = -QUIET

    @abstractmethod
    def run(self, gate: Gate, stop: threading.Event) -> None:
        """Send samples to the gate until `stop` is set; a source that is lost is tried again."""

    def keep_running(self, gate: Gate, stop: threading.Event) -> None:
        """Run, and run again where that fails unexpectedly."""
        while not stop.is_set():
            try:
                self.run(gate, stop)
            except Exception as error:
                self.lost(repr(error))
                stop.wait(AGAIN)

    def back(self) -> None:
        """Report that the source is there, if it was not."""
        if not self.connected:
            self._report(f"{self.name}: {'back' if self._complained else 'connected'}")
        self.connected, self._complained = True, False

    def lost(self, reason: object) -> None:
        """Report that the source is not there, unless that was reported already."""
        if not self._complained:
            self._report(f"{self.name}: lost ({reason}); it is tried again")
        self.connected, self._complained = False, True

    def refuse(self, reason: object) -> None:
        """Count what holds no samples, and report it, at most every ten seconds."""
        self.refused += 1
        self._unreported += 1
        now = time.monotonic()
        if now - self._reported >= QUIET:
            more = f"{self._unreported} refused, the last one: " * (self._unreported > 1)
            self._report(f"{self.name}: {more or 'refused: '}{reason}")
            self._reported, self._unreported = now, 0

    def stored(
        self,
        gate: Gate,
        samples: Samples | Trajectory,
        stop: threading.Event,
        first: Future | None = None,
    ) -> bool:
        """Whether samples are durable; False if `stop` was set and they are not.

        Where the store fails, that is reported once, and they are sent again until it stores.

        Parameters
        ----------
        gate : Gate
            Where samples go.
        samples : Samples or Trajectory
            Those of one machine.
        stop : Event
            Ends the attempts.
        first : Future, optional
            What `gate.send` returned for these samples, if they were sent already.

        """
        failed = False
        while not (failed and stop.is_set()):
            try:
                if not _finished(first or gate.send(samples), stop):
                    return False
            except Exception as error:  # whatever it was, the source has to go on
                if not failed:
                    reason = error if isinstance(error, InputError) else repr(error)
                    self._report(f"{self.name}: not stored, it is tried again: {reason}")
                failed, first = True, None
                stop.wait(AGAIN)
            else:
                if failed:
                    self._report(f"{self.name}: stored again")
                return True
        return False


def _finished(future: Future, stop: threading.Event) -> bool:
    """Whether a future has a result; False if it has none some time after `stop` was set."""
    while not wait([future], timeout=0.5).done:
        if stop.is_set():
            return False
    future.result()
    return True
