"""How long a question to an RTDE server and its answer take: what bounds the age of its samples.

RTDE's samples come by themselves, so that nothing in them says how long they were under way. A
connection of its own asks for the protocol version (RTDE guide, RTDE_REQUEST_PROTOCOL_VERSION).
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable

from gapbridge.core.errors import WriteError

PORT = 30004
LONGEST = 1.0  # s that an answer may take
TRIES = 5  # the median counts: a busy moment of ours is none of the way, one lucky answer neither
REQUEST, VERSION = ord("V"), 2
_QUESTION = struct.pack(">HBH", 5, REQUEST, VERSION)
_HEAD = struct.Struct(">HB")


def round_trip(host: str, timeout: float = LONGEST) -> float:
    """Return the median of some questions and answers, s. Raises WriteError where none comes."""
    try:
        with socket.create_connection((host, PORT), timeout) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with link.makefile("rb") as answers:
                return sorted(_ask(link, answers.read) for _ in range(TRIES))[TRIES // 2]
    except (OSError, EOFError) as error:
        message = getattr(error, "strerror", None) or str(error)
        raise WriteError(f"{host}: found no answer on RTDE's port {PORT}: {message}") from None


def _ask(link: socket.socket, read: Callable[[int], bytes]) -> float:
    begun = time.monotonic()
    link.sendall(_QUESTION)
    while True:
        head = read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise EOFError("the connection was closed")
        size, kind = _HEAD.unpack(head)
        read(size - _HEAD.size)
        if kind == REQUEST:
            return time.monotonic() - begun
