"""python-can's socketcand bus, but the end of the connection is reported.

python-can 4.6's own spins at full load, without an exception, once the server is gone.
"""

from __future__ import annotations

import logging
import socket
import time
from typing import Any

import can
from can.interfaces.socketcand.socketcand import SocketCanDaemonBus

# It warns of every message that arrives in two pieces, which is normal for a stream.
logging.getLogger("can.interfaces.socketcand.socketcand").setLevel(logging.ERROR)


class SocketcandBus(SocketCanDaemonBus):
    """A bus served by socketcand; raises CanOperationError when the server has left."""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        at_once = timeout is None or timeout <= 0.0
        before = 0.0 if at_once else time.monotonic()
        message, filtered = super()._recv_internal(timeout)  # type: ignore[no-untyped-call]
        if message is not None:
            return message, filtered
        early = at_once or timeout is None or time.monotonic() - before < timeout
        if early and self._ended():
            raise can.CanOperationError("the socketcand server has closed the connection")
        return message, filtered

    def _expect_msg(self, msg: str) -> None:
        """Read one answer of the handshake and no more: frames may follow at once."""
        wanted, answer = msg.encode("ascii"), b""
        while len(answer) < len(wanted):
            data = self._link.recv(len(wanted) - len(answer))
            if not data:
                break
            answer += data
        if answer != wanted:
            raise can.CanInitializationError(f"expected {msg!r}, found {answer!r}")

    @property
    def _link(self) -> Any:
        """Return the library's socket; there is no public way to it."""
        return getattr(self, "_SocketCanDaemonBus__socket")  # noqa: B009

    def _ended(self) -> bool:
        try:
            return bool(self._link.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b"")
        except BlockingIOError:
            return False
        except OSError:
            return True
