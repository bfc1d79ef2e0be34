"""The links that the demo supports, by name."""

from __future__ import annotations

from gapbridge.bridge.demo.links.can import CanLink
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.links.modbus import ModbusLink
from gapbridge.bridge.demo.links.ur_rtde import UrRtdeLink
from gapbridge.core.errors import InputError

LINKS: dict[str, type[DemoLink]] = {link.name: link for link in (UrRtdeLink, CanLink, ModbusLink)}


def demo_link(name: str) -> type[DemoLink]:
    """Return the demo's class for a link. Raises InputError for an unknown name."""
    if name not in LINKS:
        raise InputError(f"--link: found {name!r}, expected one of {', '.join(LINKS)}")
    return LINKS[name]


__all__ = ["LINKS", "DemoLink", "demo_link"]
