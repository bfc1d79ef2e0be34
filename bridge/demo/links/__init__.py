"""The links that the demo can show: name -> what differs on it."""

from __future__ import annotations

from gapbridge.bridge.demo.links.can import CanLink
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.links.modbus import ModbusLink
from gapbridge.bridge.demo.links.ur_rtde import UrRtdeLink
from gapbridge.core.errors import InputError

LINKS: dict[str, type[DemoLink]] = {link.name: link for link in (UrRtdeLink, CanLink, ModbusLink)}


def demo_link(name: str) -> type[DemoLink]:
    """Return what the demo does on a link. Raises InputError for one that it does not know."""
    if name not in LINKS:
        raise InputError(f"--link: found {name!r}, expected one of {', '.join(LINKS)}")
    return LINKS[name]


__all__ = ["LINKS", "DemoLink", "demo_link"]
