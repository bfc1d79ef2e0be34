"""Simulated Damiao actuators in MIT mode, as OpenArm has them.

Motor i (from 1) listens to identifier i and answers as 0x10 + i, each time it is spoken to. Fields
are packed big-endian over byte borders, as openarm_can describes them. An actuator holds its
position as if gravity were compensated: its gains only have to be there.
"""

from __future__ import annotations

from typing import NamedTuple

from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.server.arm_controller import ArmController


class Ranges(NamedTuple):
    """Ranges of an actuator's fields, from minus to plus."""

    velocity: float  # rad/s
    torque: float  # Nm


POSITION = 12.5  # rad
DM8009, DM4340, DM4310 = Ranges(45.0, 54.0), Ranges(10.0, 28.0), Ranges(30.0, 10.0)
MOTORS = (DM8009, DM8009, DM4340, DM4340, DM4310, DM4310, DM4310)
QUERY, REFRESH = 0x7FF, 0xCC
ENABLE, DISABLE = b"\xff" * 7 + b"\xfc", b"\xff" * 7 + b"\xfd"


class MitNodes(CanNodes):
    """Seven actuators at most, in a chain."""

    def __init__(self, link: CanSettings, host: str, controller: ArmController) -> None:
        super().__init__(link, host, controller)
        self.enabled = [False] * controller.n
        self._target = list(controller.target_q)

    def take(self, identifier: int, data: bytes, controller: ArmController) -> None:
        """Execute enable, disable and MIT commands; answer these and queries."""
        motor = identifier - 1
        if identifier == QUERY and len(data) >= 3 and data[2] == REFRESH:
            motor = int.from_bytes(data[:2], "little") - 1
        elif not (0 <= motor < controller.n and len(data) == 8):
            return
        elif data == ENABLE:
            self.enabled[motor] = True
            self._target[motor] = controller.target_q[motor]
        elif data == DISABLE:
            self.enabled[motor] = False
            controller.let_go()
        else:
            self._set_target(motor, data, controller)
        if 0 <= motor < controller.n:
            self._answer(motor, controller)

    def _set_target(self, motor: int, data: bytes, controller: ArmController) -> None:
        stiffness = ((data[3] & 0xF) << 8) | data[4]
        if not self.enabled[motor] or not stiffness:
            return
        count = int.from_bytes(data[:2], "big")
        self._target[motor] = self.joint(motor, 2 * POSITION * count / 0xFFFF - POSITION, 1.0)
        if all(self.enabled):
            controller.command(self._target)

    def _answer(self, motor: int, controller: ArmController) -> None:
        if motor == 0:
            self.begin_sample()
        ranges = MOTORS[motor % len(MOTORS)]
        q = _count(self.wire(1.0)[motor], POSITION, 16)
        dq = _count(self.speeds(controller, 1.0)[motor], ranges.velocity, 12)
        torque = _count(controller.joint_torque[motor] * self._sign[motor], ranges.torque, 12)
        state = 0xA if not controller.can_move else int(self.enabled[motor])
        packed = q << 24 | dq << 12 | torque
        warm = max(0, min(255, round(controller.temperatures[motor])))
        head = bytes([state << 4 | (motor + 1) & 0xF])
        self.send(0x11 + motor, head + packed.to_bytes(5, "big") + bytes([warm, warm]))

    def publish(self, controller: ArmController) -> None:
        """Send nothing: an actuator only answers."""


def _count(value: float, reach: float, bits: int) -> int:
    most = (1 << bits) - 1
    return max(0, min(most, round((value + reach) / (2 * reach) * most)))
