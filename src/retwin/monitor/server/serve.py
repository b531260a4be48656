"""The monitor's HTTP interface on a port of this machine, until it is stopped."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from retwin.checks import needs_extra
from retwin.errors import InputError, brief
from retwin.monitor.server.guard import RequestGuard

PORT = 8710
"""The port unless another one is given."""
PATIENCE = 3
"""Seconds for which requests are finished at the end."""


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens at an address; port 0 is any free one.

    Raises
    ------
    InputError
        The port is in use, or the address is not one of this machine.

    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        bound = socket.create_server((host, port), family=family, backlog=256)
        # Connections inherit it; without it the body of an answer waits 40 ms for the peer.
        bound.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return bound
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(
            "port",
            expected=f"one of {host} that is free",
            got=f"{port}: {brief(error)}",
            remedy="give another one, or 0 for any that is free",
        ) from None


@contextmanager
def serving(app: RequestGuard, bound: socket.socket) -> Iterator[None]:
    """Serve an application of `create_app` in a thread while the block runs.

    The socket is one of `listening`.
    """
    uvicorn = needs_extra("uvicorn", "monitor", "serves the monitor's page")
    config = uvicorn.Config(
        app,
        log_level="warning",
        lifespan="off",
        access_log=False,
        server_header=False,
        limit_concurrency=500,
        timeout_graceful_shutdown=PATIENCE,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([bound],), name="server")
    thread.start()
    try:
        yield
    finally:
        app.closing.set()
        server.should_exit = True
        thread.join()
