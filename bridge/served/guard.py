"""The check of every request before it is answered: host name, method, size and token."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gapbridge.bridge.served.protocol import LARGEST_HEAD
from gapbridge.bridge.served.settings import ServedSettings

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
    "cache-control": "no-store",
}
SIGN_IN = "/session"
WRONG_TOKEN_DELAY = 0.5  # s


class Guard:
    """ASGI middleware that passes only authorised, read-only requests without a body.

    Host: an address, localhost or one of ``settings.names``, against DNS rebinding. Token, if there
    is one: as ``Authorization: Bearer``, or as the cookie set by signing in.
    """

    def __init__(
        self,
        app: ASGIApp,
        settings: ServedSettings,
        token: str | None,
        sign_in: ASGIApp | None = None,
    ) -> None:
        self._app, self._settings, self._sign_in = app, settings, sign_in
        self._token = None if token is None else token.encode()
        self._pass = None if self._token is None else cookie_of(self._token).encode()
        self.refused: dict[str, int] = {}  # by reason

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it to the application."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # closes the connection

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(raw=message["headers"])
                for name, value in HEADERS.items():
                    headers[name] = value
                if self._settings.certificate is not None:
                    headers["strict-transport-security"] = "max-age=31536000"
            await send(message)

        refusal = await self._refusal(scope)
        app = self._app if refusal is None else refusal
        await app(scope, receive, guarded)

    async def _refusal(self, scope: Scope) -> ASGIApp | None:
        """Return the application that refuses a request; None: it may pass."""
        headers = Headers(scope=scope)
        # the library limits only heads that arrive in pieces
        size = len(scope["raw_path"]) + len(scope["query_string"])
        if size + sum(len(k) + len(v) + 4 for k, v in scope["headers"]) > LARGEST_HEAD:
            return self._refuse("size", 431, "the request is too large", connection="close")
        if not self._host_is_known(headers):
            return self._refuse("host", 421, "this server is not known by that name")
        signs_in = scope["path"] == SIGN_IN and scope["method"] == "POST" and self._sign_in
        if signs_in and self._token is not None:
            return self._sign_in
        if scope["method"] not in ("GET", "HEAD"):
            return self._refuse("method", 405, "only reading is possible here", allow="GET, HEAD")
        if headers.get("transfer-encoding") or headers.get("content-length", "0") != "0":
            return self._refuse("body", 413, "a request has no body here", connection="close")
        if self._token is None or self._is_known(headers):
            return None
        if headers.get("authorization") or headers.get("cookie"):
            await asyncio.sleep(WRONG_TOKEN_DELAY)
        self._count("token")
        if scope["path"] == "/" and self._sign_in is not None:
            return self._sign_in
        return PlainTextResponse(
            "a token is needed\n", 401, {"www-authenticate": 'Bearer realm="gapbridge"'}
        )

    def _host_is_known(self, headers: Headers) -> bool:
        hosts = headers.getlist("host")
        if len(hosts) != 1:
            return False
        name = hosts[0].lower()
        if name.startswith("["):
            name = name[1:].partition("]")[0]
        elif name.count(":") == 1:
            name = name.partition(":")[0]
        name = name.rstrip(".")
        if name == "localhost" or name in self._settings.names:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def _is_known(self, headers: Headers) -> bool:
        assert self._token is not None and self._pass is not None
        scheme, _, token = headers.get("authorization", "").partition(" ")
        bearer = token.strip() if scheme.lower() == "bearer" else ""
        # the standard library's parser stops at an odd cookie of another server of this machine
        cookies = cookie_parser(headers.get("cookie", ""))
        shown = cookies.get(cookie_name(self._settings), "")
        # both are compared always, in constant time
        right = hmac.compare_digest(bearer.encode(), self._token)
        return hmac.compare_digest(shown.encode(), self._pass) or right

    def _refuse(self, reason: str, status: int, text: str, **headers: str) -> Response:
        self._count(reason)
        return PlainTextResponse(text + "\n", status, headers)

    def _count(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1


def cookie_name(settings: ServedSettings) -> str:
    """Return the cookie's name, with the port: browsers share cookies between ports."""
    return f"gapbridge-{settings.port}"


def cookie_of(token: bytes) -> str:
    """Return the cookie's value for a token; the same after a restart."""
    return hmac.new(token, b"gapbridge session", hashlib.sha256).hexdigest()
