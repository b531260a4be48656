"""A PostgreSQL server for the tests: its own processes, port and temporary folder.

Its programs are those in the folder that RETWIN_POSTGRES names, else the newest of Debian. Without
them these tests are skipped; where RETWIN_POSTGRES is set, as `.ci/run` sets it, they never are.
"""

from __future__ import annotations

import itertools
import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

DEBIAN = Path("/usr/lib/postgresql")
PATIENCE = 120.0  # s, for machines that are busy
_count = itertools.count()


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """The address of a server, without the name of a database."""
    programs = _programs()
    # PostgreSQL refuses to run as root.
    user = {"user": "nobody", "extra_groups": []} if os.geteuid() == 0 else {}
    folder = Path(tempfile.mkdtemp(prefix="retwin-postgres-"))
    password = secrets.token_hex(8)
    (folder / "password").write_text(password)
    if user:
        shutil.chown(folder, "nobody")
        shutil.chown(folder / "password", "nobody")
    options = ["--username=retwin", "--auth=scram-sha-256", f"--pwfile={folder / 'password'}"]
    try:
        _run([programs / "initdb", *options, "--no-sync", "-E", "UTF8", folder / "data"], user)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        settings = {"listen_addresses": "127.0.0.1", "unix_socket_directories": ""}
        command = [programs / "postgres", "-D", folder / "data", "-p", str(port)]
        command += [part for each in settings.items() for part in ("-c", "=".join(each))]
        with (folder / "log").open("wb") as log:
            server = subprocess.Popen(command, stdout=log, stderr=log, cwd=folder, **user)
        try:
            url = f"postgresql://retwin:{password}@127.0.0.1:{port}"
            _wait(url, server, folder / "log")
            yield url
        finally:
            server.send_signal(signal.SIGQUIT)  # at once, since nothing of it is kept
            server.wait(PATIENCE)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def new_database(postgres: str) -> Callable[[], str]:
    """Makes a database, and returns its address."""
    import psycopg

    def make() -> str:
        name = f"test_{next(_count)}"
        with psycopg.connect(f"{postgres}/postgres", autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")
        return f"{postgres}/{name}"

    return make


def _programs() -> Path:
    wanted = os.environ.get("RETWIN_POSTGRES")
    found = sorted(DEBIAN.glob("*/bin"), key=lambda each: float(each.parent.name))
    folder = Path(wanted) if wanted else found[-1] if found else DEBIAN
    if (folder / "initdb").is_file():
        return folder
    if wanted:
        pytest.fail(f"RETWIN_POSTGRES is {wanted}, which holds no initdb")
    return pytest.skip("no PostgreSQL: apt-get install postgresql, or set RETWIN_POSTGRES")


def _run(command: list, user: dict) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd="/", **user)
    assert done.returncode == 0, done.stderr


def _wait(url: str, server: subprocess.Popen, log: Path) -> None:
    import psycopg

    until = time.monotonic() + PATIENCE
    while True:
        try:
            psycopg.connect(f"{url}/postgres").close()
        except psycopg.OperationalError:
            assert server.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.1)
        else:
            return
