"""Addresses and ports that are this process's alone: two checkouts side by side do not meet.

What is reserved is held by a bound UDP socket: the system grants each to one process, and takes it
back when that ends. Nothing here is served over UDP, so that the TCP port beside it stays free.
"""

from __future__ import annotations

import contextlib
import secrets
import socket

_held: list[socket.socket] = []
_hosts: list[str] = []  # reserved, not given away yet
RESERVED_BY = 10239  # port at the first address of a network


def own_host() -> str:
    """Return a loopback address of this process alone, for servers whose ports are fixed."""
    while True:
        with contextlib.suppress(IndexError):
            return _hosts.pop()
        network = f"127.{100 + secrets.randbelow(100)}.{secrets.randbelow(256)}"
        with contextlib.suppress(OSError):  # another process has it
            _hold(f"{network}.1", RESERVED_BY)
            _hosts.extend(f"{network}.{last}" for last in range(254, 1, -1))


def free_port(host: str = "127.0.0.1") -> int:
    """Return a TCP port at ``host`` of this process alone, where one must be known beforehand.

    Below those that the system gives to connections: until it is listened on, one of them could
    take a port of the system's choice.
    """
    while True:
        port = secrets.choice(range(RESERVED_BY + 1, 32768))
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind((host, port))
            _hold(host, port)
            return port


def _hold(host: str, port: int) -> None:
    """Hold an address until this process ends. Raises OSError where another one does."""
    with contextlib.ExitStack() as closing:
        holder = closing.enter_context(socket.socket(type=socket.SOCK_DGRAM))
        holder.bind((host, port))
        _held.append(holder)
        closing.pop_all()
