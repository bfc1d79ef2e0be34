"""CANopen: a bus in memory between the product's master and simulated CiA 402 drives."""

from __future__ import annotations

import functools
import math
import queue
import random
import struct
import threading
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import can as python_can

from benchmarks.simulation.can import Received
from benchmarks.simulation.canopen_drives import OPERATIONAL, SimulatedDrives
from benchmarks.simulation.links import SimulatedLink
from benchmarks.simulation.world import Process, SimulatedClock
from gapbridge.core.errors import LinkError
from gapbridge.core.state import RobotState
from gapbridge.drivers.canopen import driver as canopen_driver
from gapbridge.drivers.canopen import master as canopen_master
from gapbridge.drivers.canopen.driver import CanopenDriver
from gapbridge.drivers.canopen.master import AllowedFrames, Master
from gapbridge.drivers.canopen.objects import (
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    RPDO_BASE,
    SYNC,
    TPDO_BASE,
)
from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.driver import Driver

FOLLOWS = 0x1027  # Statusword: OPERATION ENABLED, and the drive follows the command
STATE_BITS = 0x106F
CYCLIC = 8  # cyclic synchronous position
LOOK = 1e-3  # s between two looks at a lock


class BusFrame(NamedTuple):
    """A frame on its way to the master, and when what it says was measured, s."""

    cob_id: int
    data: bytes
    sampled: float


class _Network(canopen_master._Network):
    """The product's, whose bus is the link's wires and whose thread is the world."""

    def __init__(self, link: CanopenLink, allowed: AllowedFrames) -> None:
        super().__init__(cast(Any, _Bus(link)), allowed)
        self._link = link

    def connect(self, *_: Any, **__: Any) -> Any:
        """Receive from now on."""
        self.notifier = cast(Any, SimpleNamespace(exception=None))
        for remote in self.values():
            cast(Any, remote).sdo.responses = _Responses(self._link)
        self._link.network = self
        return self

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Send a frame that the profile allows."""
        self._allowed.check(can_id, data)
        cast(_Bus, self.bus).send(can_id, bytes(data))
        self.check()

    def disconnect(self) -> None:
        """Receive nothing any more."""
        if self._link.network is self:
            self._link.network = None


class _Bus:
    """The client's end, as python-can gives it."""

    def __init__(self, link: CanopenLink) -> None:
        self._link, self._generation = link, link.generation

    def send(self, cob_id: int, data: bytes) -> None:
        link = self._link
        if self._generation != link.generation:
            raise python_can.CanOperationError("Connection reset by peer")
        if link.refuses_frames and link.world.random.random() < 0.5:
            raise python_can.CanOperationError("No buffer space available")
        link.note(cob_id, data)
        link.up.send((cob_id, data))

    def shutdown(self) -> None: ...


class _Clock(SimulatedClock):
    """The world's time, for who waits for a set of TPDOs: the link wakes him."""

    def __init__(self, link: CanopenLink) -> None:
        super().__init__(link.world)
        self._link = link

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """See Clock.wait."""
        return self._link.wait_for(event.is_set, seconds)


class _Responses(deque[bytes]):
    """The queue of one SDO client, filled by the world."""

    def __init__(self, link: CanopenLink) -> None:
        super().__init__()
        self._link = link

    def put(self, response: bytes) -> None:
        self.append(response)
        self._link.wake()

    def empty(self) -> bool:
        self.clear()  # the library would put a queue of its own in this one's place
        return True

    def get(self, block: bool, timeout: float) -> bytes:
        if not self._link.wait_for(lambda: bool(self), timeout):
            raise queue.Empty
        return self.popleft()


class _Master(Master):
    """The product's, which opens the link's bus."""

    link: CanopenLink

    def open(self) -> None:
        """See Master.open."""
        link = self.link
        link.clock.sleep(0.005)
        if not link.reachable:
            raise LinkError(f"{self.where}: cannot be opened: refused")
        link.reconnected()
        self._listen(_Network(link, AllowedFrames(self._profile)))


