"""Modbus TCP as bytes, with the register map of a UR controller and our mailbox in it.

Source: Modbus application protocol V1.1b3; the registers as docs/porting.md has them.
"""

from __future__ import annotations

import math
import struct

from benchmarks.faults.wire.seen import Change, Decoder, Fresh, Write

READS, WRITES = (3, 4), (5, 6, 15, 16, 22, 23)
MAILBOX, WORDS = 234, 11  # sequence, six counts, heartbeat, two rates, checksum
COUNT = 1e-6  # m and rad
ECHO = range(248, 254)  # the offset that the robot's program applies
GOOD = {258: 7, 260: 1, 261: 0, 262: 0}  # mode running, power on, no stop, no emergency


class ModbusDecoder(Decoder):
    """A UR controller's Modbus server, read in blocks and written through the mailbox."""

    def __init__(self) -> None:
        self._asked: dict[tuple[int, int], tuple[int, int, int]] = {}
        self._registers: dict[int, int] = {}
        self._block = (0, 0)  # address and count of the block with the joints

    def feed(
        self, time: float, connection: int, port: str, up: bool, message: bytes, state: int
    ) -> list[Fresh | Write]:
        """See Decoder.feed."""
        if len(message) < 8:
            return []
        key = (connection, int.from_bytes(message[:2], "big"))
        function, body = message[7], message[8:]
        if not up:
            return self._answer(time, key, function, body, state)
        found: list[Fresh | Write] = []
        if function in READS or function == 23:
            address, count = struct.unpack_from(">HH", body)
            self._asked[key] = (function, address, count)
        if function in WRITES:
            found.append(self._written(time, function, body, state))
        return found

    def _answer(
        self, time: float, key: tuple[int, int], function: int, body: bytes, state: int
    ) -> list[Fresh | Write]:
        asked = self._asked.pop(key, None)
        if asked is None or asked[0] != function or not body or body[0] != 2 * asked[2]:
            return []
        _, address, count = asked
        if len(body) < 1 + 2 * count:
            return []
        words = struct.unpack_from(f">{count}H", body, 1)
        self._registers.update(zip(range(address, address + count), words, strict=True))
        if not address <= 270 < address + count:
            return []
        self._block = (address, count)
        get = self._registers.get
        turns = [_signed(get(320 + i, 0)) for i in range(6)]
        q = tuple(get(270 + i, 0) * 1e-3 + 2 * math.pi * turns[i] for i in range(6))
        known = all(register in self._registers for register in GOOD)
        safe = all(get(register) == value for register, value in GOOD.items())
        bare = all(get(register) == 0 for register in ECHO)
        return [Fresh(time, math.nan, q, None, safe, known, state, bare=bare)]

    def patch(self, message: bytes, what: str, change: Change) -> bytes:
        """See Decoder.patch: whole milliradians, of one turn; there is no clock."""
        address, count = self._block
        first = {"q": 270, "qd": 280}[what]
        if message[7:9] not in (bytes((3, 2 * count)), bytes((23, 2 * count))) or not count:
            return message
        data, at = bytearray(message), 9 + 2 * (first - address)
        words = [_signed(word) * 1e-3 for word in struct.unpack_from(">6H", data, at)]
        changed = [round(v * 1e3) & 0xFFFF for v in change(words)]
        struct.pack_into(">6H", data, at, *changed)
        return bytes(data)

    def _written(self, time: float, function: int, body: bytes, state: int) -> Write:
        at = 4 if function == 23 else 0
        if function not in (16, 23):
            return Write(time, "forbidden", (), f"function {function}", state)
        address, count, size = struct.unpack_from(">HHB", body, at)
        if (address, count, size) != (MAILBOX, WORDS, 2 * WORDS) or len(body) < at + 5 + size:
            return Write(time, "forbidden", (), f"registers {address}, {count}", state)
        words = list(struct.unpack_from(f">{count}H", body, at + 5))
        kind = "offset" if _checksum(words[:-1]) == words[-1] else "broken"
        values = tuple(_signed(word) * COUNT for word in words[1:7])
        return Write(time, kind, values, "mailbox", state)  # type: ignore[arg-type]


def _signed(word: int) -> int:
    return word - 0x10000 if word & 0x8000 else word


def _checksum(words: list[int]) -> int:
    """Return the mailbox's checksum (docs/porting.md)."""
    return (18242 + sum(k * word for k, word in enumerate(words, 1))) % 65521
