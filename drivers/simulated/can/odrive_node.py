"""Simulated ODrive axes over CANSimple: identifier = node << 5 | command, little-endian."""

from __future__ import annotations

import math
import struct

from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.peer.peer import Peer

TURN = 2.0 * math.pi
IDLE, CLOSED_LOOP = 1, 8
POSITION_CONTROL, PASSTHROUGH = 3, 1
HEARTBEAT, ESTOP, SET_STATE, ENCODER, SET_MODE, INPUT_POSITION, CLEAR = 1, 2, 7, 9, 0xB, 0xC, 0x18
ENCODER_EVERY, HEARTBEAT_EVERY = 3, 25  # cycles
ESTOP_REQUESTED = 0x2000_0000


class OdriveNodes(CanNodes):
    """One node per joint, from 0."""

    def __init__(self, link: CanSettings, host: str, peer: Peer) -> None:
        super().__init__(link, host, peer)
        self.state = [IDLE] * peer.n
        self.mode = [(0, 0)] * peer.n
        self._target = list(peer.target_q)
        self._count = 0

    def take(self, identifier: int, data: bytes, peer: Peer) -> None:
        """Obey state, mode, position, e-stop and clear."""
        node, command = identifier >> 5, identifier & 0x1F
        if node >= peer.n:
            return
        if command == SET_STATE and len(data) >= 4:
            self._set_state(node, int.from_bytes(data[:4], "little"), peer)
        elif command == SET_MODE and len(data) == 8:
            self.mode[node] = struct.unpack("<II", data)
        elif command == INPUT_POSITION and len(data) == 8:
            self._aim(node, struct.unpack("<f", data[:4])[0], peer)
        elif command == ESTOP:
            peer.emergency_stop()
        elif command == CLEAR:
            peer.release_emergency_stop()
            peer.unlock()

    def _set_state(self, node: int, state: int, peer: Peer) -> None:
        if state == CLOSED_LOOP and self.state[node] != CLOSED_LOOP:
            self._target[node] = peer.target_q[node]
        if state != CLOSED_LOOP:
            peer.let_go()
        self.state[node] = state

    def _aim(self, node: int, turns: float, peer: Peer) -> None:
        if self.state[node] != CLOSED_LOOP or self.mode[node] != (POSITION_CONTROL, PASSTHROUGH):
            return
        self._target[node] = self.joint(node, turns, TURN)
        if all(state == CLOSED_LOOP for state in self.state):
            peer.command(self._target)

    def publish(self, peer: Peer) -> None:
        """Send encoder estimates and, more seldom, heartbeats."""
        if self._count % ENCODER_EVERY == 0:
            self.begin_sample()
            rows = zip(self.wire(TURN), self.speeds(peer, TURN), strict=True)
            for node, (turns, speed) in enumerate(rows):
                self.send(node << 5 | ENCODER, struct.pack("<ff", turns, speed))
        if self._count % HEARTBEAT_EVERY == 0:
            error = 0 if peer.can_move else ESTOP_REQUESTED
            for node, state in enumerate(self.state):
                self.send(node << 5 | HEARTBEAT, struct.pack("<IBxxx", error, state))
        self._count += 1
