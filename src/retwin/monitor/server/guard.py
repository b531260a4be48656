"""What every request passes before the application sees it, and what every answer carries."""

from __future__ import annotations

import asyncio
import hmac
import threading
from collections.abc import Collection
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse

MAX_BODY = 2**22
"""Bytes of a request's body at most."""
PATIENCE = 30.0
"""Seconds within which a body must have arrived."""
LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})
READING = frozenset({"GET", "HEAD"})
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
}


class RequestGuard:
    """Refuses foreign hosts, writes without the token and large bodies; adds headers.

    A page of another site that a browser shows cannot read from here, since its requests carry the
    name of that site even where that name was made to resolve to this machine (DNS rebinding).

    Parameters
    ----------
    app
        The ASGI application.
    token : str
        What a request that writes must present, as `Authorization: Bearer TOKEN`.
    hosts : collection of str
        Names of this server beside those of the loopback interface.

    """

    def __init__(self, app: Any, token: str, hosts: Collection[str] = ()) -> None:
        self._app = app
        self.closing = threading.Event()
        """Set when the server ends: answers without an end do so too."""
        self._token = f"Bearer {token}".encode()
        self._hosts = LOOPBACK | {each.lower() for each in hosts}

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request, as ASGI demands."""
        if scope["type"] != "http":
            # Of the life of the server; there are no web sockets.
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return
        answered = _dressed(send)
        refused = self._refused(scope["method"], Headers(scope=scope))
        if refused is None and scope["method"] not in READING:
            body = await _body(receive)
            if isinstance(body, bytes):
                receive = _again(body, receive)
            else:
                refused = body
        answer = self._app
        if refused is not None:
            status, error = refused
            headers = {"connection": "close"}
            if status == 401:
                headers["www-authenticate"] = "Bearer"
            answer = JSONResponse({"error": error}, status, headers)
        await answer(scope, receive, answered)

    def _refused(self, method: str, headers: Headers) -> tuple[int, str] | None:
        if _name(headers.get("host", "")) not in self._hosts:
            return 421, "host: expected a name of this server; add it to `hosts`"
        if method in READING:
            return None
        if not hmac.compare_digest(headers.get("authorization", "").encode(), self._token):
            return 401, "authorization: expected the token of this server, as Bearer TOKEN"
        length = headers.get("content-length", "0")
        if not length.isdigit() or len(length) > 12 or int(length) > MAX_BODY:
            return LARGE
        return None


LARGE = 413, f"body: expected at most {MAX_BODY} bytes; send fewer samples at once"
SLOW = 408, f"body: expected all of it within {PATIENCE:g} s; send it again"


async def _body(receive: Any) -> bytes | tuple[int, str]:
    """The whole body, or why it is refused."""
    body = bytearray()
    try:
        async with asyncio.timeout(PATIENCE):
            while True:
                message = await receive()
                body += message.get("body", b"")
                if len(body) > MAX_BODY:
                    return LARGE
                if message["type"] == "http.disconnect" or not message.get("more_body"):
                    return bytes(body)
    except TimeoutError:
        return SLOW


def _again(body: bytes, receive: Any) -> Any:
    """A `receive` that gives the body that was read already."""
    messages = [{"type": "http.request", "body": body, "more_body": False}]

    async def received() -> Any:
        return messages.pop() if messages else await receive()

    return received


def _dressed(send: Any) -> Any:
    """A `send` that adds the headers of all answers."""

    async def sent(message: Any) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sent


def _name(host: str) -> str:
    """The name in a Host header, without its port; "" if it is none."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""
