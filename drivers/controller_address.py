"""What tells one controller from another."""

from __future__ import annotations

import contextlib
import ipaddress

from drivers.driver import DriverSettings


def address_of(link: DriverSettings) -> str:
    """Return what tells one controller from another: the same for whatever driver reaches it."""
    given = link.model_dump(mode="json")
    if "interface" in given:  # a bus, with a whole arm by each profile
        names = ("interface", "host", "port", "channel", "profile")
        return "bus " + " ".join(f"{given.get(k)}" for k in names)
    if given.get("transport") == "rtu":
        return f"serial {given['serial']} unit {given.get('device_id')}"
    host = str(given.get("host", given.get("file", link)))
    with contextlib.suppress(ValueError, OSError):
        host = str(ipaddress.ip_address(host))
    return f"host {host.lower()}"
