"""One simulated drive: an object dictionary with the objects of CiA 301 and CiA 402.

The canopen library's LocalNode is its SDO server and EMCY producer; PDOs, SYNC, heartbeats and the
state machine are written here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import canopen
from canopen.nmt import NmtSlave

from gapbridge.drivers.simulated.canopen.axis import Axis

READ_ONLY_NOW, NOT_MAPPABLE, TOO_LONG, BAD_VALUE = 0x08000022, 0x06040041, 0x06040042, 0x06090030
MODES = (0, 7, 8)
INVALID = 1 << 31  # of a PDO's COB-ID
LAST = 0x7FFFFFFF  # of an INTEGER32
COMMUNICATION = 0x10  # error register


@dataclass(frozen=True, slots=True)
class Mapping:
    """One PDO's mapping in the object dictionary."""

    cob_id: int
    synchronous: bool
    objects: tuple[tuple[int, int, int], ...]  # index, subindex, bits


@dataclass(frozen=True, slots=True)
class Units:
    """Counts of one joint."""

    per_radian: float  # position counts, with the sign
    zero: float  # rad at count 0
    speed: float  # velocity counts in a position count per s
    per_newton_metre: float  # torque counts, with the sign


class _Nmt(NmtSlave):
    """The library's NMT slave; the server sends the heartbeats, here only their period is set."""

    period = 0.0  # s

    def start_heartbeat(self, heartbeat_time_ms: int) -> None:
        self.period = 1e-3 * heartbeat_time_ms

    def stop_heartbeat(self) -> None:
        self.period = 0.0

    def update_heartbeat(self) -> None:
        pass


