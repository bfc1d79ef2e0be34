"""Simulated CiA 402 drives for many runs: frames in, frames out, the time given.

State machine and axis are the simulated controller's; its object dictionary and its SDO server are
the canopen library's, which would take most of a run's time: here is the part that we use.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from gapbridge.drivers.canopen.objects import MODE_ACTIVE, Address
from gapbridge.drivers.canopen.pdo import PdoLayout
from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.simulated.canopen.axis import Axis, follow_stops, move_axes
from gapbridge.drivers.simulated.canopen.server import HEARTBEAT_ERROR as MASTER_LOST
from gapbridge.drivers.simulated.server.arm_controller import ArmController

PRE_OPERATIONAL, OPERATIONAL, STOPPED = 127, 5, 4  # NMT
NMT_STATES = {1: OPERATIONAL, 2: STOPPED, 128: PRE_OPERATIONAL}
EMCY, SDO_RESPONSE, HEARTBEAT = 0x080, 0x580, 0x700
NO_OBJECT, BAD_VALUE = 0x06020000, 0x06090030  # SDO aborts
UPLOAD, DOWNLOAD = 2, 1  # SDO client command specifiers
MODES = (0, 7, 8)
GENERIC, COMMUNICATION = 0x01, 0x10  # error register
Send = Callable[[int, bytes], None]


class SimulatedDrive:
    """One node, its PDOs fixed."""

    def __init__(self, profile: CanopenProfile, joint: int, q: float, send: Send) -> None:
        self.node, self._profile, self._send = profile.nodes[joint], profile, send
        self._per_radian = float(profile.counts_per_radian[joint])
        self._zero = float(profile.zero[joint])
        self._layouts = {layout.cob_id(self.node): layout for layout in profile.rpdo}
        self._tpdos = [(layout.cob_id(self.node), layout) for layout in profile.tpdo]
        self.boot(q)

    def boot(self, q: float) -> None:
        """Start anew at ``q``, rad."""
        self.q, self.axis = q, Axis(q)
        self.nmt = PRE_OPERATIONAL
        self._received: list[dict[str, int]] = []
        self._watched_at: float | None = None  # s: of the master's last heartbeat
        self._beaten = -1.0
        self.objects: dict[tuple[int, int], int] = {
            (0x1000, 0): 0x00020192, (0x6502, 0): 0b1100_0000, (0x1006, 0): 0, (0x1016, 1): 0,
            (0x1017, 0): 0, (0x6007, 0): 0, (0x60C2, 1): 10, (0x60C2, 2): -3,
        }  # fmt: skip
        for base, layouts in ((0x1400, self._profile.rpdo), (0x1800, self._profile.tpdo)):
            for layout in layouts:
                self._lay_out(base + layout.number - 1, layout)
        self._send(HEARTBEAT + self.node, b"\0")

    def _lay_out(self, index: int, layout: PdoLayout) -> None:
        self.objects |= {(index, 1): layout.cob_id(self.node), (index, 2): 1}
        self.objects[index + 0x200, 0] = len(layout.entries)
        for i, entry in enumerate(layout.entries, 1):
            address = entry.address
            mapped = address.index << 16 | address.subindex << 8 | entry.bits
            self.objects[index + 0x200, i] = mapped

    def command(self, state: int) -> None:
        """Take an NMT command; PDOs of before do not count any more."""
        self.nmt, self._received = state, []

    # -- objects ----------------------------------------------------------------------------------

    def answer(self, request: bytes) -> None:
        """Answer one SDO request: expedited transfers only."""
        if len(request) != 8:
            return
        command, index, subindex = struct.unpack_from("<BHB", request)
        address = request[1:4]
        if command >> 5 == UPLOAD:
            value = self._value(index, subindex)
            variable = self._profile.eds.variable(Address(index, subindex))
            if value is None or variable is None:
                self._abort(address, NO_OBJECT)
                return
            size = variable.bits // 8
            data = (value & (1 << variable.bits) - 1).to_bytes(4, "little")
            self._respond(bytes([0x43 | 4 - size << 2]) + address + data)
        elif command >> 5 == DOWNLOAD and command & 2:
            data = request[4 : 8 - (command >> 2 & 3)]
            value = int.from_bytes(data, "little", signed=index in (0x6007, 0x6060, 0x60C2))
            self._write(index, subindex, value, address)

    def _value(self, index: int, subindex: int) -> int | None:
        if (index, subindex) == (0x6060, 0):
            return self.axis.mode
        return self.objects.get((index, subindex))

    def _write(self, index: int, subindex: int, value: int, address: bytes) -> None:
        if index == 0x6060:
            if value not in MODES:
                self._abort(address, BAD_VALUE)
                return
            self.axis.set_mode(value)
        elif (index, subindex) not in self.objects:
            self._abort(address, NO_OBJECT)
            return
        else:
            self.objects[index, subindex] = value
            if index == 0x1016:
                self._watched_at = None  # watching begins with the first heartbeat
        self._respond(b"\x60" + address + bytes(4))

    def _abort(self, address: bytes, code: int) -> None:
        self._respond(b"\x80" + address + code.to_bytes(4, "little"))

    def _respond(self, data: bytes) -> None:
        self._send(SDO_RESPONSE + self.node, data)

    # -- PDOs -------------------------------------------------------------------------------------

    def receive(self, cob_id: int, data: bytes) -> None:
        """Keep an RPDO until the next SYNC."""
        layout = self._layouts.get(cob_id)
        if layout is None or self.nmt != OPERATIONAL:
            return
        try:
            self._received.append(layout.decode(data))
        except ValueError:
            self.emergency(0x8210, COMMUNICATION)  # PDO not processed due to length error

    def sample(self) -> None:
        """Send the TPDOs of a SYNC."""
        axis = self.axis
        counts = {
            "Statusword": axis.machine.statusword | (MODE_ACTIVE if axis.active else 0),
            "Position actual value": round((self.q - self._zero) * self._per_radian),
            "Modes of operation display": axis.mode,
        }
        for cob_id, layout in self._tpdos:
            self._send(cob_id, layout.encode(counts))

    def take_setpoints(self) -> None:
        """Have what came before a SYNC count."""
        received, self._received = self._received, []
        for counts in received:
            self.axis.machine.control(counts["Controlword"])
            angle = counts["Target position"] / self._per_radian + self._zero
            if not self.axis.setpoint(angle):
                self.fail(0x8611)  # following error

    # -- time -------------------------------------------------------------------------------------

    def fail(self, code: int, register: int = GENERIC) -> None:
        """Go to FAULT and report it by EMCY."""
        self.axis.machine.fault()
        self.emergency(code, register)

    def emergency(self, code: int, register: int = GENERIC) -> None:
        """Report an error by EMCY."""
        self._send(EMCY + self.node, struct.pack("<HB5x", code, register))

    def watch(self, now: float) -> None:
        """Note the master's heartbeat."""
        self._watched_at = now

    def cycle(self, now: float) -> None:
        """Watch the master's heartbeat, and send one's own."""
        wait = 1e-3 * (self.objects[0x1016, 1] & 0xFFFF)
        if wait and self._watched_at is not None and now - self._watched_at > wait:
            self._watched_at = None
            self.emergency(MASTER_LOST, COMMUNICATION)
            if self.objects[0x6007, 0] == 3:
                self.axis.machine.control(0x02)  # quick stop
        period = 1e-3 * self.objects[0x1017, 0]
        if period and now - self._beaten >= period:
            self._beaten = now
            self._send(HEARTBEAT + self.node, bytes([self.nmt]))


