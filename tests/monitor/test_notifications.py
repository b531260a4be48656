"""Who hears of events: once, in order, after failures and restarts, and not at quiet times."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from datetime import datetime, time, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from retwin.errors import InputError
from retwin.monitor import Store
from retwin.monitor.live.notifications import (
    FILE,
    AppriseChannel,
    FileChannel,
    Notifications,
    Receiver,
)

KINDS = ("alarm", "cause", "end", "void")


def alarm(asset: str, second: int, event: int | None = None) -> tuple[str, dict]:
    at, begun = second * 10**9, (second if event is None else event) * 10**9
    about = {"asset": asset, "time": at, "event": begun, "output": "level", "change": "higher"}
    return "alarm", about


def end(asset: str, second: int) -> tuple[str, dict]:
    return "end", {"asset": asset, "time": second * 10**9, "event": 0, "how": "it follows again"}


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "store") as opened:
        yield opened


@pytest.fixture
def wait_until() -> Callable[[Callable[[], bool]], None]:
    def wait(reached: Callable[[], bool], seconds: float = 20.0) -> None:
        until = datetime.now() + timedelta(seconds=seconds)
        while not reached():
            assert datetime.now() < until
            threading.Event().wait(0.02)

    return wait


@pytest.fixture
def webhook() -> Iterator[tuple[str, list[dict], list[int]]]:
    """An HTTP server: its address, what it took, and the status codes that it answers first."""
    taken: list[dict] = []
    codes: list[int] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            code = codes.pop(0) if codes else 200
            if code == 200:
                taken.append(body)
            self.send_response(code)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Print nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"json://127.0.0.1:{server.server_port}/hook", taken, codes
    server.shutdown()
    server.server_close()


def lines(file: Path) -> list[dict]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def test_an_event_is_one_message_and_its_end_another(
    store: Store, tmp_path: Path, wait_until
) -> None:
    file = tmp_path / "events.jsonl"
    store.commit([], [alarm("press", 0)])  # before the first start
    receiver = Receiver("shift", FileChannel(file), KINDS)
    with Notifications(store, [receiver], print):
        store.commit([], [alarm("press", 5), alarm("press", 6, event=5), end("press", 9)])
        wait_until(lambda: len(lines(file)) == 2)
    first, last = lines(file)
    assert first["text"] == "press: ALARM 1: level, higher (1970-01-01T00:00:05Z)"
    assert last["text"] == "press: event ended, it follows again (1970-01-01T00:00:09Z)"
    with Notifications(store, [receiver], print):
        store.commit([], [alarm("press", 20)])
        wait_until(lambda: len(lines(file)) > 2)
    assert [each["entry"] for each in lines(file)] == [1, 3, 4], "nothing twice"


def test_what_a_webhook_does_not_take_is_sent_again_also_after_a_restart(
    store: Store, webhook, wait_until
) -> None:
    address, taken, codes = webhook
    said: list[str] = []
    receiver = Receiver("plant", AppriseChannel(address), KINDS)
    codes += [503] * 1000
    with Notifications(store, [receiver], said.append):
        store.commit([], [alarm("press", 5), end("press", 9)])
        wait_until(lambda: len(said) == 1)
    assert taken == []
    assert said == ["plant cannot be notified: the service did not take the message"]
    codes.clear()
    with Notifications(store, [receiver], said.append):
        wait_until(lambda: len(taken) == 2)
    assert [each["title"] for each in taken] == ["retwin, entry 0: press", "retwin, entry 1: press"]
    assert "ALARM 0: level, higher" in taken[0]["message"]


def test_a_receiver_hears_of_its_machines_and_kinds_alone(
    store: Store, tmp_path: Path, wait_until
) -> None:
    own, every = tmp_path / "own.jsonl", tmp_path / "every.jsonl"
    receivers = [
        Receiver("own", FileChannel(own), ("end",), assets=("pump",)),
        Receiver("every", FileChannel(every), KINDS),
    ]
    with Notifications(store, receivers, print):
        store.commit([], [alarm("press", 1), end("press", 2), alarm("pump", 3), end("pump", 4)])
        wait_until(lambda: len(lines(every)) == 4 and len(lines(own)) == 1)
    assert lines(own)[0]["data"]["asset"] == "pump"


@pytest.mark.parametrize(
    ("now", "rests"), [("21:59", False), ("22:00", True), ("03:00", True), ("06:00", False)]
)
def test_quiet_times_may_go_past_midnight(now: str, rests: bool) -> None:
    span = (time(22), time(6))
    receiver = Receiver("night", FileChannel(Path("unused")), KINDS, quiet=[span])
    assert receiver.rests(time.fromisoformat(now)) is rests


def test_what_happens_at_a_quiet_time_is_never_sent(
    store: Store, tmp_path: Path, wait_until
) -> None:
    file, heard = tmp_path / "quiet.jsonl", tmp_path / "heard.jsonl"
    always = [(time(0), time(12)), (time(12), time(0))]
    receivers = [
        Receiver("quiet", FileChannel(file), KINDS, quiet=always),
        Receiver("heard", FileChannel(heard), KINDS),
    ]
    remembered = store.folder / FILE
    with Notifications(store, receivers, print):
        store.commit([], [alarm("press", 1)])
        wait_until(lambda: len(lines(heard)) == 1)
        wait_until(lambda: json.loads(remembered.read_text()) == {"quiet": 0, "heard": 0})
    with Notifications(store, [Receiver("quiet", FileChannel(file), KINDS)], print):
        store.commit([], [alarm("press", 50)])
        wait_until(lambda: len(lines(file)) == 1)
    assert lines(file)[0]["entry"] == 1


def test_bad_input_is_named(store: Store) -> None:
    with pytest.raises(InputError, match="address as Apprise writes it") as error:
        AppriseChannel("nonsense://secret@host")
    assert "secret" not in str(error.value)
    (store.folder / FILE).write_text("[1]")
    with pytest.raises(InputError, match=r"notified\.json.*remove it"):
        Notifications(store, [], print)