class Drive(canopen.LocalNode):
    """One node. All methods are called under the server's lock."""

    def __init__(self, node: int, dictionary: Any, units: Units, q: float) -> None:
        super().__init__(node, dictionary)
        self.node = node
        self._write_callbacks.clear()
        self.nmt: Any = _Nmt(node, self)
        self.units, self.axis = units, Axis(q)
        self.q, self.qd, self.torque = q, 0.0, 0.0  # of the plant, rad, rad/s, Nm
        self.error_code = 0
        self.watched: dict[int, float] = {}  # node id -> s of its last heartbeat
        self._limits = (-LAST, LAST)
        self._received: dict[int, bytes] = {}  # RPDO's COB-ID -> data until a SYNC
        self._mappings: dict[int, Mapping | None] = {}
        self.add_read_callback(self._live)  # type: ignore[no-untyped-call]
        self.add_write_callback(self.nmt.on_write)  # type: ignore[no-untyped-call]
        self.add_write_callback(self._written)  # type: ignore[no-untyped-call]

    def boot(self, q: float, low: float, high: float) -> None:
        """Restart at ``q`` with the EDS's defaults and the joint's limits (rad)."""
        self.data_store.clear()
        self._mappings.clear()
        self._received.clear()
        self.watched.clear()
        ends = sorted((self.counts(low), self.counts(high)))
        self._limits = (ends[0], ends[1])
        self.q, self.axis = q, Axis(q)
        self.error_code = 0
        self.nmt.state = "INITIALISING"  # the library sends the boot-up message
        self.nmt.state = "PRE-OPERATIONAL"

    @property
    def operational(self) -> bool:
        """Return whether PDOs are exchanged."""
        return bool(self.nmt.state == "OPERATIONAL")

    def counts(self, q: float) -> int:
        """Return position counts of an angle, rad."""
        return _fit((q - self.units.zero) * self.units.per_radian)

    # -- the object dictionary --------------------------------------------------------------------

    def number(self, index: int, subindex: int = 0) -> int:
        """Return an object's value."""
        entry = self._find_object(index, subindex)  # type: ignore[no-untyped-call]
        return int(entry.decode_raw(self.get_data(index, subindex)))

    def _live(self, index: int, subindex: int, od: Any) -> int | None:
        """Return the present value of an object that the drive updates; None: another object."""
        axis, units = self.axis, self.units
        match index, subindex:
            case 0x6041, 0:
                return axis.machine.statusword | (0x1000 if axis.active else 0)
            case 0x6061, 0:
                return axis.mode
            case 0x6062, 0:
                return self.counts(axis.demand)
            case 0x6064, 0:
                return self.counts(self.q)
            case 0x606C, 0:
                return _fit(self.qd * units.per_radian * units.speed)
            case 0x6077, 0:
                return max(-32768, min(32767, round(self.torque * units.per_newton_metre)))
            case 0x603F, 0:
                return self.error_code
            case 0x607D, 1 | 2:
                return self._limits[subindex - 1]
        return None

    def _written(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        """Check and execute a master's write. Raises SdoAbortedError."""
        value = (
            int(od.decode_raw(data))
            if od.data_type in canopen.objectdictionary.INTEGER_TYPES
            else 0
        )
        if 0x1400 <= index <= 0x1BFF:
            self._check_mapping(index, subindex, value)
            self._mappings.clear()
        elif index == 0x6040:
            if self.axis.machine.control(value):
                self.error_code = 0
                self.emcy.reset()
        elif index == 0x6060:
            if value not in MODES:
                raise canopen.SdoAbortedError(BAD_VALUE)
            self.axis.set_mode(value)
        elif index == 0x605A:
            self.axis.machine.set_quick_stop_option(value)
        elif index == 0x1016 and subindex == 1:
            self.watched.clear()  # watching begins with the first heartbeat

    def _check_mapping(self, index: int, subindex: int, value: int) -> None:
        if index & 0xFE00 not in (0x1600, 0x1A00):
            return  # communication parameters
        enabled = not self.number(index - 0x200, 1) & INVALID
        if enabled or (subindex and self.number(index)):
            raise canopen.SdoAbortedError(READ_ONLY_NOW)
        if subindex:
            return
        bits = 0
        for entry in range(1, value + 1):
            mapped = self.number(index, entry)
            try:
                variable = self._find_object(mapped >> 16, mapped >> 8 & 0xFF)  # type: ignore[no-untyped-call]
            except canopen.SdoAbortedError:
                raise canopen.SdoAbortedError(NOT_MAPPABLE) from None
            if not variable.pdo_mappable or len(variable) != mapped & 0xFF:
                raise canopen.SdoAbortedError(NOT_MAPPABLE)
            bits += mapped & 0xFF
        if bits > 64:
            raise canopen.SdoAbortedError(TOO_LONG)

    # -- PDOs -------------------------------------------------------------------------------------

    def _mapping(self, index: int) -> Mapping | None:
        """Return the PDO whose communication parameters are at ``index``; None: it is off."""
        if index not in self._mappings:
            cob_id = self.number(index, 1)
            count = self.number(index + 0x200)
            entries = [self.number(index + 0x200, i) for i in range(1, count + 1)]
            objects = tuple((e >> 16, e >> 8 & 0xFF, e & 0xFF) for e in entries)
            synchronous = self.number(index, 2) <= 240
            mapping = Mapping(cob_id & 0x7FF, synchronous, objects)
            self._mappings[index] = None if cob_id & INVALID or not count else mapping
        return self._mappings[index]

    def receive(self, cob_id: int, data: bytes) -> None:
        """Store a frame if it is one of our RPDOs."""
        for index in range(0x1400, 0x1404):
            mapping = self._mapping(index)
            if mapping is None or mapping.cob_id != cob_id:
                continue
            if len(data) < sum(bits for *_, bits in mapping.objects) // 8:
                self.emcy.send(0x8210, COMMUNICATION)  # PDO not processed due to length error
            elif mapping.synchronous:
                self._received[index] = data
            else:
                self._act(mapping, data)

    def _act(self, mapping: Mapping, data: bytes) -> None:
        whole = int.from_bytes(data, "little")
        for index, subindex, bits in mapping.objects:
            part = (whole & ((1 << bits) - 1)).to_bytes(bits // 8, "little")
            whole >>= bits
            self.set_data(index, subindex, part)

    def take_setpoints(self) -> bool:
        """Apply the RPDOs received before this SYNC; returns False if they cannot be followed."""
        for index, data in self._received.items():
            mapping = self._mapping(index)
            if mapping is not None:
                self._act(mapping, data)
        fresh = bool(self._received)
        self._received.clear()
        if not fresh:
            return True
        counts = self.number(0x60C1, 1) if self.axis.mode == 7 else self.number(0x607A)
        return self.axis.setpoint(counts / self.units.per_radian + self.units.zero)

    def measure(self, q: float, qd: float, torque: float) -> None:
        """Store the plant's joint: rad, rad/s, Nm."""
        self.q, self.qd, self.torque = q, qd, torque

    def samples_off_by(self, angle: float) -> list[tuple[int, bytes]]:
        """Return the frames of a joint that is ``angle`` (rad) further."""
        here, self.q = self.q, self.q + angle
        frames = self.samples()
        self.q = here
        return frames

    def samples(self) -> list[tuple[int, bytes]]:
        """Return the present frames of all synchronous TPDOs."""
        frames = []
        for index in range(0x1800, 0x1804):
            mapping = self._mapping(index)
            if mapping is not None and mapping.synchronous:
                parts = [self.get_data(i, s) for i, s, _ in mapping.objects]
                frames.append((mapping.cob_id, b"".join(parts)))
        return frames

    def fail(self, code: int, register: int = 1) -> None:
        """Go to FAULT with an error code, and report it by EMCY."""
        self.error_code = code
        self.axis.machine.fault()
        self.emcy.send(code, register)

    @property
    def interpolation_period(self) -> float:
        """Return the time between two setpoints, s."""
        return float(self.number(0x60C2, 1) * 10.0 ** self.number(0x60C2, 2))


def _fit(value: float) -> int:
    """Return a value rounded and clipped to INTEGER32."""
    return max(-LAST - 1, min(LAST, round(value))) if math.isfinite(value) else 0
