"""Frames of a PiPER in the socketcand protocol's text.

Source: the protocol's description in socketcand; frames as piper_sdk names them (big-endian, 0.001
degrees).
"""

from __future__ import annotations

import math
import struct

from benchmarks.faults.wire.seen import Change, Decoder, Fresh, Write

UNIT = math.radians(0.001)
FEEDBACK = {0x2A5: 0, 0x2A6: 2, 0x2A7: 4}
TARGETS = {0x155: 0, 0x156: 2, 0x157: 4}
STATUS, STOP, MODE, MOTORS = 0x2A1, 0x150, 0x151, 0x471


class PiperDecoder(Decoder):
    """A PiPER on a bus that goes through a socket."""

    def __init__(self) -> None:
        self._read: dict[int, float] = {}
        self._written: dict[int, float] = {}
        self._safe, self._known = False, False

    def feed(
        self, time: float, connection: int, port: str, up: bool, message: bytes, state: int
    ) -> list[Fresh | Write]:
        """See Decoder.feed."""
        words = message.decode("ascii", "replace").strip("<> ").split()
        try:
            if up and words[:1] == ["send"]:
                data = bytes(int(byte, 16) for byte in words[3:])
                return self._sent(time, int(words[1], 16), data, state)
            if not up and words[:1] == ["frame"]:
                return self._came(time, int(words[1], 16), bytes.fromhex("".join(words[3:])), state)
        except (ValueError, IndexError):
            return [Write(time, "broken", (), "text", state)] if up else []
        return []

    def _came(self, time: float, identifier: int, data: bytes, state: int) -> list[Fresh | Write]:
        if len(data) != 8:
            return []
        if identifier == STATUS:
            self._safe, self._known = data[1] == 0 and data[6] == 0, True
        if identifier not in FEEDBACK:
            return []
        if identifier == 0x2A5:
            self._read = {}
        for i, value in enumerate(struct.unpack(">ii", data), FEEDBACK[identifier]):
            self._read[i] = value * UNIT
        if identifier != 0x2A7 or len(self._read) < 6:
            return []
        q = tuple(self._read[i] for i in range(6))
        return [Fresh(time, math.nan, q, None, self._safe, self._known, state)]

    def _sent(self, time: float, identifier: int, data: bytes, state: int) -> list[Fresh | Write]:
        where = f"{identifier:#x}"
        if identifier in (STOP, MODE, MOTORS):
            return [Write(time, "other", (), where, state)]
        if identifier not in TARGETS or len(data) != 8:
            return [Write(time, "forbidden", (), where, state)]
        if identifier == 0x155:
            self._written = {}
        for i, value in enumerate(struct.unpack(">ii", data), TARGETS[identifier]):
            self._written[i] = value * UNIT
        if identifier != 0x157:
            return [Write(time, "other", (), where, state)]
        if len(self._written) < 6:
            return [Write(time, "broken", (), where, state)]
        q = tuple(self._written[i] for i in range(6))
        return [Write(time, "joints", q, where, state)]

    def patch(self, message: bytes, what: str, change: Change) -> bytes:
        """See Decoder.patch: two joints a frame, one motor's speed a frame; there is no clock."""
        words = message.decode("ascii", "replace").strip("<> ").split()
        if words[:1] != ["frame"] or len(words) < 4:
            return message
        identifier, data = int(words[1], 16), bytearray.fromhex("".join(words[3:]))
        if what == "q" and identifier in FEEDBACK:
            first = FEEDBACK[identifier]
            q = [0.0] * 6
            q[first : first + 2] = [v * UNIT for v in struct.unpack(">ii", data)]
            changed = change(q)[first : first + 2]
            struct.pack_into(">ii", data, 0, *(round(v / UNIT) for v in changed))
        elif what == "qd" and 0x251 <= identifier <= 0x256:
            speed = change([0.0] * 6)[identifier - 0x251]
            struct.pack_into(">h", data, 0, round(speed * 1e3))
        else:
            return message
        return f"< frame {words[1]} {words[2]} {data.hex().upper()} >".encode()
