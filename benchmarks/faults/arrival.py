"""When bytes arrived at a socket, by the kernel's word, however late they are read.

A proxy in a busy machine reads late; what the client wrote was there all the same.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import time

SO_TIMESTAMPING = 37  # of asm-generic/socket.h
RECEIVED, IN_SOFTWARE = 1 << 3, 1 << 4  # SOF_TIMESTAMPING_RX_SOFTWARE, SOF_TIMESTAMPING_SOFTWARE
TIME = struct.Struct("qq")  # struct timespec: of software, the first of three
TIGHT = 2e-5  # s: two readings of two clocks that lie no farther apart belong together
TRIES = 5


def note_arrivals(end: socket.socket) -> None:
    """Have the kernel note when bytes arrive, where it can."""
    with contextlib.suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, RECEIVED | IN_SOFTWARE)


def receive(end: socket.socket, most: int = 65536) -> tuple[bytes, float]:
    """Return bytes and when the last of them arrived, s monotonic. Raises OSError."""
    data, more, _, _ = end.recvmsg(most, 256)
    now = time.monotonic()
    for level, kind, value in more:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPING and len(value) >= TIME.size:
            seconds, nanoseconds = TIME.unpack_from(value)
            if seconds:
                return data, min(seconds + 1e-9 * nanoseconds + _gap(), now)
    return data, now


def _gap() -> float:
    """Return the monotonic clock minus the wall clock, s."""
    best, found = float("inf"), 0.0
    for _ in range(TRIES):
        before, wall, after = time.monotonic(), time.time(), time.monotonic()
        if after - before < best:
            best, found = after - before, 0.5 * (before + after) - wall
        if best < TIGHT:
            break
    return found
