"""Clients that stop reading: cut off, and nobody else waits for them."""

import asyncio
import contextlib
import socket
import ssl
import threading
import time

import httpx
import pytest
from patience import PATIENCE, wait_for
from ports import free_port
from starlette.responses import PlainTextResponse
from watched_feed import self_signed

from gapbridge.bridge.served import server
from gapbridge.bridge.served.protocol import GuardedProtocol
from gapbridge.bridge.served.server import listen, serve
from gapbridge.bridge.served.settings import ServedSettings
from gapbridge.bridge.web.main import WAITING, Stream
from gapbridge.core.errors import LinkError


@pytest.fixture
def flood(monkeypatch):
    """Serve an endless answer, with little patience."""
    monkeypatch.setattr(GuardedProtocol, "stall_time", 0.5)
    port = free_port()
    sent = {"ended": 0}

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})
        if scope["path"] == "/":
            await send({"type": "http.response.body", "body": b"fine"})
            return
        try:
            while not (await _disconnected(receive)):
                await send({"type": "http.response.body", "body": 65536 * b"x", "more_body": True})
        finally:
            sent["ended"] += 1

    over = threading.Event()
    settings = ServedSettings(port=port)
    thread = threading.Thread(
        target=serve, args=(app, settings, "web", over.is_set, lambda: None, 0.05)
    )
    thread.start()
    until = time.monotonic() + PATIENCE
    while True:
        try:
            httpx.get(settings.url)
            break
        except httpx.TransportError:
            assert time.monotonic() < until
            time.sleep(0.05)
    yield settings, sent
    over.set()
    thread.join(PATIENCE)
    assert not thread.is_alive()


async def _disconnected(receive):
    try:
        message = await asyncio.wait_for(receive(), 0.001)
    except TimeoutError:
        return False
    return message["type"] == "http.disconnect"


def test_a_client_that_takes_nothing_is_cut_off_while_others_are_served(flood):
    settings, sent = flood
    with socket.create_connection(("127.0.0.1", settings.port), timeout=PATIENCE) as link:
        link.sendall(b"GET /flood HTTP/1.1\r\nHost: localhost\r\n\r\n")
        begun = time.monotonic()
        while not sent["ended"]:
            assert httpx.get(settings.url).text == "fine"
            assert time.monotonic() - begun < 20
            time.sleep(0.05)
        assert time.monotonic() - begun > 0.4
        taken = _rest(link)
    assert taken < 50e6  # what lay in buffers, and no more comes


def _rest(link):
    """Return how many bytes come before the other side's end or reset."""
    taken = 0
    with contextlib.suppress(OSError):
        while piece := link.recv(1 << 20):
            taken += len(piece)
    return taken


def test_a_tls_handshake_that_does_not_come_is_cut_off(tmp_path, monkeypatch):
    monkeypatch.setattr(server._Loop, "handshake_time", 2.0)  # the second must come through
    certificate, key = self_signed(tmp_path)
    settings = ServedSettings(port=free_port(), certificate=certificate, key=key)
    over = threading.Event()
    app = PlainTextResponse("fine")
    thread = threading.Thread(
        target=serve, args=(app, settings, "web", over.is_set, lambda: None, 0.05)
    )
    thread.start()
    links = []

    def connected():
        with contextlib.suppress(ConnectionRefusedError):
            links.append(socket.create_connection(("127.0.0.1", settings.port), timeout=PATIENCE))
        return links

    try:
        wait_for(connected, "the server")
        with links[0] as link:
            assert link.recv(1) == b""
        context = ssl.create_default_context(cafile=str(certificate))
        assert httpx.get(settings.url, verify=context).text == "fine"
    finally:
        over.set()
        thread.join(PATIENCE)


def test_an_address_that_is_taken_is_reported_in_one_line():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        s.listen()
        port = s.getsockname()[1]
        with pytest.raises(LinkError, match=rf"127.0.0.1:{port}: cannot be served: Address"):
            listen(ServedSettings(port=port))


def test_a_page_that_does_not_keep_up_is_closed_and_the_others_miss_nothing():
    async def both():
        stream = Stream(most=4)
        slow, quick = stream.subscribe(lambda: "first"), stream.subscribe(lambda: "first")
        assert (await anext(slow)).endswith("first")
        assert (await anext(quick)).endswith("first")
        got = 0
        for i in range(WAITING + 20):
            stream.publish("tick", str(i))
            assert f"data: {i}\n" in await anext(quick)
            got += 1
        assert got == WAITING + 20
        left = [text async for text in slow]
        assert len(left) == WAITING - 1
        assert not stream.full
        stream.close()
        with pytest.raises(StopAsyncIteration):
            await anext(quick)

    asyncio.run(both())