class CanopenLink(SimulatedLink):
    """Six drives on a bus."""

    looks_again = True  # before the SYNC

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.up.jitter = self.down.jitter = 0.0
        self.generation = 0
        self.network: _Network | None = None
        self.refuses_frames = False
        self.silent: set[int] = set()  # COB-IDs that no frame leaves by
        self.lost_syncs = 0  # that no drive receives
        self._waiting: Process | None = None
        self._handed: deque[tuple[_Network, python_can.Message]] = deque()
        self._sent: dict[int, tuple[int, float]] = {}  # node -> Controlword, rad
        self._in_force: tuple[float, ...] = ()  # rad: of the last SYNC
        self._seen: dict[int, tuple[bool, float]] = {}  # node -> follows, rad
        self._seen_at = 0.0  # s: when all nodes' were whole last
        self._sampled_at: dict[int, float] = {}  # COB-ID -> s, of its last frame
        driver = self.setting.make_driver(canopen_driver, CanopenDriver, self.clock)
        self.profile: CanopenProfile = driver.profile
        self._share_dictionaries()
        units = zip(
            self.profile.counts_per_radian.tolist(), self.profile.zero.tolist(), strict=True
        )
        self._units = dict(zip(self.profile.nodes, units, strict=True))  # counts a radian, rad
        self.drives = SimulatedDrives(self.profile, self.controller, self._send)

    def _share_dictionaries(self) -> None:
        """Have all masters share the nodes' dictionaries, which nobody changes."""
        if not isinstance(self.profile.eds, _SharedEds):
            shared = cast(Any, _SharedEds(self.profile.eds))
            object.__setattr__(self.profile, "eds", shared)

    def driver(self) -> Driver:
        """See SimulatedLink.driver."""
        link = self
        found = self.setting.make_driver(canopen_driver, CanopenDriver, self.clock)
        found.master.__class__ = _Master
        found.master.link = self  # type: ignore[attr-defined]
        found.master.collector._clock = _Clock(self)
        read = found._read_state

        def read_state() -> RobotState:
            state = read()
            link._sampled[state.timestamp] = min(link._sampled_at.values())
            return state

        found._read_state = read_state  # type: ignore[method-assign]
        writer = cast(Any, found.sync_cycle)._writer
        complete_set = writer.complete_set

        def last_look(now: float) -> None:
            link.sends = True
            try:
                complete_set(now)
            except LinkError:
                link.sends = False
                raise

        writer.complete_set = last_look
        return found

    # -- the client waits -------------------------------------------------------------------------

    def wait_for(self, over: Callable[[], bool], timeout: float) -> bool:
        """Wait until something that has come makes it ``over``; return whether it is."""
        world = self.world
        until, process = world.now + timeout, world.current
        assert process is not None
        while not over():
            left = until - world.now
            if left <= 0.0:
                return False
            self._waiting = process
            process.sleep(left)
        return True

    def wake(self) -> None:
        """Have who waits look again."""
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            waiting.wake()

    # -- frames -----------------------------------------------------------------------------------

    def note(self, cob_id: int, data: bytes) -> None:
        """Report a frame that leaves the client; a SYNC makes the RPDOs before it a setpoint."""
        profile, base, node = self.profile, cob_id & 0x780, cob_id & 0x7F
        if cob_id == SYNC:
            self.sends = False
            self._seen.clear()
            sent, self._sent = self._sent, {}
            if len(sent) == profile.n and all(w == ENABLE_OPERATION for w, _ in sent.values()):
                q = tuple(sent[n][1] for n in profile.nodes)
                last, self._in_force = self._in_force, q
                late = self.world.now - self._seen_at > self.setting.bounds.fresh
                if not (late and q == last):  # that is said again, in a late setpoint's place
                    self.wrote("joints", q, "RPDOs")
                    return
        elif base == RPDO_BASE and node in self._units and len(data) == 6:
            word, counts = struct.unpack("<Hi", data)
            self._sent[node] = (word, self._angle(node, counts))
        elif cob_id == 0:
            self._sent.clear()
        elif base not in (0x600, 0x700) or node == 0:
            self.wrote("forbidden", (), f"{cob_id:#x}")
            return
        self.wrote("other", (), f"{cob_id:#x}")

    def _angle(self, node: int, counts: int) -> float:
        per_radian, zero = self._units[node]
        return counts / per_radian + zero

    def _on_up(self, message: tuple[int, bytes]) -> None:
        if self.world.now < self.rebooting_until or self.controller.stalled:
            return
        if message[0] == SYNC and self.lost_syncs > 0:
            self.lost_syncs -= 1
            return
        self.drives.take(*message, self.world.now)

    def _send(self, cob_id: int, data: bytes) -> None:
        if cob_id not in self.silent:
            self.down.send(BusFrame(cob_id, data, self.world.now))

    def _on_down(self, message: BusFrame) -> None:
        network = self.network
        if network is None:
            return
        cob_id, data, sampled = message
        if cob_id & 0x780 == TPDO_BASE:
            self._look(cob_id & 0x7F, data)
            self._sampled_at[cob_id] = sampled
        self._hand_over(network, cast(Any, Received(cob_id, data, self.world.now)))

    def _hand_over(self, network: _Network, frame: python_can.Message) -> None:
        self._handed.append((network, frame))
        if len(self._handed) == 1:
            self._receive()

    def _receive(self) -> None:
        """Take frames as the library's thread does: it waits where the loop stands in its lock."""
        while self._handed:
            network, frame = self._handed[0]
            listener = cast(Any, network.listeners[0])
            if network is self.network and listener._collector._lock.locked():
                self.world.after(LOOK, self._receive)
                return
            self._handed.popleft()
            if network is self.network:
                listener.on_message_received(frame)
                if listener._collector._over.is_set():
                    self.wake()

    def _look(self, node: int, data: bytes) -> None:
        """See what a checker sees of a TPDO: the joint, and whether its drive follows."""
        if node not in self._units or len(data) != 7:
            return
        word, counts, mode = struct.unpack("<Hib", data)
        follows = word & STATE_BITS == FOLLOWS and mode == CYCLIC
        self._seen[node] = (follows, self._angle(node, counts))
        if len(self._seen) == len(self._units):
            q = [self._seen[n][1] for n in self._units]
            self.see((math.nan, q, q, all(follows for follows, _ in self._seen.values())))
            self._seen.clear()
            self._seen_at = self.world.now

    # -- the drives -------------------------------------------------------------------------------

    def cycle(self) -> None:
        """Have the drives move their axes."""
        fresh = not (self.controller.frozen or self.freezes_values)
        self.drives.cycle(self.world.now, self.period, fresh)

    def publish(self) -> None:
        """Send nothing more: the drives have."""

    def disconnect(self) -> None:
        """See SimulatedLink.disconnect."""
        super().disconnect()
        self.generation += 1
        if self.network is not None:
            lost = python_can.CanOperationError("Connection reset by peer")
            cast(Any, self.network.notifier).exception = lost
        self.wake()

    def forget_client(self) -> None:
        """See SimulatedLink.forget_client."""
        super().forget_client()
        self.drives.boot()

    def heal(self) -> None:
        """See SimulatedLink.heal."""
        super().heal()
        self.silent.clear()
        self.refuses_frames, self.lost_syncs = False, 0

    def flood(self, seconds: float, each: int, frame: Callable[[], python_can.Message]) -> None:
        """Have so many frames of other nodes reach the client each millisecond."""
        until = self.world.now + seconds

        def send() -> None:
            for _ in range(each if self.network is not None else 0):
                self._hand_over(cast(_Network, self.network), frame())
            if self.world.now < until:
                self.world.after(1e-3, send)

        send()

    def enter_mode(self, draw: random.Random) -> str:
        """See SimulatedLink.enter_mode: one drive is in another mode or state."""
        found: str = draw.choice((_state_machine, _mode))(self, draw)
        return found

    def leave_mode(self) -> None:
        """See SimulatedLink.leave_mode: whoever changed a mode switches the drive off."""
        for drive in self.drives.drives:
            if drive.axis.holds and drive.axis.mode != self.profile.mode_number:
                drive.axis.machine.control(DISABLE_VOLTAGE)

    def foreign(self, seconds: float) -> None:
        """Have another master send SYNCs, for a while."""
        until = self.world.now + seconds

        def send() -> None:
            self.down.send(BusFrame(SYNC, b"", self.world.now))
            self.drives.take(SYNC, b"", self.world.now)
            if self.world.now < until:
                self.world.after(0.02, send)

        send()


