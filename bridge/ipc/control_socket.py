"""The daemon's local socket: status, arm, disarm. Only its owner, and root, can open it.

One line of JSON in, ``{"command": "arm"}``, one out, ``{"ok": true, "answer": ...}``. Only this
socket and the cell file can arm.
"""

from __future__ import annotations

import contextlib
import errno
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

from gapbridge.drivers.clock import Clock

LONGEST_REQUEST = 4096  # bytes
REQUEST_TIMEOUT = 5.0  # s until a request must arrive
MAX_REQUESTS = 8  # answered at once, and as many disarms beside them
MAX_UNREAD = 32  # connections whose request has not come yet; the oldest gives way
RETRY = 0.05  # s after a connection that could not be accepted: descriptors or memory ran out
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

    def __init__(self, path: Path, answer: Answer, clock: Clock) -> None:
        self.path = path
        self._answer, self._clock = answer, clock
        self._listener: socket.socket | None = None
        self._closed = threading.Event()
        self._slots = threading.BoundedSemaphore(MAX_REQUESTS)
        self._disarm_slots = threading.BoundedSemaphore(MAX_REQUESTS)
        self._lock = threading.Lock()
        self._unread: list[socket.socket] = []

    def open(self) -> None:
        """Listen; replaces the socket of a killed daemon. Raises OSError, for a running one's."""
        remove_unused(self.path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listener.bind(str(self.path))
            self.path.chmod(0o600)  # its folder is 0700: no other user could connect before
            listener.listen(MAX_UNREAD)
        except OSError:
            listener.close()
            raise
        self._listener = listener
        self._closed.clear()
        threading.Thread(target=self._serve, args=(listener,), daemon=True).start()

    def close(self) -> None:
        """Stop listening and remove the socket; may be repeated."""
        listener, self._listener = self._listener, None
        self._closed.set()
        if listener is not None:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
            with contextlib.suppress(OSError):
                self.path.unlink()

    def _serve(self, listener: socket.socket) -> None:
        while self._listener is listener:
            try:
                connection, _ = listener.accept()
            except OSError:  # without this socket nobody can disarm: only close() ends it
                self._clock.wait(self._closed, RETRY)
                continue
            self._await_request(connection)
            try:
                threading.Thread(target=self._handle, args=(connection,), daemon=True).start()
            except (RuntimeError, MemoryError):
                self._request_read(connection)
                connection.close()

    def _await_request(self, connection: socket.socket) -> None:
        """Note that its request has not come; clients that hold connections keep none out."""
        with self._lock:
            self._unread.append(connection)
            if len(self._unread) > MAX_UNREAD:
                with contextlib.suppress(OSError):
                    self._unread.pop(0).shutdown(socket.SHUT_RDWR)  # its thread closes it

    def _request_read(self, connection: socket.socket) -> None:
        with self._lock, contextlib.suppress(ValueError):
            self._unread.remove(connection)

    def _handle(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.settimeout(REQUEST_TIMEOUT)
            try:  # first: a client refused while it writes loses the answer
                line = _read_line(connection)
            finally:
                self._request_read(connection)
            reply = self._reply(connection, line)
            connection.sendall(json.dumps(reply).encode() + b"\n")

    def _reply(self, connection: socket.socket, line: bytes) -> dict[str, Any]:
        peer = peer_of(connection)
        if peer.uid not in (0, os.geteuid()):
            return refusal(f"found user {peer.uid}, expected the daemon's own ({os.geteuid()})")
        try:
            request = json.loads(line)
            command = request["command"]
        except (ValueError, TypeError, KeyError, RecursionError):
            command = None
        if not isinstance(command, str):  # nor is it shown: a nested one may be too deep for that
            return refusal('found no request, expected {"command": ...} as one line of JSON')
        if command not in COMMANDS:
            return refusal(f"found command {command[:40]!r}, expected {', '.join(COMMANDS)}")
        slots = self._disarm_slots if command == "disarm" else self._slots
        if not slots.acquire(blocking=False):
            return refusal(f"found {MAX_REQUESTS} requests that are not answered yet, try again")
        try:
            return self._answer(command, peer)
        finally:
            slots.release()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def remove_unused(path: Path) -> None:
    """Remove the socket that a killed process has left at ``path``.

    Raises OSError where a process still listens there: it could not be reached any more, and what
    is sent to it would move or stop another arm.
    """
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISSOCK(path.lstat().st_mode):
            return  # nobody can listen there, as is reported then
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.setblocking(False)
            found = probe.connect_ex(str(path))
        if found == errno.ECONNREFUSED:
            path.unlink()
        elif found != errno.ENOENT:
            raise OSError(errno.EADDRINUSE, "another process listens there")


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
