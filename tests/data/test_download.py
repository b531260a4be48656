"""Fetching over loopback: the checksum, the cache, and what is said when nothing comes."""

import hashlib
import logging
import threading
import time
import zlib
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pooch
import pytest

import retwin as rt
from retwin.catalog import DOWNLOADS, PublicFile
from retwin.data import download
from retwin.data.download import fetch
from retwin.errors import InputError

CONTENT = bytes(range(256)) * 400
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Server:
    """A web server on loopback that counts what is asked of it."""

    def __init__(self):
        self.content = CONTENT
        self.headers = {}
        self.pause = None
        self.over = threading.Event()
        self.promised = None
        self.asked = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                server.asked.append(self.path)
                if self.path != "/data.mat":
                    self.send_error(404)
                    return
                self.send_response(200)
                length = server.promised or len(server.content)
                headers = server.headers or {"Content-Length": str(length)}
                for name, value in headers.items():
                    self.send_header(name, value)
                self.end_headers()
                with suppress(OSError):  # the client has gone
                    server.send(self.wfile)

            def log_message(self, *_):
                """Keep quiet."""

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}/data.mat"
        self.thread = threading.Thread(target=self.http.serve_forever, args=(0.02,))
        self.thread.start()

    def send(self, file):
        """The content; in pieces, again and again, if there is a pause between them."""
        if self.pause is None:
            file.write(self.content)
            return
        while not self.over.wait(self.pause):
            file.write(self.content)
            file.flush()

    def stop(self):
        self.over.set()
        self.http.shutdown()
        self.thread.join()
        self.http.server_close()


@pytest.fixture
def server(monkeypatch):
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "127.0.0.1")
    running = Server()
    monkeypatch.setitem(DOWNLOADS, "toy", PublicFile(running.url, SHA256, "toy/data.mat"))
    yield running
    running.stop()


