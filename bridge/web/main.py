"""The status page's process: ``python -m gapbridge.bridge.web.main``, started by the daemon.

It reads the shared memory through a read-only descriptor, and answers browsers: the page itself,
/status, /events, /history. All of them are read-only: this process cannot reach the robot or arm.
"""

from __future__ import annotations

import asyncio
import hmac
import math
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from gapbridge.bridge.cell.settings.web import WebSettings
from gapbridge.bridge.document.json_text import json_text
from gapbridge.bridge.ipc.side_main import StartData, run_side
from gapbridge.bridge.served.credentials import read_token
from gapbridge.bridge.served.guard import WRONG_TOKEN_DELAY, Guard, cookie_name, cookie_of
from gapbridge.bridge.served.server import serve
from gapbridge.bridge.web.page_data import PageData

WAITING = 100  # messages queued for one page
RETRY = 1000  # ms after which a browser tries again
COMMENT = 5.0  # s without a message after which a comment is sent to keep the stream alive
POLL_EVERY = 0.1  # s between two readings of the shared memory
FILES = {
    "index.html": "text/html", "style.css": "text/css", "page.js": "text/javascript",
    "drawing.js": "text/javascript", "view.js": "text/javascript",
    "messages.js": "text/javascript", "icon.svg": "image/svg+xml",
}  # fmt: skip
MOST_POINTS = 2000
LARGEST_FORM = 4096  # bytes
FORM_TIME = 5.0  # s within which it must arrive


