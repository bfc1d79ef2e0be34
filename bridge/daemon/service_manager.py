"""Notifications to systemd: ready, alive, reloading, stopping (sd_notify, no library).

Source: sd_notify(3): datagrams of KEY=VALUE lines to the socket named in NOTIFY_SOCKET.
"""

from __future__ import annotations

import contextlib
import os
import socket

from gapbridge.drivers.clock import Clock


class ServiceManager:
    """Speaks to the service manager where there is one; silent where there is none."""

    def __init__(self, clock: Clock) -> None:
        self._now = clock.monotonic
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):
            self._address = "\0" + self._address[1:]
        wanted = os.environ.get("WATCHDOG_USEC", "0")
        for_this_process = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        period = int(wanted) / 1e6 if wanted.isdigit() and for_this_process else 0.0
        self._every = period / 3.0  # s between two signs of life; 0: none wanted
        self._kicked = 0.0

    @property
    def present(self) -> bool:
        """Return whether a service manager has started this process."""
        return bool(self._address)

    def ready(self) -> None:
        """Report that the run has begun."""
        self._send("READY=1")

    def reloading(self) -> None:
        """Report that a changed cell file is being taken; ``ready`` follows."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={int(1e6 * self._now())}")

    def stopping(self) -> None:
        """Report that the run ends."""
        self._send("STOPPING=1")

    def kick(self) -> None:
        """Give a sign of life, where one is due; only to be called when there was progress."""
        now = self._now()
        if self._every and now - self._kicked >= self._every:
            self._kicked = now
            self._send("WATCHDOG=1")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link,
        ):
            link.setblocking(False)
            link.sendto(text.encode(), self._address)
