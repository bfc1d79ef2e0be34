"""A simulated AgileX PiPER: status, joints and motors at its public identifiers.

Frames as piper_sdk 0.6 describes them (piper_msgs/msg_v2); big-endian, 0.001 deg.
"""

from __future__ import annotations

import math
import struct

from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.server.arm_controller import ArmController

UNIT = math.radians(0.001)
FACTORS = (1.18125, 1.18125, 1.18125, 0.95844, 0.95844, 0.95844)  # Nm per A, as in piper_sdk
STANDBY, CAN_CONTROL = 0, 1
MOVE_J = 1
LOW_EVERY = 5  # cycles between the motors' low speed feedback
TARGETS = {0x155: 0, 0x156: 2, 0x157: 4}


class PiperNode(CanNodes):
    """The arm's main controller and its six motors, all on one identifier range."""

    def __init__(self, link: CanSettings, host: str, controller: ArmController) -> None:
        super().__init__(link, host, controller)
        self.control_mode, self.move_mode = STANDBY, 0
        self.enabled = [False] * 6
        self._target = list(controller.target_q)
        self._count = 0

    def take(self, identifier: int, data: bytes, controller: ArmController) -> None:
        """Execute 0x150 (stop, resume), 0x151 (mode), 0x155-0x157 (targets), 0x471 (motors)."""
        if len(data) != 8:
            return
        if identifier == 0x150:
            self._stop_or_resume(data[0], controller)
        elif identifier == 0x151:
            self._set_mode(data[0], data[1], controller)
        elif identifier in TARGETS:
            self._set_target(TARGETS[identifier], data, controller)
        elif identifier == 0x471:
            self._switch(data[0], data[1], controller)

    def _stop_or_resume(self, action: int, controller: ArmController) -> None:
        if action == 1:
            controller.emergency_stop()
        elif action == 2:
            controller.release_emergency_stop()
            controller.unlock()
            self.control_mode = STANDBY
            self.enabled = [False] * 6

    def _set_mode(self, control: int, move: int, controller: ArmController) -> None:
        if control == CAN_CONTROL and self.control_mode != CAN_CONTROL:
            self._target = list(controller.target_q)
        if control == STANDBY and self.control_mode == CAN_CONTROL:
            controller.let_go()
        if control in (STANDBY, CAN_CONTROL):
            self.control_mode, self.move_mode = control, move

    def _set_target(self, first: int, data: bytes, controller: ArmController) -> None:
        if self.control_mode != CAN_CONTROL or self.move_mode != MOVE_J or not all(self.enabled):
            return
        for i, value in enumerate(struct.unpack(">ii", data), first):
            self._target[i] = self.joint(i, value, UNIT)
        controller.command(self._target)

    def _switch(self, motor: int, action: int, controller: ArmController) -> None:
        chosen = range(6) if motor in (7, 0xFF) else range(motor - 1, motor)
        for i in chosen:
            if 0 <= i < 6 and action in (1, 2):
                self.enabled[i] = action == 2
        if not all(self.enabled):
            controller.let_go()

    def publish(self, controller: ArmController) -> None:
        """Send joints, motors' high speed feedback and status; low speed feedback less often."""
        self.begin_sample()
        wire = [round(value) for value in self.wire(UNIT)]
        for k in range(3):
            self.send(0x2A5 + k, struct.pack(">ii", *wire[2 * k : 2 * k + 2]))
        status = 1 if controller.emergency else 7 if controller.protective else 0
        self.send(
            0x2A1,
            bytes(
                [self.control_mode, status, self.move_mode, 0, self._moving(controller), 0, 0, 0]
            ),
        )
        torque = controller.joint_torque
        for i, speed in enumerate(self.speeds(controller, 0.001)):
            current = torque[i] * self._sign[i] / (FACTORS[i] * 0.001)
            self.send(0x251 + i, struct.pack(">hhi", _short(speed), _short(current), 0))
        self._count += 1
        if self._count % LOW_EVERY == 1:
            self._send_motors(controller)

    def _moving(self, controller: ArmController) -> int:
        far = max(abs(a - b) for a, b in zip(controller.q, controller.target_q, strict=True))
        return int(far > 1e-3)

    def _send_motors(self, controller: ArmController) -> None:
        for i, celsius in enumerate(controller.temperatures):
            bits = 0x40 if self.enabled[i] else 0
            frame = struct.pack(">HhbBH", 240, round(celsius), round(celsius), bits, 500)
            self.send(0x261 + i, frame)


def _short(value: float) -> int:
    return max(-32768, min(32767, round(value)))
