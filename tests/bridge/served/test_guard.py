"""The guard by itself: what a server in front of it might let through all the same."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.responses import PlainTextResponse

from gapbridge.bridge.served import guard as guard_module
from gapbridge.bridge.served.guard import WRONG_TOKEN_DELAY, Guard, cookie_name, cookie_of
from gapbridge.bridge.served.protocol import LARGEST_HEAD
from gapbridge.bridge.served.settings import ServedSettings

TOKEN = "7d1f0c3a9b8e4f62a5d07c1e93b8462f"
HOST = (b"host", b"localhost")


def answer(*headers: tuple[bytes, bytes], token: str | None = None, method: str = "GET") -> int:
    """Return the status that a request for /status with these headers gets."""
    guard = Guard(PlainTextResponse("the page"), ServedSettings(), token)
    scope: dict[str, Any] = {
        "type": "http", "method": method, "path": "/status", "raw_path": b"/status",
        "query_string": b"", "headers": list(headers),
    }  # fmt: skip
    sent: list[Any] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request"}

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(guard(scope, receive, send))
    return int(sent[0]["status"])


@pytest.fixture
def delays(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return how long the guard has waited, each time."""
    waited: list[float] = []

    async def sleep(seconds: float) -> None:
        waited.append(seconds)

    monkeypatch.setattr(guard_module, "asyncio", SimpleNamespace(sleep=sleep))
    return waited


def test_one_name_of_a_host_is_needed_and_no_more_are_taken() -> None:
    assert answer(HOST) == 200
    assert answer() == 421
    assert answer(HOST, HOST) == 421
    assert answer(HOST, (b"host", b"evil.example")) == 421


def test_a_request_has_no_body_and_a_short_head() -> None:
    assert answer(HOST, (b"content-length", b"0")) == 200
    assert answer(HOST, (b"content-length", b"1")) == 413
    assert answer(HOST, (b"transfer-encoding", b"chunked")) == 413
    assert answer(HOST, (b"x", LARGEST_HEAD * b"a")) == 431


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_only_reading_is_possible(method: str) -> None:
    assert answer(HOST, method=method) == 405


@pytest.mark.parametrize(
    "header",
    [
        (b"authorization", b"Bearer " + b"0" * 32), (b"authorization", b"Basic " + TOKEN.encode()),
        (b"cookie", f"{cookie_name(ServedSettings())}={TOKEN}".encode()),
    ],
)  # fmt: skip
def test_a_guess_costs_time(header: tuple[bytes, bytes], delays: list[float]) -> None:
    assert answer(HOST, header, token=TOKEN) == 401
    assert delays == [WRONG_TOKEN_DELAY]


def test_who_shows_nothing_or_the_right_thing_does_not_wait(delays: list[float]) -> None:
    assert answer(HOST, token=TOKEN) == 401
    assert answer(HOST, (b"authorization", b"Bearer " + TOKEN.encode()), token=TOKEN) == 200
    cookie = f"{cookie_name(ServedSettings())}={cookie_of(TOKEN.encode())}".encode()
    assert answer(HOST, (b"cookie", cookie), token=TOKEN) == 200
    assert delays == []


@pytest.mark.parametrize("other", [b'view={"x":1,"y":2}', b"name=two words", b"flag", b"a[0]=1"])
def test_odd_cookies_of_other_servers_of_the_machine_are_passed_over(other: bytes) -> None:
    cookie = f"{cookie_name(ServedSettings())}={cookie_of(TOKEN.encode())}".encode()
    assert answer(HOST, (b"cookie", other + b"; " + cookie), token=TOKEN) == 200
