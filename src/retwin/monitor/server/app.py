"""The HTTP interface of the monitor: samples in; assets, alarms, versions, metrics and the page."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Mapping
from dataclasses import asdict
from importlib import resources
from typing import Any, Literal

import fastapi
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException

from retwin._version import __version__
from retwin.checks import at_most
from retwin.errors import InputError
from retwin.monitor.live.explanations import Explanations
from retwin.monitor.live.gate import Gate
from retwin.monitor.live.live import Live
from retwin.monitor.live.machine import Received
from retwin.monitor.server.guard import RequestGuard
from retwin.monitor.server.metrics import Metrics
from retwin.monitor.server.views import JSON, Number, Sequence, Views
from retwin.monitor.store.samples import parse
from retwin.monitor.versions.comparison import Comparisons
from retwin.monitor.versions.registry import Registry
from retwin.report.figures.style import CHROME, PALETTE

PAUSE, HEARTBEAT = 0.25, 15.0
"""Seconds between two events at least, and at most."""
TEXT = "charset=utf-8"
FILES = {
    "/": ("index.html", f"text/html; {TEXT}"),
    "/page.js": ("page.js", f"text/javascript; {TEXT}"),
    "/uplot.js": ("uplot.js", f"text/javascript; {TEXT}"),
    "/uplot.css": ("uplot.css", f"text/css; {TEXT}"),
}
"""The files of the page and their types; the style sheet is made from the report's colours."""


class Acknowledgement(BaseModel):
    """Who has seen an alarm, and what was found."""

    model_config = ConfigDict(extra="forbid")
    who: str = Field("", max_length=200)
    note: str = Field("", max_length=2000)


class Step(BaseModel):
    """Why a version changes its state."""

    model_config = ConfigDict(extra="forbid")
    reason: str = Field("", max_length=2000)


def check_token(token: str | None, *, min_token_length: int = 16) -> str:
    """The token, if it is long enough; another one is an `InputError`.

    Parameters
    ----------
    min_token_length : int, default 16
        Characters of a token at least.

    """
    if not isinstance(token, str) or len(token) < min_token_length or not token.isascii():
        expected = f"at least {min_token_length} ASCII characters"
        remedy = "make one: python -c 'import secrets; print(secrets.token_urlsafe())'"
        raise InputError("token", expected=expected, got="another one", remedy=remedy)
    return token


def create_app(
    live: Live,
    gate: Gate,
    *,
    token: str,
    explanations: Explanations | None = None,
    hosts: Collection[str] = (),
    sources: Mapping[str, Callable[[], bool]] | None = None,
    emulated: bool = False,
) -> RequestGuard:
    """The ASGI application of a live monitor.

    Parameters
    ----------
    live : Live
        The monitor.
    gate : Gate
        Where samples go.
    token : str
        What requests that write must present, at least 16 characters.
    explanations : Explanations, optional
        What explains alarms, for the kinds of faults; by default any change of the machine.
    hosts : collection of str
        Names of this server beside those of the loopback interface.
    sources : mapping of str to callable, optional
        Whether each source of samples is connected, by its name.
    emulated : bool
        Whether the page states that the machines are emulated.

    Raises
    ------
    InputError
        The token is shorter, or a package of the extra is missing.

    """
    check_token(token)
    # The pages of the documentation that FastAPI has would load scripts from elsewhere.
    app = fastapi.FastAPI(
        title="retwin monitor", version=__version__, docs_url=None, redoc_url=None
    )
    _report_errors(app)
    _add_page(app)
    views = Views(live, explanations, emulated=emulated)
    metrics = Metrics(live, sources or {})
    _add_reading(app, live, views, metrics)
    _add_writing(app, live, gate, metrics)
    _add_versions(app, live, views)
    guard = RequestGuard(app, token, hosts)
    app.state.closing = guard.closing
    return guard


def _report_errors(app: fastapi.FastAPI) -> None:
    """Turn errors into one line of JSON."""

    @app.exception_handler(InputError)
    def refused(request: fastapi.Request, error: Exception) -> Any:
        return JSON({"error": str(error)}, 400)

    @app.exception_handler(fastapi.exceptions.RequestValidationError)
    def invalid(request: fastapi.Request, error: Any) -> Any:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        return JSON({"error": f"{where}: {first['msg']}"}, 422)

    @app.exception_handler(HTTPException)
    def unknown(request: fastapi.Request, error: Any) -> Any:
        headers = getattr(error, "headers", None)
        return JSON({"error": error.detail}, error.status_code, headers)


def _add_page(app: fastapi.FastAPI) -> None:
    folder = resources.files(__package__).joinpath("page")

    def add(path: str, content: bytes, kind: str) -> None:
        async def answer() -> Any:
            return fastapi.Response(content, media_type=kind, headers={"cache-control": "no-cache"})

        app.add_api_route(path, answer, methods=["GET", "HEAD"], include_in_schema=False)

    for path, (name, kind) in FILES.items():
        add(path, folder.joinpath(name).read_bytes(), kind)
    colours = {**{f"c{place}": pair for place, pair in enumerate(PALETTE)}, **CHROME}
    light, dark = (
        "".join(f"--{name}: {pair[place]}; " for name, pair in colours.items()) for place in (0, 1)
    )
    style = (
        f":root {{ {light}}}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark}}} }}\n"
        + folder.joinpath("page.css").read_text("utf-8")
    )
    add("/page.css", style.encode(), f"text/css; {TEXT}")


