"""Which simulated arm stands behind a CAN profile."""

from __future__ import annotations

import importlib

from gapbridge.core.errors import InputError
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.simulated.peer.peer import Peer
from gapbridge.drivers.simulated.peer.peer_server import PeerServer

NODES: dict[str, str] = {
    "piper": "gapbridge.drivers.simulated.can.piper_node:PiperNode",
    "openarm": "gapbridge.drivers.simulated.can.mit_node:MitNodes",
    "odrive": "gapbridge.drivers.simulated.can.odrive_node:OdriveNodes",
}
"""Shipped profile -> ``module:Class`` of its nodes; any other profile: nodes out of its map."""
MAPPED = "gapbridge.drivers.simulated.can.mapped_node:MappedNodes"


def make_servers(link: CanSettings, host: str, peer: Peer) -> list[PeerServer]:
    """Return the nodes of an arm, not yet on a bus. Raises InputError where they do not fit."""
    module, name = NODES.get(link.profile, MAPPED).split(":")
    nodes = getattr(importlib.import_module(module), name)
    if link.profile == "piper" and peer.n != 6:
        raise InputError(f"link.profile: found piper, 6 joints, the cell's arm has {peer.n}")
    found: PeerServer = nodes(link, host, peer)
    return [found]
