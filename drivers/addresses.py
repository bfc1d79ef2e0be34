"""Addresses that only this machine reaches."""

from __future__ import annotations

import ipaddress


def is_loopback(host: str) -> bool:
    """Return whether a host is an address of this machine's own loopback, or ``localhost``.

    Addresses are parsed, not compared as text: ``127.0.0.1.evil.example`` is a name, and any name
    but ``localhost`` may resolve differently after the check.
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
