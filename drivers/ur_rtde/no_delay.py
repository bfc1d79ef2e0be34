"""Sockets of the ur_rtde library that send at once.

The library leaves Nagle's algorithm on: a setpoint waits, up to 40 ms, until the controller has
acknowledged the one before. It gives no access to its sockets; the system does.
"""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path

DESCRIPTORS = Path("/proc/self/fd")


def send_at_once() -> int:
    """Have every TCP connection of this process send at once; returns how many there are.

    Does nothing where the system does not say which descriptors there are.
    """
    if not DESCRIPTORS.is_dir():
        return 0
    return sum(_send_at_once(int(name)) for name in os.listdir(DESCRIPTORS))


def _send_at_once(descriptor: int) -> bool:
    with contextlib.suppress(OSError):
        if not os.readlink(DESCRIPTORS / str(descriptor)).startswith("socket:"):
            return False
        with socket.socket(fileno=os.dup(descriptor)) as end:  # a copy of the descriptor only
            if end.family not in (socket.AF_INET, socket.AF_INET6):
                return False
            end.getpeername()  # raises for one that only listens
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return True
    return False
