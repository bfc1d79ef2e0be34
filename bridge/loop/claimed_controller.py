"""One loop per controller: a name that a loop's process holds until it ends, however that is."""

from __future__ import annotations

import errno
import hashlib
import socket
from collections.abc import Callable
from typing import Any

from gapbridge.bridge.ipc.events import EventKind
from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import Clock

LONGEST_WAIT = 60.0  # s
RETRY = 0.05  # s


def claimed_controller(
    address: str, emit: Callable[[dict[str, Any]], None], clock: Clock
) -> socket.socket:
    """Return the socket whose name says that this process is the controller's loop (Linux).

    The loop of a daemon that was killed withdraws its offset before it ends, at the cell's rate,
    while the daemon's own lock is free already: that loop is waited for. Raises LinkError where
    it goes on for longer than LONGEST_WAIT.
    """
    name = f"\0gapbridge-loop-{hashlib.sha256(address.encode()).hexdigest()[:16]}"
    claimed = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    begun, waits = clock.monotonic(), False
    while not _bound(claimed, name):
        held = f"{address} is still held by the loop of a daemon that was killed"
        if clock.monotonic() - begun > LONGEST_WAIT:
            claimed.close()
            raise LinkError(f"link: {held}, expected its end within {LONGEST_WAIT:g} s")
        if not waits:
            emit({"kind": EventKind.NOTE, "detail": f"{held}: waiting until it has ramped out"})
            waits = True
        clock.sleep(RETRY)
    return claimed


def _bound(claimed: socket.socket, name: str) -> bool:
    """Bind a socket; returns whether nobody else has the name. Raises OSError."""
    try:
        claimed.bind(name)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise
        return False
    return True
