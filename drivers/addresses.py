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


def host_name(host: str) -> str:
    """Return an address or host name. Raises ValueError for text that sockets cannot look up.

    They encode names, which fails for an empty or long label (``192.168.0..10``) with an error that
    is no OSError.
    """
    expected = "expected an IP address or host name"
    if host.split() != [host]:
        raise ValueError(expected)
    try:
        host.encode("idna")
    except UnicodeError:
        raise ValueError(f"{expected}, its labels of 1 to 63 characters") from None
    return host


def plain_host(host: str) -> str:
    """Return an IPv4 address or host name. Raises ValueError for others, and for a port in it."""
    if ":" in host or host.split() != [host]:
        raise ValueError("expected an IPv4 address or host name without a port")
    return host_name(host)
