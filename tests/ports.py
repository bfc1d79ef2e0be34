"""Addresses and ports that are nobody else's: two checkouts side by side do not meet."""

from __future__ import annotations

import contextlib
import itertools
import os
import secrets
import socket

_hosts = itertools.count(1)


def own_host() -> str:
    """Return a loopback address of this process alone."""
    pid = os.getpid()
    return f"127.{1 + (pid >> 8) % 250}.{pid % 256}.{next(_hosts) % 250 + 1}"


def free_port(host: str = "127.0.0.1") -> int:
    """Return a TCP port that nobody listens on at ``host``.

    Below those that the system gives to connections: until it is listened on, one of them may
    take a port of the system's choice.
    """
    while True:
        port = secrets.choice(range(10240, 32768))
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind((host, port))
            return port
