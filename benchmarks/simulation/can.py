"""CAN: a bus in memory between the product's driver and the simulated PiPER."""

from __future__ import annotations

import math
import random
import struct
from collections import deque
from collections.abc import Callable
from typing import Any

import can as python_can

from benchmarks.simulation.links import SimulatedLink
from benchmarks.simulation.world import Process
from gapbridge.core.errors import LinkError
from gapbridge.core.state import RobotState
from gapbridge.drivers.can import driver as can_driver
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.simulated.can.frame import Frame
from gapbridge.drivers.simulated.can.piper_node import TARGETS, UNIT, PiperNode

CONTROL = (0x150, 0x151, 0x155, 0x156, 0x157, 0x471)
STATUS, TEACHING = 0x2A1, 2  # the arm's status; its control mode while it is led by hand
STATUSES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13)  # of the arm, all but normal
MOST_WAITING = 5000  # frames that the kernel keeps


Frames = tuple[int, bytes, float] | python_can.Message
"""Identifier, data, s when the arm sampled it; or a frame that is none of the arm's."""


class _Node(PiperNode):
    """The arm, whose frames go to the link's wires."""

    link: CanLink

    def _receive(self) -> Frame | None:
        inbox = self.link.inbox
        return inbox.popleft() if inbox else None

    def send(self, identifier: int, data: bytes) -> None:
        """Send one frame."""
        link = self.link
        if identifier == STATUS and link.arm_status:
            data = bytes([data[0], link.arm_status]) + data[2:]
        if identifier not in self.withheld and identifier not in self._lost:
            link.down.send((identifier, data, link.world.now))


class _Bus:
    """The client's end, as python-can gives it."""

    def __init__(self, link: CanLink) -> None:
        self._link, self.generation = link, link.generation
        self.frames: deque[Frames] = deque(maxlen=MOST_WAITING)

    def recv(self, timeout: float) -> Any:
        link = self._link
        if self.generation != link.generation:
            raise python_can.CanOperationError("Connection reset by peer")
        if not self.frames and not self._wait(timeout):
            return None
        found = self.frames.popleft()
        if isinstance(found, python_can.Message):
            return found
        identifier, data, link.last_sampled = found
        return python_can.Message(
            timestamp=link.world.now, arbitration_id=identifier, is_extended_id=False, data=data,
            check=False,
        )  # fmt: skip

    def _wait(self, timeout: float) -> bool:
        """Wait for a frame; return whether one has come."""
        link, world = self._link, self._link.world
        until = world.now + timeout
        while not self.frames:
            left = until - world.now
            if left <= 0.0:
                return False
            process = world.current
            assert process is not None
            link.waiting = process
            process.sleep(left)
            if self.generation != link.generation:
                raise python_can.CanOperationError("Connection reset by peer")
        return True

    def send(self, frame: Any, timeout: float | None = None) -> None:
        link = self._link
        if self.generation != link.generation:
            raise python_can.CanOperationError("Connection reset by peer")
        if link.refuses_frames and link.world.random.random() < 0.5:
            raise python_can.CanOperationError("No buffer space available")
        link.note(frame.arbitration_id, bytes(frame.data))
        link.up.send((frame.arbitration_id, bytes(frame.data)))

    def shutdown(self) -> None: ...


