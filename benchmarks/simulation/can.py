"""CAN: a bus in memory between the product's driver and the simulated arms of ``can_arms``."""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import can as python_can

from benchmarks.simulation.can_arms import ARMS
from benchmarks.simulation.links import SimulatedLink
from benchmarks.simulation.world import Process
from gapbridge.core.errors import LinkError
from gapbridge.core.state import RobotState
from gapbridge.drivers.can import driver as can_driver
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.simulated.can.frame import Frame

MOST_WAITING = 5000  # frames that the kernel keeps


Frames = tuple[int, bytes, float] | python_can.Message
"""Identifier, data, s when the arm sampled it; or a frame that is none of the arm's."""


class Received(NamedTuple):
    """A frame as python-can gives it, without what making one of its own costs."""

    arbitration_id: int
    data: bytes
    timestamp: float
    is_rx = True
    is_error_frame = is_remote_frame = is_extended_id = is_fd = False


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
        return Received(identifier, data, link.world.now)

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
    """One arm on a bus."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.up.jitter = self.down.jitter = 0.0
        self.generation = 0
        self.inbox: deque[Frame] = deque()
        self.bus: _Bus | None = None
        self.waiting: Process | None = None
        self.last_sampled = self.world.now
        self.refuses_frames = False
        self._goal = list(self.controller.q)
        self._seen: dict[int, float] = {}  # joint -> rad
        kind, settings = ARMS[self.setting.name], cast(CanSettings, self.setting.cell.link)
        node = kind.made(lambda made: made(settings, "127.0.0.9", self.controller), self.clock)
        self.arm = kind(node, self.controller)
        self.node = node
        node._bus = self  # its frames go through the two below
        node._receive = self._next_frame  # type: ignore[method-assign]
        node.send = self._send  # type: ignore[method-assign]

    def _next_frame(self) -> Frame | None:
        return self.inbox.popleft() if self.inbox else None

    def _send(self, identifier: int, data: bytes) -> None:
        """Send one frame of the arm."""
        if identifier not in self.node.withheld and identifier not in self.node._lost:
            self.down.send((identifier, self.arm.altered(identifier, data), self.world.now))

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
        """Report a frame that leaves the client; the last target makes a setpoint."""
        arm = self.arm
        targets = arm.targets(identifier, data)
        for i, q in targets.items():
            self._goal[i] = q
        if targets and identifier == arm.last_target:
            self.wrote("joints", tuple(self._goal), f"{identifier:#x}")
            return
        if not targets:
            arm.sent(identifier, data)
        self.wrote("other" if identifier in arm.sends else "forbidden", (), f"{identifier:#x}")

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
        if self.world.now < self.rebooting_until:
            return
        if not self.arm.answers_at_once:
            self.inbox.append(Frame(message[0], message[1], False))
        elif not self.controller.stalled:
            self.arm.taken(*message, self.world.now)
            self.node.take(*message, self.controller)

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
        return self.arm.enter_mode(draw)

    def leave_mode(self) -> None:
        """See SimulatedLink.leave_mode."""
        self.arm.leave_mode()

    def _look(self, identifier: int, data: bytes, sampled: float) -> None:
        """See what a checker sees of a frame: the arm's state, and joints until all are there."""
        arm = self.arm
        arm.look(identifier, data)
        if identifier not in arm.reports or not arm.reports_a_sample(identifier, sampled):
            return
        self._seen.update(arm.joints(identifier, data))
        in_order = identifier == arm.reports[-1] or not arm.is_ordered
        if in_order and len(self._seen) == self.controller.n:
            q = [self._seen[i] for i in range(self.controller.n)]
            self._seen.clear()
            self.see((math.nan, q, q, arm.safe))

    def disconnect(self) -> None:
        """See SimulatedLink.disconnect."""
        super().disconnect()
        self.generation += 1
        if self.waiting is not None:
            self.waiting.wake()

    def forget_client(self) -> None:
        """See SimulatedLink.forget_client."""
        super().forget_client()
        self.arm.forget()

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
            self.down.send((*self.arm.foreign_target(), self.world.now))
            if self.world.now < until:
                self.world.after(0.02, send)

        send()

    def spoiled(self, message: Any, draw: Any) -> Any:
        """Return a frame that is wrong in one way."""
        identifier, data, sampled = message
        kind = draw.randrange(3)
        if kind == 0:
            return identifier, data[: draw.randrange(len(data))] if data else data, sampled
        if kind == 1:
            return draw.choice((*self.arm.reports, *self.arm.others[:1])), data, sampled
        if not data:
            return message
        at = draw.randrange(len(data))
        changed = data[:at] + bytes([data[at] ^ (1 << draw.randrange(8))]) + data[at + 1 :]
        return identifier, changed, sampled


def foreign_frame(draw: random.Random, known: Sequence[int] = (0x2A5, 0x2A1)) -> python_can.Message:
    """Return a frame that no profile of ours knows, or one of ``known`` in another form."""
    extended = draw.random() < 0.3
    identifier = draw.choice(known) if extended else draw.randrange(0x300, 0x470)
    return python_can.Message(
        arbitration_id=identifier, is_extended_id=extended, data=draw.randbytes(8),
        is_remote_frame=False, check=False,
    )  # fmt: skip


def error_frame() -> python_can.Message:
    """Return what an adapter reports of an error on the bus."""
    return python_can.Message(is_error_frame=True, arbitration_id=0x20000004, data=bytes(8))
