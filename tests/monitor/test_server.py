"""The HTTP interface of the live monitor: what it answers, and what it refuses."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from urllib.parse import quote

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families
from served import ASSETS, BEGIN, LEAKING, LEVEL, STEPS, TWIN, Served, served

from retwin.errors import InputError
from retwin.monitor import Registry, verify
from retwin.monitor.server import create_app, listening
from retwin.monitor.server.guard import MAX_BODY
from retwin.monitor.server.serve import HEADERS

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """With a machine that leaks, and one that does not."""
    with served(tmp_path_factory.mktemp("server")) as made:
        made.send(LEAKING, 0, STEPS)
        made.send("plain", 0, STEPS)
        made.explanations.wait()
        yield made


@pytest.fixture
def client(server: Served) -> Iterator[httpx.Client]:
    with server.client() as opened:
        yield opened


def routes(client: httpx.Client) -> list[tuple[str, str]]:
    """All methods and paths of the interface, with values in place of names."""
    values = {
        "sequence": "3",
        "number": "2",
        "twin": quote(TWIN),
        "name": "plain",
        "step": "shadow",
    }
    paths = client.get("/openapi.json").json()["paths"]
    return [(method, path.format_map(values)) for path, own in paths.items() for method in own]


def test_the_worst_asset_is_first_and_named_as_it_is(client: httpx.Client) -> None:
    found = client.get("/assets").json()["assets"]
    assert [found[0]["asset"], found[0]["state"]] == [LEAKING, "alarm"]
    assert {each["asset"] for each in found} == set(ASSETS)
    for name in ASSETS:
        one = client.get(f"/assets/{quote(name, safe='')}").json()
        assert one["status"]["asset"] == name
    assert one["outputs"] == [[LEVEL, "m"]]
    assert len(one["times"]) == len(one["measured"]) == len(one["evidence"]) == STEPS
    newest = client.get("/assets/plain", params={"after": BEGIN + STEPS - 3}).json()
    assert newest["times"] == [BEGIN + STEPS - 2, BEGIN + STEPS - 1]
    assert newest["low"][0][0] < newest["mean"][0][0] < newest["high"][0][0]


def test_an_alarm_has_a_cause_and_is_acknowledged(client: httpx.Client, server: Served) -> None:
    page = client.get("/alarms", params={"limit": 1}).json()
    whole = client.get("/alarms", params={"asset": LEAKING}).json()["alarms"]
    assert page["alarms"] == whole[:1]
    first = whole[-1]
    assert first["alarms"] > 1  # one event, to which further alarms belong
    assert 200 <= first["time"] - BEGIN < 230
    assert first["cause"]["name"].startswith("leak")
    assert first["cause"]["unit"] == "1/s"
    low, high = first["cause"]["onset"][1:]
    assert low - 5 <= BEGIN + 200 <= high + 5
    assert "parameter drain" in first["cause"]["check"]
    around = client.get(f"/alarms/{first['sequence']}/samples").json()
    assert around["times"][0] < first["time"] < around["times"][-1]
    path = f"/alarms/{whole[0]['sequence']}/acknowledge"  # the newest, and so all before it
    note = {"who": "<b>me</b>", "note": "closed the valve"}
    assert client.post(path, json=note).status_code == 200
    found = client.get(f"/alarms/{first['sequence']}").json()["acknowledged"]
    assert {key: found[key] for key in note} == note
    assert client.get("/assets").json()["assets"][0]["state"] != "alarm"
    assert client.post("/alarms/9999/acknowledge", json=note).status_code == 400
    assert verify(server.store.log()).ok


def test_samples_are_counted_once(client: httpx.Client, server: Served) -> None:
    assert server.send(ASSETS[1], 0, 10)["used"] == 10
    counts = server.send(ASSETS[1], 5, 12)
    assert (counts["used"], counts["repeated"]) == (2, 5)
    lines = "\n".join(
        json.dumps({"asset": ASSETS[1], "time": BEGIN + k, "values": {LEVEL: None}})
        for k in (8, 9, 12)
    )
    counts = client.post("/samples", content=lines).json()[ASSETS[1]]
    assert (counts["used"], counts["repeated"]) == (1, 2)


@pytest.mark.parametrize(
    ("document", "words"),
    [
        (b"", "samples: expected a JSON object"),
        (b"[" * 100_000, "samples: expected a JSON object"),
        (b"\xff\xfe", "samples: expected a JSON object"),
        (b'{"asset": "nobody", "time": 1, "values": {}}', "asset: expected one of"),
        (b'{"asset": "plain", "time": 1e999, "values": {}}', "time: expected seconds"),
        (b'{"asset": "plain", "time": 1, "values": {"x": 1}}', "expected channels among"),
    ],
)
def test_samples_that_are_none_are_refused_in_one_line(
    client: httpx.Client, document: bytes, words: str
) -> None:
    answer = client.post("/samples", content=document)
    assert answer.status_code == 400
    assert words in answer.json()["error"]
    assert "\n" not in answer.json()["error"]


def test_bodies_are_bounded(client: httpx.Client) -> None:
    whole = b" " * (MAX_BODY + 1)
    assert client.post("/samples", content=whole).status_code == 413
    parts = (whole[at : at + 2**16] for at in range(0, len(whole), 2**16))
    assert client.post("/samples", content=parts).status_code == 413


@pytest.mark.parametrize("token", ["x", "x" * 43, "Bearer"])
def test_nothing_is_written_without_the_token(server: Served, token: str) -> None:
    head = server.store.head
    with server.client(token) as stranger:
        for method, path in routes(stranger):
            if method != "get":
                answer = stranger.request(method, path, json={})
                assert answer.status_code == 401, path
                assert answer.headers["www-authenticate"] == "Bearer"
    assert httpx.post(f"{server.url}/samples", content=b"{}").status_code == 401
    assert server.store.head == head


def test_a_token_must_be_long(server: Served) -> None:
    for token in ("", "short", "é" * 40):
        with pytest.raises(InputError, match="token"):
            create_app(server.live, None, token=token)  # type: ignore[arg-type]


def test_other_names_of_the_server_are_refused(client: httpx.Client, server: Served) -> None:
    """A name that an attacker lets resolve to this machine (DNS rebinding)."""
    for host in ("evil.example", "127.0.0.1.evil.example", "", "localhost.", "[::1"):
        answer = client.get("/assets", headers={"host": host})
        assert answer.status_code in (400, 421), host  # 400 by uvicorn, if it is no host at all
    for host in ("localhost:1", "LOCALHOST", "[::1]:80", "127.0.0.1"):
        assert client.get("/assets", headers={"host": host}).status_code == 200


def test_no_path_leads_out_of_the_page(client: httpx.Client) -> None:
    for path in ("/../store", "/page/index.html", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd"):
        assert client.get(path).status_code == 404
    for path in ("/", "/page.js", "/page.css", "/uplot.js", "/uplot.css"):
        answer = client.get(path)
        assert answer.status_code == 200
        policy = answer.headers["content-security-policy"]
        assert "script-src 'self'" in policy
        assert "unsafe" not in policy
    assert "<script>" not in client.get("/").text
    assert client.get("/docs").status_code == 404, "it would load scripts from elsewhere"


def test_prometheus_reads_the_metrics(client: httpx.Client) -> None:
    families = {
        each.name: each for each in text_string_to_metric_families(client.get("/metrics").text)
    }
    used = {
        each.labels["asset"]: each.value
        for each in families["retwin_samples"].samples
        if each.labels["result"] == "used"
    }
    assert used[LEAKING] == STEPS
    assert families["retwin_samples_seconds"].type == "histogram"
    alarms = {each.labels["asset"]: each.value for each in families["retwin_alarms"].samples}
    assert alarms[LEAKING] >= 1
    assert alarms["plain"] == 0


def test_versions_are_compared_and_changed(client: httpx.Client, server: Served) -> None:
    path = f"/versions/{quote(TWIN)}"
    states = [each["state"] for each in client.get(path).json()["versions"]]
    assert states == ["active", "shadow"]
    found = client.get(f"{path}/2/comparison").json()
    assert found["low"] < found["difference"] < found["high"]
    assert found["samples"] >= STEPS / 2
    assert found["better"]
    assert "version that was active before" in client.post(f"{path}/rollback", json={}).text
    assert client.post(f"{path}/2/promote", json={}).json()["state"] == "active"
    assert client.get("/assets").json()["assets"][0]["version"] == 2
    assert client.post(f"{path}/rollback", json={"reason": "a test"}).json()["number"] == 1
    assert client.get("/assets").json()["assets"][0]["version"] == 1
    registry = Registry(server.store, TWIN)
    worse = registry.propose(registry.folder(1), "the same").number
    assert client.post(f"{path}/{worse}/shadow", json={}).status_code == 200
    answer = client.post(f"{path}/{worse}/promote", json={})
    assert answer.status_code == 400
    assert "evidence: expected a difference in CRPS" in answer.json()["error"]
    assert client.post(f"{path}/{worse}/reject", json={}).json()["state"] == "rejected"
    assert client.get("/versions/nobody").status_code == 400


def test_events_follow_what_happens(client: httpx.Client, server: Served) -> None:
    with client.stream("GET", "/events") as events:
        lines = (line for line in events.iter_lines() if line)
        first = next(lines)
        server.send(ASSETS[2], 0, 5)
        assert next(lines) != first


HOSTILE = [
    "..",
    "%2e%2e",
    "/",
    "\x00",
    "'--",
    "1e999",
    "-1",
    "9" * 30,
    "\u202e",
    "<script>",
    "{}",
    "NaN",
]
parts = st.one_of(st.sampled_from(HOSTILE), st.text(max_size=12))
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | parts,
    lambda each: st.lists(each, max_size=3) | st.dictionaries(parts, each, max_size=3),
    max_leaves=8,
)
known = st.sampled_from(
    [
        "assets",
        "alarms",
        "versions",
        "samples",
        "metrics",
        "3",
        "1",
        "promote",
        "rollback",
        "comparison",
        "acknowledge",
        "plain",
        TWIN,
        "shadow",
    ]
)


@settings(
    max_examples=300, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
@given(
    st.sampled_from(["GET", "POST", "PUT", "DELETE", "HEAD", "OPTIONS", "TRACE"]),
    st.lists(known | parts, max_size=5),
    st.dictionaries(
        st.sampled_from(["after", "before", "limit", "asset"]) | parts, parts, max_size=3
    ),
    st.binary(max_size=40) | values.map(lambda each: json.dumps(each).encode()),
    st.sampled_from(["application/json", "text/plain", "multipart/form-data", ""]),
)
def test_no_request_is_an_error_of_the_server(
    client: httpx.Client,
    server: Served,
    method: str,
    path: list[str],
    query: dict,
    body: bytes,
    kind: str,
) -> None:
    target = "/".join(quote(each.encode("utf-8", "surrogatepass"), safe="%") for each in path)
    headers = {"content-type": kind}
    url = f"{server.url}/{target}"
    answer = client.request(method, url, params=query, content=body, headers=headers)
    assert answer.status_code < 500, answer.text
    if answer.status_code >= 400 and method != "HEAD":
        assert "\n" not in answer.json()["error"]


@pytest.mark.parametrize(
    "path", ["/assets/%ff", "/assets/%ed%a0%80", "/versions/%00", "/alarms/1e3"]
)
def test_names_that_are_no_text_are_refused(client: httpx.Client, path: str) -> None:
    answer = client.get(path)
    assert 400 <= answer.status_code < 500
    assert answer.json()["error"]


@pytest.mark.parametrize(
    "text", ['"\\ud800"', '"\\u0000"', '"\\u202e<b>"', "1e999", "[[]]", '"' + "x" * 3000 + '"']
)
def test_odd_notes_are_stored_or_refused(client: httpx.Client, text: str) -> None:
    (alarm, *_) = client.get("/alarms").json()["alarms"]
    body = f'{{"who": "me", "note": {text}}}'.encode()
    kind = {"content-type": "application/json"}
    answer = client.post(f"/alarms/{alarm['sequence']}/acknowledge", content=body, headers=kind)
    assert answer.status_code in (200, 400, 422)
    assert client.get("/alarms").status_code == 200


def test_headers_that_never_end_are_closed_and_what_was_asked_for_is_not(
    client: httpx.Client, server: Served
) -> None:
    host, port = "127.0.0.1", int(server.url.rpartition(":")[2])
    request = b"GET /assets HTTP/1.1\r\nHost: localhost\r\n"
    with client.stream("GET", "/events") as events, ExitStack() as opened:
        lines = (line for line in events.iter_lines() if line)
        first = next(lines)
        slow = [opened.enter_context(socket.create_connection((host, port))) for _ in range(3)]
        slow[1].sendall(request)
        slow[2].sendall(request + b"\r\n")  # and, after its answer, one that never ends
        assert slow[2].recv(2**16).startswith(b"HTTP/1.1 200")
        ends = [0.0] * len(slow)
        began = time.monotonic()
        while not all(ends) and time.monotonic() - began < HEADERS + 5:
            for i, each in enumerate(slow):
                with suppress(OSError):
                    each.sendall(b"X" if i else b"")
                each.settimeout(0.2)
                with suppress(TimeoutError):
                    try:
                        over = not each.recv(2**16)
                    except ConnectionError:
                        over = True
                    if over and not ends[i]:
                        ends[i] = time.monotonic() - began
        assert all(0 < each < HEADERS + 2 for each in ends), ends
        server.send(ASSETS[2], 5, 9)
        assert next(lines) != first  # an answer that lasts goes on


def test_an_answer_does_not_wait_for_an_acknowledgement(client: httpx.Client) -> None:
    """Its head and its body are sent at once: 40 ms are what TCP would wait otherwise."""
    seconds = []
    for _ in range(40):
        began = time.perf_counter()
        client.get("/page.css")
        seconds.append(time.perf_counter() - began)
    assert sorted(seconds)[5] < 0.03


def test_a_port_in_use_is_an_error_in_one_line(server: Served) -> None:
    port = int(server.url.rpartition(":")[2])
    with pytest.raises(
        InputError, match=f"port: expected one of 127.0.0.1 that is free, got {port}"
    ):
        listening("127.0.0.1", port)