class CanLink(SimulatedLink):
    """One PiPER on a bus."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.up.jitter = self.down.jitter = 0.0
        self.generation = 0
        self.inbox: deque[Frame] = deque()
        self.bus: _Bus | None = None
        self.waiting: Process | None = None
        self.last_sampled = self.world.now
        self.refuses_frames = False
        self.arm_status = 0  # reported in place of the arm's own
        self._goal = list(self.controller.q)
        self._seen: dict[int, tuple[float, float]] = {}
        self._safe = True
        link: Any = self.setting.cell.link
        self.node = _Node(link, "127.0.0.9", self.controller)
        self.node.link = self
        self.node._bus = self  # its frames go through ``_receive`` and ``send`` above

    def driver(self) -> Driver:
        """See SimulatedLink.driver."""
        link = self
        found = self.setting.make_driver(can_driver, CanDriver, self.clock)

        def open_bus() -> None:
            link.clock.sleep(0.005)
            if not link.reachable:
                raise LinkError("can: cannot be reached: refused")
            link.reconnected()
            found.reader.bus = link.bus = _Bus(link)
            found.reader._empty = link.world.now

        read = found._read_state

        def read_state() -> RobotState:
            state = read()
            link._sampled[state.received] = link.last_sampled
            return state

        found.reader.open = open_bus  # type: ignore[method-assign]
        found._read_state = read_state  # type: ignore[method-assign]
        return found

    def note(self, identifier: int, data: bytes) -> None:
        """Report a frame that leaves the client; the last of three makes a setpoint."""
        if identifier not in CONTROL or identifier == 0x150:
            self.wrote("forbidden" if identifier != 0x150 else "other", (), f"{identifier:#x}")
            return
        first = TARGETS.get(identifier)
        if first is None:
            self.wrote("other", (), f"{identifier:#x}")
            return
        for i, value in enumerate(struct.unpack(">ii", data), first):
            self._goal[i] = self.node.joint(i, value, UNIT)
        if first == 4:
            self.wrote("joints", tuple(self._goal), "0x155-0x157")
        else:
            self.wrote("other", (), f"{identifier:#x}")

    def cycle(self) -> None:
        """Have the arm take its frames and send its own."""
        if self.freezes_values:
            kept = self.node._kept
            self.node.cycle(self.controller)
            self.node._kept = kept
        else:
            self.node.cycle(self.controller)

    def publish(self) -> None:
        """Send nothing more: the node has."""

    def _on_up(self, message: tuple[int, bytes]) -> None:
        if self.world.now >= self.rebooting_until:
            self.inbox.append(Frame(message[0], message[1], False))

    def _on_down(self, message: tuple[int, bytes, float]) -> None:
        bus = self.bus
        if bus is None or bus.generation != self.generation:
            return
        bus.frames.append(message)
        self._look(*message)
        self._wake()

    def _wake(self) -> None:
        if self.waiting is not None:
            waiting, self.waiting = self.waiting, None
            waiting.wake()

    def flood(self, seconds: float, each: int, frame: Callable[[], python_can.Message]) -> None:
        """Have so many frames of other nodes reach the client each millisecond."""
        until = self.world.now + seconds

        def send() -> None:
            bus = self.bus
            if bus is not None and bus.generation == self.generation:
                bus.frames.extend(frame() for _ in range(each))
                self._wake()
            if self.world.now < until:
                self.world.after(1e-3, send)

        send()

    def enter_mode(self, draw: random.Random) -> str:
        """See SimulatedLink.enter_mode."""
        if draw.random() < 0.3:
            self.node.control_mode = TEACHING
            self.controller.let_go()
            return "led by hand"
        self.arm_status = draw.choice(STATUSES)
        self.controller.protective_stop()
        return f"arm status {self.arm_status}"

    def leave_mode(self) -> None:
        """See SimulatedLink.leave_mode."""
        if self.arm_status:
            self.arm_status = 0
            self.controller.unlock()
        if self.node.control_mode == TEACHING:
            self.node.control_mode = 0

    def _look(self, identifier: int, data: bytes, _: float) -> None:
        """See what a checker sees of a frame: joints in three, the arm's state in one."""
        if identifier == STATUS and len(data) == 8:
            self._safe = data[1] == 0
        place = identifier - 0x2A5
        if not 0 <= place < 3 or len(data) != 8:
            return
        first, second = struct.unpack(">ii", data)
        joint = self.node.joint
        self._seen[place] = (
            joint(2 * place, first, UNIT), joint(2 * place + 1, second, UNIT),
        )  # fmt: skip
        if place == 2 and len(self._seen) == 3:
            q = [v for k in range(3) for v in self._seen[k]]
            self._seen.clear()
            self.see((math.nan, q, q, self._safe))

    def disconnect(self) -> None:
        """See SimulatedLink.disconnect."""
        super().disconnect()
        self.generation += 1
        if self.waiting is not None:
            self.waiting.wake()

    def forget_client(self) -> None:
        """See SimulatedLink.forget_client."""
        super().forget_client()
        self.node.control_mode, self.node.enabled = 0, [False] * 6

    def heal(self) -> None:
        """See SimulatedLink.heal."""
        super().heal()
        self.node.withheld.clear()
        self.refuses_frames = False

    def key_of(self, state: RobotState) -> float:
        """See SimulatedLink.key_of."""
        return state.received

    def foreign(self, seconds: float) -> None:
        """Have another commander send targets, for a while."""
        until = self.world.now + seconds

        def send() -> None:
            wire = [round(v / UNIT) for v in self.controller.q[:2]]
            data = struct.pack(">ii", *wire)
            self.down.send((0x155, data, self.world.now))
            if self.world.now < until:
                self.world.after(0.02, send)

        send()


def spoiled(message: tuple[int, bytes, float], draw: Any) -> tuple[int, bytes, float]:
    """Return a frame that is wrong in one way."""
    identifier, data, sampled = message
    kind = draw.randrange(3)
    if kind == 0:
        return identifier, data[: draw.randrange(len(data))] if data else data, sampled
    if kind == 1:
        return draw.choice((0x2A5, 0x2A6, 0x2A7, 0x2A1)), data, sampled
    at = draw.randrange(len(data)) if data else 0
    changed = data[:at] + bytes([data[at] ^ (1 << draw.randrange(8))]) + data[at + 1 :]
    return identifier, changed, sampled


def foreign_frame(draw: random.Random) -> python_can.Message:
    """Return a frame that no profile of ours knows, or knows in another form."""
    extended = draw.random() < 0.3
    identifier = draw.choice((0x2A5, STATUS)) if extended else draw.randrange(0x300, 0x470)
    return python_can.Message(
        arbitration_id=identifier, is_extended_id=extended, data=draw.randbytes(8),
        is_remote_frame=False, check=False,
    )  # fmt: skip


def error_frame() -> python_can.Message:
    """Return what an adapter reports of an error on the bus."""
    return python_can.Message(is_error_frame=True, arbitration_id=0x20000004, data=bytes(8))
