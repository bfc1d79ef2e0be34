"""The daemon's local socket: status, arm, disarm. Only its owner, and root, can open it.

One line of JSON in, ``{"command": "arm"}``, one out, ``{"ok": true, "answer": ...}``. Only this
socket and the cell file can arm.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

LONGEST_REQUEST = 4096  # bytes
REQUEST_TIMEOUT = 5.0  # s until a request must arrive
MAX_CONNECTIONS = 8
COMMANDS = ("status", "arm", "disarm")
_CREDENTIALS = struct.Struct("3i")


@dataclass(frozen=True)
class Peer:
    """The process at the other end, as the kernel reports it."""

    pid: int
    uid: int


Answer = Callable[[str, Peer], dict[str, Any]]


class ControlSocket:
    """Serves a unix socket in threads of its own; ``answer`` is called in them."""

    def __init__(self, path: Path, answer: Answer) -> None:
        self.path = path
        self._answer = answer
        self._listener: socket.socket | None = None
        self._slots = threading.BoundedSemaphore(MAX_CONNECTIONS)

    def open(self) -> None:
        """Listen; replaces the socket of a killed daemon. The caller holds the cell's lock.

        Raises OSError.
        """
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISSOCK(self.path.lstat().st_mode):
                self.path.unlink()
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listener.bind(str(self.path))
            self.path.chmod(0o600)  # its folder is 0700: no other user could connect before
            listener.listen(MAX_CONNECTIONS)
        except OSError:
            listener.close()
            raise
        self._listener = listener
        threading.Thread(target=self._serve, args=(listener,), daemon=True).start()

    def close(self) -> None:
        """Stop listening and remove the socket; may be repeated."""
        listener, self._listener = self._listener, None
        if listener is not None:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
            with contextlib.suppress(OSError):
                self.path.unlink()

    def _serve(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            if not self._slots.acquire(blocking=False):
                connection.close()
                continue
            try:
                threading.Thread(target=self._handle, args=(connection,), daemon=True).start()
            except RuntimeError:  # no thread can be started: the client sees the connection end
                connection.close()
                self._slots.release()

    def _handle(self, connection: socket.socket) -> None:
        try:
            with connection, contextlib.suppress(OSError):
                connection.settimeout(REQUEST_TIMEOUT)
                reply = self._reply(connection)
                connection.sendall(json.dumps(reply).encode() + b"\n")
        finally:
            self._slots.release()

    def _reply(self, connection: socket.socket) -> dict[str, Any]:
        line = _read_line(connection)  # first: a client refused while it writes loses the answer
        peer = peer_of(connection)
        if peer.uid not in (0, os.geteuid()):
            return refusal(f"found user {peer.uid}, expected the daemon's own ({os.geteuid()})")
        try:
            request = json.loads(line)
            command = request["command"]
        except (ValueError, TypeError, KeyError):
            return refusal('found no request, expected {"command": ...} as one line of JSON')
        if command not in COMMANDS:
            return refusal(f"found command {str(command)[:40]!r}, expected {', '.join(COMMANDS)}")
        return self._answer(command, peer)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def refusal(message: str) -> dict[str, Any]:
    """Return the answer that refuses a request."""
    return {"ok": False, "error": message}


def peer_of(connection: socket.socket) -> Peer:
    """Return the process that opened a unix connection."""
    option = getattr(socket, "SO_PEERCRED", None)
    if option is None:  # not Linux: only the modes of folder and socket protect
        return Peer(0, os.geteuid())
    credentials = connection.getsockopt(socket.SOL_SOCKET, option, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(credentials)
    return Peer(pid, uid)


def _read_line(connection: socket.socket) -> bytes:
    data = b""
    while b"\n" not in data and len(data) < LONGEST_REQUEST:
        piece = connection.recv(LONGEST_REQUEST)
        if not piece:
            break
        data += piece
    return data[:LONGEST_REQUEST].split(b"\n")[0]
