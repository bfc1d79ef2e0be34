"""Six ODrive axes: each reports its joint in a frame of its own, and errors in a heartbeat."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

from benchmarks.simulation.can_arms.arm import CanArm, Joints
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.can.odrive_node import (
    CLOSED_LOOP,
    ENCODER,
    HEARTBEAT,
    INPUT_POSITION,
    SET_MODE,
    SET_STATE,
    TURN,
    OdriveNodes,
)
from gapbridge.drivers.simulated.server.arm_controller import ArmController

AXES = 6
HEARTBEAT_EVERY = 10  # cycles, 100 ms at 100 Hz: the profile's heartbeat_msg_rate_ms
ERRORS = (0x1, 0x4, 0x10, 0x200, 0x1000, 0x4000, 0x100_0000, 0x400_0000)  # Error of CANSimple
STATES = (0, 1, 3, 6, 9)  # of an axis: undefined, idle, calibrating, searching, ...
MODES = ((0, 1), (1, 1), (2, 1), (3, 0), (3, 2), (3, 5))  # control and input, others than ours


class _Axes(OdriveNodes):
    """The axes, whose cycle is that of their messages."""

    clock: Clock

    def publish(self, controller: ArmController) -> None:
        """See CanNodes.publish."""
        self._due = 0.0
        self._now = self.clock.monotonic
        count = self._count
        self._count = 0 if count % HEARTBEAT_EVERY == 0 else 1
        super().publish(controller)
        self._count = count + 1


class Odrive(CanArm):
    """Six axes, nodes 0 to 5."""

    reports = tuple(node << 5 | ENCODER for node in range(AXES))
    others = tuple(node << 5 | HEARTBEAT for node in range(AXES))
    sends = frozenset(
        node << 5 | command
        for node in range(AXES)
        for command in (SET_STATE, SET_MODE, INPUT_POSITION)
    )
    last_target = (AXES - 1) << 5 | INPUT_POSITION
    node: _Axes

    def __init__(self, node: CanNodes, controller: ArmController) -> None:
        super().__init__(node, controller)
        self._errors: dict[int, int] = {}  # node -> its error
        self._says: dict[int, tuple[int, int]] = {}  # node -> error and state of its heartbeat
        self._ran: set[int] = set()  # nodes that said closed loop since they were last switched

    @classmethod
    def made(cls, make: Callable[[type[CanNodes]], CanNodes], clock: Clock) -> CanNodes:
        """See CanArm.made."""
        found = make(_Axes)
        assert isinstance(found, _Axes)
        found.clock = clock
        return found

    def targets(self, identifier: int, data: bytes) -> Joints:
        """See CanArm.targets."""
        return self._turns(identifier, data) if identifier & 0x1F == INPUT_POSITION else {}

    def joints(self, identifier: int, data: bytes) -> Joints:
        """See CanArm.joints."""
        return self._turns(identifier, data)

    def _turns(self, identifier: int, data: bytes) -> Joints:
        if len(data) != 8:
            return {}
        axis = identifier >> 5
        return {axis: self.node.joint(axis, struct.unpack("<f", data[:4])[0], TURN)}

    def look(self, identifier: int, data: bytes) -> None:
        """See CanArm.look: an axis must not move with an error, or once it has left closed loop."""
        if identifier not in self.others or len(data) != 8:
            return
        axis, (error, state) = identifier >> 5, struct.unpack("<IBxxx", data)
        if state == CLOSED_LOOP:
            self._ran.add(axis)
        self._says[axis] = error, state
        self._judge()

    def sent(self, identifier: int, data: bytes) -> None:
        """See CanArm.sent: an axis that is switched need not be in closed loop yet."""
        self._ran.discard(identifier >> 5)
        self._judge()

    def _judge(self) -> None:
        self.safe = not any(
            error or (axis in self._ran and state != CLOSED_LOOP)
            for axis, (error, state) in self._says.items()
        )

    def altered(self, identifier: int, data: bytes) -> bytes:
        """See CanArm.altered."""
        error = self._errors.get(identifier >> 5)
        if error is not None and identifier & 0x1F == HEARTBEAT:
            return struct.pack("<I", error) + data[4:]
        return data

    def enter_mode(self, draw: random.Random) -> str:
        """See CanArm.enter_mode: one axis has an error, another state, or another mode."""
        axis, kind = draw.randrange(AXES), draw.random()
        if kind < 0.4:
            error = draw.choice(ERRORS)
            self._errors[axis] = error
            self.node._set_state(axis, 1, self.controller)  # as the firmware does
            self.controller.protective_stop()
            return f"axis {axis}, error {error:#x}"
        if kind < 0.8:
            state = draw.choice(STATES)
            self.node._set_state(axis, state, self.controller)
            return f"axis {axis}, state {state}"
        self.node.mode[axis] = mode = draw.choice(MODES)
        return f"axis {axis}, mode {mode}"

    def leave_mode(self) -> None:
        """See CanArm.leave_mode: errors are cleared; arming sets states and modes."""
        if self._errors:
            self._errors.clear()
            self.controller.unlock()

    def forget(self) -> None:
        """See CanArm.forget."""
        self.node.state, self.node.mode = [1] * AXES, [(0, 0)] * AXES

    def foreign_target(self) -> tuple[int, bytes]:
        """See CanArm.foreign_target."""
        node = self.node
        turns = (self.controller.q[0] - node._zero[0]) * node._sign[0] * node._gear[0] / TURN
        return INPUT_POSITION, struct.pack("<fhh", turns, 0, 0)