def _add_reading(app: fastapi.FastAPI, live: Live, views: Views, metrics: Metrics) -> None:
    """What anyone may read who reaches the server."""
    listeners: set[object] = set()
    app.get("/assets")(views.assets)
    app.get("/assets/{name:path}")(views.asset)
    app.get("/alarms")(views.alarms)
    app.get("/alarms/{sequence}")(views.alarm)
    app.get("/alarms/{sequence}/samples")(views.around)

    @app.get("/metrics", response_class=fastapi.responses.PlainTextResponse)
    def prometheus() -> Any:
        """Metrics for Prometheus."""
        return fastapi.Response(metrics.text(), media_type="text/plain; version=0.0.4")

    @app.get("/events")
    async def events(request: fastapi.Request) -> Any:
        """Server-sent events: one with the revision whenever something has changed."""
        remedy = "close pages that are not needed"
        # Pages that may listen to events at the same time.
        at_most("events", len(listeners) + 1, 100, "listeners", remedy=remedy)
        return fastapi.responses.StreamingResponse(
            _revisions(live, listeners, request.app.state.closing), media_type="text/event-stream"
        )


async def _revisions(
    live: Live, listeners: set[object], closing: threading.Event
) -> AsyncIterator[str]:
    own, last, sent = object(), None, time.monotonic()
    listeners.add(own)
    try:
        while not closing.is_set():
            now = time.monotonic()
            if live.revision != last:
                last, sent = live.revision, now
                yield f"data: {last}\n\n"
            elif now - sent > HEARTBEAT:
                sent = now
                yield ":\n\n"
            await asyncio.sleep(PAUSE)
    finally:
        listeners.discard(own)


def _add_writing(app: fastapi.FastAPI, live: Live, gate: Gate, metrics: Metrics) -> None:
    """Samples and acknowledgements; the guard has checked the token."""

    @app.post("/samples", openapi_extra=BODY)
    async def samples(request: fastapi.Request) -> Any:
        """Store samples; the counts that are answered are durable.

        With status 503 some were not stored: send all again, since those that were count as
        repeated.
        """
        began, document = time.perf_counter(), await request.body()
        sent = await asyncio.to_thread(
            lambda: [gate.send(each) for each in parse(document, live.channels)]
        )
        made = await asyncio.gather(*map(asyncio.wrap_future, sent), return_exceptions=True)
        done = [each for each in made if isinstance(each, Received)]
        if len(done) < len(made):
            error = next(str(each) for each in made if not isinstance(each, Received))
            return JSON({"error": error}, 503)
        metrics.latency.observe(time.perf_counter() - began)
        return JSON(_counted(done))

    @app.post("/alarms/{sequence}/acknowledge")
    def acknowledge(sequence: Sequence, body: Acknowledgement) -> Any:
        """Record who has seen an alarm."""
        live.acknowledge(sequence, body.who, body.note)
        return JSON({"acknowledged": sequence})


def _counted(done: Iterable[Received]) -> dict[str, Counter[str]]:
    """What became of the samples and trajectories of each machine."""
    made: dict[str, Counter[str]] = {}
    for each in done:
        own = made.setdefault(each.asset, Counter())
        own.update({**vars(each.counts), "alarms": each.alarms})
    return made


BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {"schema": {"type": ["object", "array"]}},
            "application/x-ndjson": {"schema": {"type": "string"}},
        },
    }
}


def _add_versions(app: fastapi.FastAPI, live: Live, views: Views) -> None:
    comparisons = Comparisons(live.store)

    # Before the next one, whose twin may contain slashes.
    @app.get("/versions/{twin:path}/{number}/comparison")
    async def comparison(twin: str, number: Number) -> Any:
        """The version compared with the active one on stored samples, at most a minute old."""
        found = await asyncio.wrap_future(comparisons.of(twin, number))
        made = dict(vars(found))
        test = made.pop("false_alarms")
        made |= asdict(test) | {"promised": test.samples / test.run_length}
        made |= {"p": test.p, "passed": test.passed}
        return JSON(made | {"better": found.better, "summary": found.summary})

    app.get("/versions/{twin:path}")(views.versions)

    @app.post("/versions/{twin:path}/rollback")
    def rollback(twin: str, body: Step) -> Any:
        """Make the version active that was so before."""
        made = Registry(live.store, twin).rollback(body.reason)
        live.refresh()
        return JSON(vars(made))

    @app.post("/versions/{twin:path}/{number}/{step}")
    async def change(
        twin: str, number: Number, step: Literal["promote", "shadow", "reject"], body: Step
    ) -> Any:
        """Change the state of a version; one is promoted that is better than the active one."""
        registry, why = Registry(live.store, twin), list[Any]()
        if step == "promote" and registry.active is not None:
            why.append(await asyncio.wrap_future(comparisons.of(twin, number)))
        elif step == "reject":
            why.append(body.reason)
        made = await asyncio.to_thread(getattr(registry, step), number, *why)
        if step == "promote":
            await asyncio.to_thread(live.refresh)
        return JSON(vars(made))