class SimulatedDrives:
    """The drives of one arm."""

    def __init__(self, profile: CanopenProfile, controller: ArmController, send: Send) -> None:
        self._controller = controller
        self._was_able = True
        self._our_node = profile.heartbeat.our_node
        self.drives = [
            SimulatedDrive(profile, joint, q, send) for joint, q in enumerate(controller.q)
        ]
        self._by_node = {drive.node: drive for drive in self.drives}

    def boot(self) -> None:
        """Start all drives anew."""
        for drive, q in zip(self.drives, self._controller.q, strict=True):
            drive.boot(q)

    def take(self, cob_id: int, data: bytes, now: float) -> None:
        """Take a frame of the bus."""
        if cob_id == 0x080:
            self._sync()
        elif cob_id == 0:
            if len(data) == 2 and data[1] in self._by_node and data[0] in NMT_STATES:
                self._by_node[data[1]].command(NMT_STATES[data[0]])
        elif cob_id == HEARTBEAT + self._our_node:
            for drive in self.drives:
                drive.watch(now)
        elif cob_id & 0x7F in self._by_node:
            drive = self._by_node[cob_id & 0x7F]
            if cob_id & 0x780 == 0x600:
                drive.answer(data)
            else:
                drive.receive(cob_id, data)

    def _sync(self) -> None:
        able = [drive for drive in self.drives if drive.nmt == OPERATIONAL]
        for drive in able:
            drive.sample()
        for drive in able:
            drive.take_setpoints()

    def cycle(self, now: float, period: float, fresh: bool) -> None:
        """Follow stops, move the axes, measure where ``fresh``, send heartbeats."""
        controller = self._controller
        self._was_able = follow_stops(controller, self.drives, self._was_able)
        move_axes(controller, period, ((drive.axis, period) for drive in self.drives))
        for drive, q in zip(self.drives, controller.q, strict=True):
            if fresh:
                drive.q = q
            drive.cycle(now)
