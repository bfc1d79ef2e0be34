"""An OpenArm: seven actuators in MIT mode, each of which speaks when it is spoken to."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable

from benchmarks.simulation.can_arms.arm import CanArm, Joints
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.mit_node import DISABLE, ENABLE, QUERY, MitNodes
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.server.arm_controller import ArmController

MOTORS = 7
REACH, MOST = 12.5, 0xFFFF  # rad, counts: a position from minus to plus
ANSWERS = 0x11  # identifier of the first motor's answer
ERRORS = (0x8, 0x9, 0xA, 0xB, 0xC, 0xD, 0xE)  # voltage, current, temperature, silence, overload
ENABLED = 1
RECENT = 10  # questions, some of whose answers may be under way


class OpenArm(CanArm):
    """Seven motors, identifiers 1 to 7."""

    reports, others = tuple(ANSWERS + motor for motor in range(MOTORS)), ()
    sends = frozenset({*range(1, MOTORS + 1), QUERY})
    last_target = MOTORS
    answers_at_once = True
    node: MitNodes

    def __init__(self, node: CanNodes, controller: ArmController) -> None:
        super().__init__(node, controller)
        self._errors: dict[int, int] = {}  # motor -> its error
        self._says: dict[int, int] = {}  # motor -> state in its answer
        self._ran: set[int] = set()  # motors that said enabled since they were last switched
        self._asked = [deque[float](maxlen=RECENT) for _ in range(MOTORS)]  # s: when each was asked

    @classmethod
    def made(cls, make: Callable[[type[CanNodes]], CanNodes], clock: Clock) -> CanNodes:
        """See CanArm.made."""
        return make(MitNodes)

    def targets(self, identifier: int, data: bytes) -> Joints:
        """See CanArm.targets."""
        if not 1 <= identifier <= MOTORS or len(data) != 8 or data in (ENABLE, DISABLE):
            return {}
        return self._angle(identifier - 1, data[:2])

    def joints(self, identifier: int, data: bytes) -> Joints:
        """See CanArm.joints."""
        return self._angle(identifier - ANSWERS, data[1:3]) if len(data) == 8 else {}

    def _angle(self, motor: int, count: bytes) -> Joints:
        angle = 2.0 * REACH * int.from_bytes(count, "big") / MOST - REACH
        return {motor: self.node.joint(motor, angle, 1.0)}

    def taken(self, identifier: int, data: bytes, now: float) -> None:
        """See CanArm.taken: answers to commands are no part of the sample that was asked for."""
        if identifier == QUERY and 1 <= data[0] <= MOTORS:
            self._asked[data[0] - 1].append(now)

    def reports_a_sample(self, identifier: int, sampled: float) -> bool:
        """See CanArm.reports_a_sample."""
        return sampled in self._asked[identifier - ANSWERS]

    def look(self, identifier: int, data: bytes) -> None:
        """See CanArm.look: a motor must not move with an error, or once it has been disabled."""
        if identifier not in self.reports or len(data) != 8:
            return
        motor, state = identifier - ANSWERS, data[0] >> 4
        if state == ENABLED:
            self._ran.add(motor)
        self._says[motor] = state
        self._judge()

    def sent(self, identifier: int, data: bytes) -> None:
        """See CanArm.sent: a motor that is being enabled need not be so yet."""
        if data == ENABLE:
            self._ran.discard(identifier - 1)
            self._judge()

    def _judge(self) -> None:
        self.safe = not any(
            state > ENABLED or (motor in self._ran and state != ENABLED)
            for motor, state in self._says.items()
        )

    def altered(self, identifier: int, data: bytes) -> bytes:
        """See CanArm.altered."""
        error = self._errors.get(identifier - ANSWERS)
        return data if error is None else bytes([error << 4 | data[0] & 0xF]) + data[1:]

    def enter_mode(self, draw: random.Random) -> str:
        """See CanArm.enter_mode: one motor has an error, or is disabled."""
        motor = draw.randrange(MOTORS)
        self.node.enabled[motor] = False
        self.controller.let_go()
        if draw.random() < 0.5:
            return f"motor {motor + 1} disabled"
        self._errors[motor] = error = draw.choice(ERRORS)
        self.controller.protective_stop()
        return f"motor {motor + 1}, error {error:#x}"

    def leave_mode(self) -> None:
        """See CanArm.leave_mode: errors are cleared; arming enables motors."""
        if self._errors:
            self._errors.clear()
            self.controller.unlock()

    def forget(self) -> None:
        """See CanArm.forget."""
        self.node.enabled = [False] * MOTORS

    def foreign_target(self) -> tuple[int, bytes]:
        """See CanArm.foreign_target."""
        count = round((self.controller.q[0] + REACH) / (2.0 * REACH) * MOST)
        return 1, count.to_bytes(2, "big") + bytes([0x7F, 0xF2, 0x3D, 0x80, 0x7F, 0xFF])