class _SharedEds:
    """An EDS whose dictionaries are made once a node."""

    def __init__(self, eds: Any) -> None:
        self.path, self.has = eds.path, functools.cache(eds.has)
        self.dictionary = functools.cache(eds.dictionary)
        self.variable = functools.cache(eds.variable)


def spoiled(message: BusFrame, draw: Any) -> BusFrame:
    """Return a frame that is wrong in one way."""
    cob_id, data, sampled = message
    kind = draw.randrange(3)
    if kind == 0:
        return BusFrame(cob_id, data[: draw.randrange(len(data))] if data else data, sampled)
    if kind == 1:
        return BusFrame(draw.choice((0x181, 0x186, 0x581, 0x701, 0x081)), data, sampled)
    if not data:  # a SYNC
        return message
    at = draw.randrange(len(data))
    changed = data[:at] + bytes([data[at] ^ (1 << draw.randrange(8))]) + data[at + 1 :]
    return BusFrame(cob_id, changed, sampled)


# -- what goes wrong on this link only ----------------------------------------------------------


def _drive_fault(link: CanopenLink, draw: Any) -> str:
    drive, code = draw.choice(link.drives.drives), draw.choice((0x2310, 0x3220, 0x7305, 0x8611))
    drive.fail(code)
    return f"node {drive.node}, {code:#x}"


