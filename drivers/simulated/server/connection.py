"""One accepted TCP connection: non-blocking, bounded in both directions."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

SEND_BUFFER = 65536  # bytes the kernel may hold for a client that does not read
MOST_PENDING = 262144  # bytes of replies kept for it here
MOST_INPUT = 1 << 20  # bytes of an unfinished request
CHUNK = 65536
TERMINALS = "/dev/pts"  # pseudo-terminals


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket on `host` only. Raises OSError if the port is taken."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    try:
        listener.bind((host, port))
        listener.listen(16)
    except OSError:
        listener.close()
        raise
    listener.setblocking(False)
    return listener


def is_free(name: Path) -> bool:
    """Return whether a link to a simulated serial line can be put there.

    A link that leads to a pseudo-terminal was left by a simulation that was killed; any other is
    somebody's, as /dev/serial/by-id/... to the real device.
    """
    if name.is_symlink():
        return Path(os.readlink(name)).is_relative_to(TERMINALS)
    return name.parent.is_dir() and not name.exists()


class Connection:
    """A client's socket with its unread requests and unsent replies."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock = sock
        self.received = bytearray()
        self.pending = bytearray()
        self.open = True

    def fileno(self) -> int:
        """Return the descriptor, for select."""
        return self.sock.fileno()

    def read(self) -> bool:
        """Read what has arrived; returns False if the client has closed or sends too much."""
        try:
            data = self.sock.recv(CHUNK)
        except BlockingIOError:
            return self.open
        except OSError:
            data = b""
        self.received += data
        if not data or len(self.received) > MOST_INPUT:
            self.close()
        return self.open

    def lines(self) -> Iterator[str]:
        """Take every complete line that is not blank, until the connection is closed."""
        while self.open and b"\n" in self.received:
            line, _, rest = self.received.partition(b"\n")
            self.received = rest
            if text := line.decode("utf-8", "replace").strip():
                yield text

    def send(self, data: bytes) -> None:
        """Send `data` after everything pending; a client that does not read is closed."""
        self.pending += data
        self.flush()
        if len(self.pending) > MOST_PENDING:
            self.close()

    def flush(self) -> None:
        """Send as much of the pending bytes as the kernel takes."""
        if not self.open or not self.pending:
            return
        try:
            sent = self.sock.send(self.pending)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        del self.pending[:sent]

    def close(self) -> None:
        """Close the socket; does nothing the second time."""
        if self.open:
            self.open = False
            with contextlib.suppress(OSError):
                self.sock.close()