def left(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_fetch_downloads_once(tmp_path, server, caplog):
    level = pooch.get_logger().level
    with caplog.at_level(logging.DEBUG):
        path = fetch("toy", folder=tmp_path)
        assert path == tmp_path / "toy" / "data.mat"
        assert path.read_bytes() == CONTENT
        assert fetch("toy", folder=tmp_path) == path
    assert server.asked == ["/data.mat"]
    assert left(tmp_path) == ["toy", "toy/data.mat"]
    assert not [record for record in caplog.records if record.name == "pooch"]
    assert pooch.get_logger().level == level


def test_fetch_tells_its_progress(tmp_path, server):
    shares = []
    fetch("toy", folder=tmp_path, progress=shares.append)
    assert shares[-1] == 1.0
    assert shares == sorted(shares)
    assert all(0 < share <= 1 for share in shares)


def test_cache_by_variable_and_by_default(tmp_path, server, monkeypatch):
    monkeypatch.setenv("RETWIN_CACHE", str(tmp_path / "mine"))
    assert fetch("toy") == tmp_path / "mine" / "toy" / "data.mat"
    assert fetch("toy", folder=tmp_path / "given").is_relative_to(tmp_path / "given")
    monkeypatch.delenv("RETWIN_CACHE")
    monkeypatch.setattr(pooch, "os_cache", lambda name: tmp_path / "user" / name)
    assert fetch("toy") == tmp_path / "user" / "retwin" / "toy" / "data.mat"


def test_wrong_checksum_leaves_nothing(tmp_path, server):
    server.content = CONTENT + b"!"
    with pytest.raises(RuntimeError, match="thrown away") as caught:
        fetch("toy", folder=tmp_path)
    assert SHA256 in str(caught.value)
    assert "\n" not in str(caught.value)
    assert left(tmp_path) == []


def test_damaged_cache_is_fetched_again_and_kept_when_that_fails(tmp_path, server):
    path = fetch("toy", folder=tmp_path)
    path.write_bytes(b"damaged")
    assert fetch("toy", folder=tmp_path).read_bytes() == CONTENT
    assert len(server.asked) == 2


def test_download_that_breaks_off_leaves_nothing(tmp_path, server):
    server.content, server.promised = CONTENT[:1000], len(CONTENT)
    with pytest.raises((OSError, RuntimeError)) as caught:
        fetch("toy", folder=tmp_path)
    assert "fetch toy" in str(caught.value)
    assert left(tmp_path) == []


def test_an_endless_stream_is_cut_off(tmp_path, server):
    server.headers, server.pause = {"Connection": "close"}, 0.0
    with pytest.raises(InputError, match=r"toy: expected contents of at most 1 MB, as given"):
        fetch("toy", folder=tmp_path, max_bytes=10**6)
    assert left(tmp_path) == []


def test_a_file_that_is_larger_than_it_may_be_is_not_begun(tmp_path, server):
    server.promised, server.pause = 2**40, 10.0
    begun = time.monotonic()
    with pytest.raises(InputError, match=r"toy: .*at most 4.29 GB, as given, got 1.1e\+03 GB"):
        fetch("toy", folder=tmp_path)
    assert time.monotonic() - begun < 5
    assert left(tmp_path) == []


def test_a_slow_drip_ends_in_time(tmp_path, server, monkeypatch):
    server.content, server.promised, server.pause = b"x", 10**6, 0.05
    monkeypatch.setattr(download, "MAX_SECONDS", 0.5)
    begun = time.monotonic()
    with pytest.raises(OSError, match=r"not complete after 0.5 s.*check the network"):
        fetch("toy", folder=tmp_path)
    assert time.monotonic() - begun < 5
    assert left(tmp_path) == []


def test_headers_that_drip_end_in_time(tmp_path, server, monkeypatch):
    class Slow(dict):
        def items(self):
            while not server.over.wait(0.05):
                yield "X-More", "x"

    server.headers = Slow(x="")
    monkeypatch.setattr(download, "MAX_SECONDS", 0.5)
    with pytest.raises(OSError, match=r"not complete after 0.5 s"):
        fetch("toy", folder=tmp_path)
    assert left(tmp_path) == []


def test_packed_contents_are_not_unpacked(tmp_path, server):
    packer = zlib.compressobj(9, wbits=31)
    server.content = packer.compress(bytes(10**8)) + packer.flush()
    server.headers = {"Content-Encoding": "gzip", "Content-Length": str(len(server.content))}
    with pytest.raises(RuntimeError, match="thrown away"):
        fetch("toy", folder=tmp_path, max_bytes=10**6)
    assert left(tmp_path) == []


def test_no_such_file_there(tmp_path, server):
    with pytest.raises(OSError, match="404") as caught:
        fetch("toy", folder=tmp_path, url=server.url + ".zip")
    assert "\n" not in str(caught.value)
    assert left(tmp_path) == []


def test_no_network_says_so_in_one_line(tmp_path, server):
    server.http.server_close()  # nobody listens at that port any more
    with pytest.raises(OSError, match="check the network") as caught:
        fetch("toy", folder=tmp_path)
    assert "\n" not in str(caught.value)
    assert server.url in str(caught.value)
    assert left(tmp_path) == []


def test_a_file_that_only_the_caller_knows(tmp_path, server):
    path = fetch("mine.mat", folder=tmp_path, url=server.url, sha256=SHA256)
    assert path == tmp_path / "mine.mat"
    assert path.read_bytes() == CONTENT
    with pytest.raises(RuntimeError):
        fetch("other.mat", folder=tmp_path, url=server.url, sha256="0" * 64)
    assert left(tmp_path) == ["mine.mat"]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("arm", {}),
        ("arm", {"url": "https://example.org/x"}),
        ("arm", {"sha256": SHA256}),
        ("../arm", {"url": "https://example.org/x", "sha256": SHA256}),
        ("", {"url": "https://example.org/x", "sha256": SHA256}),
    ],
)
def test_unknown_names_list_the_known(tmp_path, name, options):
    with pytest.raises(InputError, match="one of armpi"):
        fetch(name, folder=tmp_path, **options)
    assert left(tmp_path) == []


@pytest.mark.parametrize("url", ["ftp://example.org/x", "file:///etc/hostname", "x.mat"])
def test_only_web_addresses(tmp_path, url):
    with pytest.raises(InputError, match="https://"):
        fetch("x.mat", folder=tmp_path, url=url, sha256=SHA256)


def test_folder_that_cannot_be_made(tmp_path, server):
    (tmp_path / "file").write_text("x")
    with pytest.raises(rt.InputError, match="expected a place that can be written"):
        fetch("toy", folder=tmp_path / "file")


def test_the_registry_names_public_files_by_checksum():
    for known in DOWNLOADS.values():
        assert known.url.startswith("https://")
        assert len(bytes.fromhex(known.sha256)) == 32
        assert known.url.endswith(known.file.split("/")[-1])
