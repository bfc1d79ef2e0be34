"""The HTTP server of a side process: its socket, its limits, its end with the daemon."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import sys
from collections.abc import Callable
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from gapbridge.bridge.served.credentials import tls_context
from gapbridge.bridge.served.protocol import (
    HEADER_TIME,
    LARGEST_HEAD,
    MOST_CONNECTIONS,
    GuardedProtocol,
)
from gapbridge.bridge.served.settings import ServedSettings
from gapbridge.core.errors import LinkError

SEND_BUFFER = 64 * 1024  # bytes that the system buffers for a slow client
GONE = 20_000  # ms without an acknowledgement from the client
KEEP_ALIVE = 15  # s


class _Config(uvicorn.Config):
    """The library's configuration with a TLS context of our own."""

    context: ssl.SSLContext | None = None

    def load(self) -> None:
        super().load()
        self.ssl = self.context


class _Loop(asyncio.SelectorEventLoop):
    """An event loop that waits for a TLS handshake as long as for a head, not a minute."""

    handshake_time = HEADER_TIME

    async def create_server(self, *arguments: Any, **keys: Any) -> asyncio.Server:
        if keys.get("ssl") is not None:
            keys["ssl_handshake_timeout"] = self.handshake_time
        return await super().create_server(*arguments, **keys)


def listen(settings: ServedSettings) -> socket.socket:
    """Return the listening socket. Raises LinkError if it cannot be opened."""
    host = "127.0.0.1" if settings.host == "localhost" else settings.host
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    server = socket.socket(family, socket.SOCK_STREAM)
    try:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        if sys.platform.startswith("linux"):
            server.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, GONE)
        server.bind((host, settings.port))
        server.listen(MOST_CONNECTIONS)
    except OSError as error:
        server.close()
        raise LinkError(f"{host}:{settings.port}: cannot be served: {error.strerror}") from None
    return server


def serve(
    app: ASGIApp,
    settings: ServedSettings,
    section: str,
    over: Callable[[], bool],
    update: Callable[[], None],
    every: float,
) -> None:
    """Serve until ``over()``, calling ``update()`` every ``every`` s in the same thread.

    Raises LinkError if the address is taken, InputError if certificates cannot be used.
    """
    context = tls_context(settings, section)
    with listen(settings) as listener:
        config = _Config(
            app, http=GuardedProtocol, ws="none", loop="asyncio", lifespan="off",
            log_config=None, access_log=False, server_header=False, date_header=False,
            proxy_headers=False, limit_concurrency=MOST_CONNECTIONS,
            timeout_keep_alive=KEEP_ALIVE, timeout_graceful_shutdown=1,
            h11_max_incomplete_event_size=LARGEST_HEAD,
        )  # fmt: skip
        config.context = context
        # refused requests are counted, not logged
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
        with asyncio.Runner(loop_factory=_Loop) as runner:
            runner.run(_serve(uvicorn.Server(config), listener, over, update, every))


async def _serve(
    server: uvicorn.Server,
    listener: socket.socket,
    over: Callable[[], bool],
    update: Callable[[], None],
    every: float,
) -> None:
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    try:
        while not serving.done():
            update()
            if over():
                server.should_exit = True
                break
            await asyncio.sleep(every)
    finally:
        server.should_exit = True
    await serving
