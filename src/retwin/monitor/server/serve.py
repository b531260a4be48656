"""The monitor's HTTP interface on a port of this machine, until it is stopped."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from retwin.checks import needs_extra
from retwin.errors import InputError, brief
from retwin.monitor.server.guard import RequestGuard

if TYPE_CHECKING:
    import uvicorn
    from uvicorn.protocols.http.h11_impl import H11Protocol
else:
    uvicorn = needs_extra("uvicorn", "monitor", "serves the monitor's page")
    from uvicorn.protocols.http.h11_impl import H11Protocol

HEADERS = 10.0
"""Seconds within which the headers of a request have to end, or its connection is closed: each one
counts towards those that are served at the same time, and no token was asked for yet."""


class _Protocol(H11Protocol):
    """A connection that is closed where a request does not begin in time.

    The server itself bounds the pause before the first byte of a further request alone.
    """

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._expect()

    def connection_lost(self, error: Exception | None) -> None:
        self._expect(ended=True)
        super().connection_lost(error)

    def on_response_complete(self) -> None:
        self._expect()
        super().on_response_complete()

    def _expect(self, *, ended: bool = False) -> None:
        """Close the connection later, unless another request than the present one has begun."""
        if self._deadline is not None:
            self._deadline.cancel()
        if not ended:
            self._deadline = self.loop.call_later(HEADERS, self._close_after, self.cycle)

    def _close_after(self, cycle: object) -> None:
        if self.cycle is cycle:
            self.transport.close()


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
        expected = f"one of {host} that is free"
        got = f"{port}: {brief(error)}"
        remedy = "give another one, or 0 for any that is free"
        raise InputError("port", expected=expected, got=got, remedy=remedy) from None


@contextmanager
def serving(app: RequestGuard, bound: socket.socket, *, patience: int = 3) -> Iterator[None]:
    """Serve an application of `create_app` in a thread while the block runs.

    The socket is one of `listening`.

    Parameters
    ----------
    patience : int, default 3
        Seconds for which requests are finished at the end.

    """
    config = uvicorn.Config(
        app,
        http=_Protocol,
        log_level="warning",
        lifespan="off",
        access_log=False,
        server_header=False,
        limit_concurrency=500,
        timeout_graceful_shutdown=patience,
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
