"""A Mosquitto broker for the tests: its own process, port and temporary folder.

Its program is the one that RETWIN_MOSQUITTO names, else the one on the path or in /usr/sbin.
Without it these tests are skipped; where RETWIN_MOSQUITTO is set, as `.ci/run` sets it, they never
are.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest

PATIENCE = 60.0  # s, for machines that are busy


def free_port() -> int:
    """A port of the loopback interface that nothing listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Broker:
    """A broker that keeps what it has on the disk, and can be stopped and started again."""

    def __init__(self, folder: Path, *settings: str) -> None:
        self.port = free_port()
        self._folder = folder
        folder.mkdir()
        lines = [
            f"listener {self.port} 127.0.0.1",
            "persistence true",
            f"persistence_location {folder}/",
            "max_queued_messages 0",
            "user root",  # as root it would else be one who may not write there
            *(settings or ("allow_anonymous true",)),
        ]
        (folder / "conf").write_text("\n".join(lines) + "\n")
        self._process: subprocess.Popen | None = None

    def start(self) -> Broker:
        log = self._folder / "log"
        with log.open("ab") as file:
            command = [_program(), "-c", str(self._folder / "conf")]
            self._process = subprocess.Popen(command, stdout=file, stderr=file)
        until = time.monotonic() + PATIENCE
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), 1).close()
            except OSError:
                assert self._process.poll() is None, log.read_text()
                assert time.monotonic() < until, log.read_text()
                time.sleep(0.05)
            else:
                return self

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait(PATIENCE)


def _program() -> str:
    wanted = os.environ.get("RETWIN_MOSQUITTO")
    found = shutil.which(wanted or "mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
    if found is None and wanted:
        pytest.fail(f"RETWIN_MOSQUITTO is {wanted}, which is no program")
    return found or pytest.skip("no Mosquitto: apt-get install mosquitto, or set RETWIN_MOSQUITTO")
