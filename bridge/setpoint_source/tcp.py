"""Setpoints from a planner over TCP on loopback, behind a token; lines as in planner.py.

The first line is ``token TOKEN``. Anything else ends the connection, also an HTTP request, which
any web page can make a browser send here.
"""

from __future__ import annotations

import hmac
import ipaddress
import socket

from gapbridge.bridge.served.credentials import SETPOINT_TOKEN, read_token
from gapbridge.bridge.setpoint_source.planner import Connection, PlannerSource
from gapbridge.core.errors import InputError

FIRST_LINE = 2.0  # s within which the token must arrive


class TcpSource(PlannerSource):
    """Listens for one planner at a time; refuses connections without the token."""

    needs_token = True
    _token = b""

    @property
    def port(self) -> int:
        """Return the port it listens on."""
        return int(self._listener.getsockname()[1]) if self._listener is not None else 0

    @property
    def where(self) -> str:
        """Return the address that it listens on, for messages."""
        return f"{self.settings.host}:{self.settings.port}"

    def open(self) -> None:
        """Listen. Raises RunError where the address is taken, InputError without a token."""
        path = self.settings.token_file
        if path is None:
            raise InputError("found nothing, expected a file with a token", SETPOINT_TOKEN)
        self._token = read_token(path, SETPOINT_TOKEN).encode()
        super().open()

    def _listen(self) -> socket.socket:
        # the name is not resolved: its address may change
        host = "127.0.0.1" if self.settings.host == "localhost" else self.settings.host
        v6 = ipaddress.ip_address(host).version == 6
        listener = socket.socket(socket.AF_INET6 if v6 else socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, self.settings.port))
        except OSError:
            listener.close()
            raise
        return listener

    def _may_connect(self, link: socket.socket) -> bool:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return True

    def _admit(self, connection: Connection, line: bytes) -> bool:
        word, _, token = line.partition(b" ")
        if word == b"token" and hmac.compare_digest(token.strip(), self._token):
            connection.admit()
        else:
            self._end(connection, "expected the token in the first line: token TOKEN")
        return True

    def _receive(self) -> bool:
        late = self._clock.monotonic() - FIRST_LINE
        for connection in self._waiting:
            if not connection.admitted and not connection.closed and connection.opened < late:
                self._end(connection, f"no token within {FIRST_LINE:g} s")
        return super()._receive()

    def _remove_socket(self) -> None:
        """Do nothing: a port leaves no file."""