def _emergency_message(link: CanopenLink, draw: Any) -> str:
    drive, code = draw.choice(link.drives.drives), draw.choice((0x0000, 0x4210, 0x8120))
    drive.emergency(code)
    return f"node {drive.node}, {code:#x}"


def _state_machine(link: CanopenLink, draw: Any) -> str:
    drive, word = draw.choice(link.drives.drives), draw.choice((0x00, 0x02, 0x06, 0x07))
    drive.axis.machine.control(word)
    return f"node {drive.node}, as by Controlword {word:#x}"


def _mode(link: CanopenLink, draw: Any) -> str:
    drive, mode = draw.choice(link.drives.drives), draw.choice((0, 1, 7))
    drive.axis.set_mode(mode)
    return f"node {drive.node}, {mode}"


def _nmt(link: CanopenLink, draw: Any) -> str:
    drive = draw.choice(link.drives.drives)
    drive.nmt = draw.choice((4, 127))
    seconds = draw.choice((0.05, 0.5, 5.0))
    link.world.after(seconds, lambda: setattr(drive, "nmt", OPERATIONAL))
    return f"node {drive.node}, for {seconds:g} s"


def _node_restart(link: CanopenLink, draw: Any) -> str:
    joint = draw.randrange(len(link.drives.drives))
    drive = link.drives.drives[joint]
    drive.boot(link.controller.q[joint])
    return f"node {drive.node}"


def _withheld(link: CanopenLink, draw: Any) -> str:
    """Have a node send no TPDO, no heartbeat, no SDO response, or nothing at all."""
    node = draw.choice(link.drives.drives).node
    bases = draw.choice(((0x180,), (0x700,), (0x580,), (0x080, 0x180, 0x580, 0x700)))
    withheld, seconds = {base + node for base in bases}, draw.choice((0.008, 0.05, 0.4, 2.0))
    link.silent |= withheld
    link.world.after(seconds, lambda: link.silent.difference_update(withheld))
    return f"{', '.join(f'{base + node:#x}' for base in bases)} for {seconds:g} s"


def _lost_syncs(link: CanopenLink, draw: Any) -> str:
    link.lost_syncs = draw.choice((1, 2, 5, 30, 200))
    return f"{link.lost_syncs}"


FAMILIES: tuple[tuple[str, Callable[[CanopenLink, Any], str]], ...] = (
    ("drive fault", _drive_fault),
    ("emergency message", _emergency_message),
    ("drive leaves its state", _state_machine),
    ("mode of operation changed", _mode),
    ("NMT state changed", _nmt),
    ("node restarts", _node_restart),
    ("node's frames withheld", _withheld),
    ("SYNCs lost", _lost_syncs),
)