class Stream:
    """Server-sent events: ``publish`` queues a message for every subscriber, never blocks."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._queues: set[asyncio.Queue[str | None]] = set()

    @property
    def full(self) -> bool:
        """Return whether the limit of open pages is reached."""
        return len(self._queues) >= self._most

    @property
    def is_watched(self) -> bool:
        """Return whether any page is open."""
        return bool(self._queues)

    def publish(self, kind: str, data: str) -> None:
        """Send one message (JSON text) to all."""
        text = message(kind, data)
        for queue in list(self._queues):
            try:
                queue.put_nowait(text)
            except asyncio.QueueFull:
                self._queues.discard(queue)
                queue.get_nowait()
                queue.put_nowait(None)  # its end

    def close(self) -> None:
        """End all streams."""
        for queue in list(self._queues):
            self._queues.discard(queue)
            if queue.full():
                queue.get_nowait()
            queue.put_nowait(None)

    async def subscribe(self, first: Callable[[], str]) -> AsyncIterator[str]:
        """Yield the text of ``first()``, then every message, until the stream ends."""
        queue: asyncio.Queue[str | None] = asyncio.Queue(WAITING)
        self._queues.add(queue)
        try:
            yield f"retry: {RETRY}\n{first()}"
            while True:
                try:
                    text = await asyncio.wait_for(queue.get(), COMMENT)
                except TimeoutError:
                    text = ":\n\n"
                if text is None:
                    return
                yield text
        finally:
            self._queues.discard(queue)


def run(start: StartData) -> None:
    """Serve the page until the daemon has ended. Raises LinkError, InputError."""
    settings = start.settings.web
    assert settings is not None
    path = settings.token_file
    token = None if path is None else read_token(path, ("web", "token_file"))
    page = PageData(start.settings, start.n, start.session, start.memory, start.clock, start.extra)
    stream = Stream(settings.clients)

    def update() -> None:
        for kind, data in page.update(start.events.poll()):
            if stream.is_watched:
                stream.publish(kind, _text(data))

    def over() -> bool:
        if start.events.closed:
            stream.close()
        return start.events.closed

    serve(make_app(page, stream, settings, token), settings, "web", over, update, POLL_EVERY)


def make_app(page: PageData, stream: Stream, settings: WebSettings, token: str | None) -> Guard:
    """Return the application with its guard."""

    async def status(request: Request) -> Response:
        return _json(_text(page.snapshot()))

    async def history(request: Request) -> Response:
        query = {}
        for name, default, most in (
            ("seconds", 60.0, 86400.0), ("points", 600.0, float(MOST_POINTS)),
        ):  # fmt: skip
            text = request.query_params.get(name, str(default))
            try:
                value = float(text)
            except ValueError:
                value = math.nan
            if not 1.0 <= value <= most:
                return PlainTextResponse(
                    f"{name}: found {text[:40]!r}, expected 1 to {most:g}\n", 400
                )
            query[name] = value
        return _json(_text(page.history(query["seconds"], int(query["points"]))))

    async def events(request: Request) -> Response:
        if stream.full:
            return PlainTextResponse("too many pages are open\n", 503, {"retry-after": "10"})
        return StreamingResponse(
            _bytes(stream, page), media_type="text/event-stream",
            headers={"x-accel-buffering": "no"},
        )  # fmt: skip

    routes = [
        Route("/status", status), Route("/history", history), Route("/events", events),
        Route("/", _file("index.html")),
        *(Route(f"/{name}", _file(name)) for name in FILES if name != "index.html"),
    ]  # fmt: skip
    sign_in = None if token is None else SignIn(settings, token)
    return Guard(Starlette(routes=routes), settings, token, sign_in)


async def _bytes(stream: Stream, page: PageData) -> AsyncIterator[str]:
    async for text in stream.subscribe(lambda: message("hello", _text(page.snapshot()))):
        yield text


class SignIn:
    """A form that accepts the token once and sets a cookie."""

    def __init__(self, settings: WebSettings, token: str) -> None:
        self._token = token.encode()
        secure = "; Secure" if settings.certificate is not None else ""
        self._cookie = (
            f"{cookie_name(settings)}={cookie_of(self._token)}; Path=/; HttpOnly; "
            f"SameSite=Strict{secure}"
        )
        self._page = _read("sign-in.html")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer with the form, or evaluate it."""
        request = Request(scope, receive)
        response = await self._take(request) if request.method == "POST" else self._form()
        await response(scope, receive, send)

    def _form(self) -> Response:
        headers = {"www-authenticate": 'Bearer realm="gapbridge"'}
        return Response(self._page, 401, headers, media_type="text/html")

    async def _take(self, request: Request) -> Response:
        try:
            async with asyncio.timeout(FORM_TIME):
                token = await self._token_of(request)
        except (ClientDisconnect, TimeoutError, ValueError):
            return PlainTextResponse("found no form with a token\n", 400, {"connection": "close"})
        if not hmac.compare_digest(token.strip().encode(), self._token):
            await asyncio.sleep(WRONG_TOKEN_DELAY)
            return self._form()
        return Response(status_code=303, headers={"location": "/", "set-cookie": self._cookie})

    @staticmethod
    async def _token_of(request: Request) -> str:
        """Return the token in a form. Raises ValueError if the form is too large."""
        body = b""
        async for chunk in request.stream():
            body += chunk
            if len(body) > LARGEST_FORM:
                raise ValueError("too large")
        return parse_qs(body.decode("ascii", "replace"), max_num_fields=4).get("token", [""])[0]


def _file(name: str) -> Callable[[Request], Awaitable[Response]]:
    """Return the handler that answers with one of the page's files."""
    content = _read(name)

    async def answer(request: Request) -> Response:
        return Response(content, media_type=FILES[name])

    return answer


def _read(name: str) -> bytes:
    if name == "view.js":  # as reports have it
        return files("gapbridge.bridge.document").joinpath(name).read_bytes()
    return files("gapbridge.bridge.web").joinpath("page", name).read_bytes()


def _text(data: dict[str, Any]) -> str:
    return json_text(data, (",", ":"))


def _json(text: str) -> Response:
    return Response(text, media_type="application/json")


def message(kind: str, data: str) -> str:
    """Return one server-sent event; ``data`` is JSON, so in one line."""
    return f"event: {kind}\ndata: {data}\n\n"


if __name__ == "__main__":
    sys.exit(run_side("web", run))
