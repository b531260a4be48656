"""`retwin monitor run --demo`: one command, and the page shows an alarm with its cause."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import httpx
import pytest

pytestmark = pytest.mark.long
SECONDS = 75


def test_the_demo_shows_an_alarm_with_its_cause() -> None:
    command = [sys.executable, "-m", "retwin", "--quiet", "monitor", "run", "--demo"]
    command += ["--port", "0", "--seconds", str(SECONDS)]
    began = time.monotonic()
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "TERM": "dumb"}
    )
    try:
        assert running.stdout is not None
        address = running.stdout.readline().decode().removeprefix("Page: ").strip()
        started = time.monotonic()
        with httpx.Client(base_url=address, timeout=60) as client:
            assert client.get("/assets").json()["emulated"]
            alarms: list = []
            while not (alarms and alarms[-1]["cause"]) and time.monotonic() < started + SECONDS:
                time.sleep(0.5)
                alarms = client.get("/alarms").json()["alarms"]
        assert alarms[-1]["asset"] == "incubator 2"
        assert alarms[-1]["cause"]["name"] == "lid"
        assert alarms[-1]["cause"]["probability"] > 0.9
        assert running.wait(timeout=SECONDS + 60) == 0
        assert b"Traceback" not in (running.stderr.read() if running.stderr else b"")
        assert started - began < 60, "twenty seconds where nothing else runs"
    finally:
        running.kill()
        running.communicate()
