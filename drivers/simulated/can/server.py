"""The simulated arm of a CAN profile."""

from __future__ import annotations

from pkgutil import resolve_name

from gapbridge.core.errors import InputError
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.simulated.server.arm_controller import ArmController
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer

NODES: dict[str, str] = {
    "piper": "gapbridge.drivers.simulated.can.piper_node:PiperNode",
    "openarm": "gapbridge.drivers.simulated.can.mit_node:MitNodes",
    "odrive": "gapbridge.drivers.simulated.can.odrive_node:OdriveNodes",
}
"""Shipped profile -> ``module:Class`` of its nodes; any other profile: nodes from its map."""
MAPPED = "gapbridge.drivers.simulated.can.mapped_node:MappedNodes"


def make_servers(link: CanSettings, host: str, controller: ArmController) -> list[ProtocolServer]:
    """Return the nodes of an arm, not yet on a bus. Raises InputError if they do not fit."""
    nodes = resolve_name(NODES.get(link.profile, MAPPED))
    if link.profile == "piper" and controller.n != 6:
        raise InputError(
            f"found 6 joints in piper, expected {controller.n}: the cell's arm has those",
            ("link", "profile"),
        )
    server: ProtocolServer = nodes(link, host, controller)
    return [server]
