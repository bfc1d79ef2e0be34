"""Simulated ODrive axes over CANSimple: identifier = node << 5 | command, little-endian."""

from __future__ import annotations

import math
import struct

from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.server.arm_controller import ArmController

TURN = 2.0 * math.pi
IDLE, CLOSED_LOOP = 1, 8
POSITION_CONTROL, PASSTHROUGH = 3, 1
HEARTBEAT, ESTOP, SET_STATE, ENCODER, SET_MODE, INPUT_POSITION, CLEAR = 1, 2, 7, 9, 0xB, 0xC, 0x18
ENCODER_PERIOD = 0.010  # s
HEARTBEAT_EVERY = 25  # cycles
ESTOP_REQUESTED = 0x2000_0000


class OdriveNodes(CanNodes):
    """One node per joint, from 0."""

    def __init__(self, link: CanSettings, host: str, controller: ArmController) -> None:
        super().__init__(link, host, controller)
        self.state = [IDLE] * controller.n
        self.mode = [(0, 0)] * controller.n
        self._target = list(controller.target_q)
        self._count = 0
        self._due = 0.0  # s, monotonic: when the next encoder estimate is sent

    def open(self, controller: ArmController, clock: Clock) -> None:
        """Serve or join the bus; see CanNodes.open."""
        self._now = clock.monotonic
        super().open(controller, clock)

    def take(self, identifier: int, data: bytes, controller: ArmController) -> None:
        """Execute state, mode, position, e-stop and clear."""
        node, command = identifier >> 5, identifier & 0x1F
        if node >= controller.n:
            return
        if command == SET_STATE and len(data) >= 4:
            self._set_state(node, int.from_bytes(data[:4], "little"), controller)
        elif command == SET_MODE and len(data) == 8:
            self.mode[node] = struct.unpack("<II", data)
        elif command == INPUT_POSITION and len(data) == 8:
            self._set_target(node, struct.unpack("<f", data[:4])[0], controller)
        elif command == ESTOP:
            controller.emergency_stop()
        elif command == CLEAR:
            controller.release_emergency_stop()
            controller.unlock()

    def _set_state(self, node: int, state: int, controller: ArmController) -> None:
        if state == CLOSED_LOOP and self.state[node] != CLOSED_LOOP:
            self._target[node] = controller.target_q[node]
        if state != CLOSED_LOOP:
            controller.let_go()
        self.state[node] = state

    def _set_target(self, node: int, turns: float, controller: ArmController) -> None:
        if self.state[node] != CLOSED_LOOP or self.mode[node] != (POSITION_CONTROL, PASSTHROUGH):
            return
        self._target[node] = self.joint(node, turns, TURN)
        if all(state == CLOSED_LOOP for state in self.state):
            controller.command(self._target)

    def publish(self, controller: ArmController) -> None:
        """Send encoder estimates and, more seldom, heartbeats.

        A late estimate puts off the next: the firmware (CANSimple::service_stack) counts its period
        from when the last one left, and never sends two at once to catch up.
        """
        if self._now() >= self._due:
            self.begin_sample()
            rows = zip(self.wire(TURN), self.speeds(controller, TURN), strict=True)
            for node, (turns, speed) in enumerate(rows):
                self.send(node << 5 | ENCODER, struct.pack("<ff", turns, speed))
            self._due = self._now() + ENCODER_PERIOD
        if self._count % HEARTBEAT_EVERY == 0:
            error = 0 if controller.can_move else ESTOP_REQUESTED
            for node, state in enumerate(self.state):
                self.send(node << 5 | HEARTBEAT, struct.pack("<IBxxx", error, state))
        self._count += 1
