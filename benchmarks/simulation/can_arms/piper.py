"""An AgileX PiPER: joints in three frames of two, one frame of status."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

from benchmarks.simulation.can_arms.arm import CanArm, Joints
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.can.piper_node import TARGETS, UNIT, PiperNode

STATUS, TEACHING = 0x2A1, 2  # the arm's status; its control mode while it is led by hand
STATUSES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13)  # of the arm, all but normal


class Piper(CanArm):
    """Six joints, 0.001 degrees."""

    reports, others = (0x2A5, 0x2A6, 0x2A7), (STATUS, 0x261)
    sends = frozenset({0x150, 0x151, 0x155, 0x156, 0x157, 0x471})
    last_target = 0x157
    is_ordered = True
    node: PiperNode
    status = 0  # reported in place of the arm's own

    @classmethod
    def made(cls, make: Callable[[type[CanNodes]], CanNodes], clock: Clock) -> CanNodes:
        """See CanArm.made."""
        return make(PiperNode)

    def targets(self, identifier: int, data: bytes) -> Joints:
        """See CanArm.targets."""
        first = TARGETS.get(identifier)
        return {} if first is None else self._pair(first, data)

    def joints(self, identifier: int, data: bytes) -> Joints:
        """See CanArm.joints."""
        return self._pair(2 * (identifier - self.reports[0]), data)

    def _pair(self, first: int, data: bytes) -> Joints:
        if len(data) != 8:
            return {}
        values = enumerate(struct.unpack(">ii", data), first)
        return {i: self.node.joint(i, value, UNIT) for i, value in values}

    def look(self, identifier: int, data: bytes) -> None:
        """See CanArm.look."""
        if identifier == STATUS and len(data) == 8:
            self.safe = data[1] == 0

    def altered(self, identifier: int, data: bytes) -> bytes:
        """See CanArm.altered."""
        if identifier == STATUS and self.status:
            return bytes([data[0], self.status]) + data[2:]
        return data

    def enter_mode(self, draw: random.Random) -> str:
        """See CanArm.enter_mode."""
        if draw.random() < 0.3:
            self.node.control_mode = TEACHING
            self.controller.let_go()
            return "led by hand"
        self.status = draw.choice(STATUSES)
        self.controller.protective_stop()
        return f"arm status {self.status}"

    def leave_mode(self) -> None:
        """See CanArm.leave_mode."""
        if self.status:
            self.status = 0
            self.controller.unlock()
        if self.node.control_mode == TEACHING:
            self.node.control_mode = 0

    def forget(self) -> None:
        """See CanArm.forget."""
        self.node.control_mode, self.node.enabled = 0, [False] * 6

    def foreign_target(self) -> tuple[int, bytes]:
        """See CanArm.foreign_target."""
        wire = [round(v / UNIT) for v in self.controller.q[:2]]
        return 0x155, struct.pack(">ii", *wire)
