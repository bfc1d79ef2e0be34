"""The identity of a controller: its address."""

from __future__ import annotations

import contextlib
import functools
import ipaddress
import os
import socket

from gapbridge.drivers.link_settings import DriverSettings

OWN_PORTS = (502, 802, 30004)  # Modbus/TCP, Modbus/TCP Security, RTDE


def address_of(link: DriverSettings) -> str:
    """Return the identity of a controller, the same for every driver that reaches it.

    A host name is resolved, once for the whole run. A protocol's default port is omitted: RTDE and
    Modbus of one robot are one controller, other ports of a gateway are not.
    """
    settings = link.model_dump(mode="json")
    if "interface" in settings:  # a bus, with one arm per profile
        host = settings.get("host")
        bus = {**settings, "host": None if host is None else resolved(str(host))}
        names = ("interface", "host", "port", "channel", "profile")
        return "bus " + " ".join(f"{bus.get(k)}" for k in names)
    if settings.get("transport") == "rtu":
        return f"serial {_real(settings['serial'])} unit {settings.get('device_id')}"
    if "host" not in settings:
        return f"host {settings.get('file', link)}"
    port = settings.get("port")
    port_text = f" port {port}" if port is not None and port not in OWN_PORTS else ""
    return f"host {resolved(str(settings['host']))}{port_text}"


@functools.cache
def resolved(host: str) -> str:
    """Return the numeric address of a host name, the first in order where it has several.

    A name that cannot be resolved is returned in lower case: connecting will fail.
    """
    with contextlib.suppress(ValueError):
        return str(ipaddress.ip_address(host))
    try:
        addresses = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return host.lower().rstrip(".")
    return min(str(address[0]) for *_, address in addresses)


def _real(path: str) -> str:
    """Return a serial port with symbolic links resolved."""
    return os.path.realpath(path)
