"""RTDE as bytes: recipes, data packages, what ur_rtde's control script and our registers mean.

Source: Universal Robots, 'Real-Time Data Exchange (RTDE) Guide'; the register use of ur_rtde's
script as measured. Big-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

from benchmarks.faults.wire.seen import Change, Decoder, Fresh, Numbers, Write

SIZES = {
    "DOUBLE": "d", "VECTOR3D": "3d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT64": "Q",
    "UINT8": "B", "BOOL": "?", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip
SERVOJ, SERVO_STOP, STOP_SCRIPT = 11, 16, 255
HARMLESS = {0, 35, SERVO_STOP, STOP_SCRIPT}  # nothing, setWatchdog, servoStop, stopScript
FIELDS = {"q": "actual_q", "qd": "actual_qd", "clock": "timestamp"}
RUNNING, SAFE = 7, (1, 2)
SEQUENCE, RATES = "input_int_register_19", "input_int_register_22"
UNIT, MODULUS = 1e-9, 2**31
OTHER = 1.0  # s that connections of one controller may lie apart; a clock begins anew by more
LIBRARY = "23"  # the register in which ur_rtde says what kind of register it has written


@dataclass
class Session:
    """The recipes of one connection."""

    outputs: list[str] = field(default_factory=list)
    layout: dict[str, tuple[int, struct.Struct]] = field(default_factory=dict)
    size: int = 0  # bytes of one data package
    asked: list[list[str]] = field(default_factory=list)  # inputs whose answer is awaited
    inputs: dict[int, tuple[list[str], struct.Struct, list[int]]] = field(default_factory=dict)


class RtdeDecoder(Decoder):
    """A UR link, in servoj or in offset mode."""

    def __init__(self, servoj: bool) -> None:
        self._servoj = servoj
        self._sessions: dict[int, Session] = {}
        self._registers: dict[str, float] = {}
        self._stamp = -1.0

    def feed(
        self, time: float, connection: int, port: str, up: bool, message: bytes, state: int
    ) -> list[Fresh | Write]:
        """See Decoder.feed."""
        if port != "rtde":
            return self._beside(time, port, up, message, state)
        if len(message) < 3:
            return []
        session = self._sessions.setdefault(connection, Session())
        kind, body = chr(message[2]), message[3:]
        if up:
            if kind == "U":
                return self._written(time, session, body, state)
            self._asked(session, kind, body)
            return []
        if kind == "U":
            return self._read(time, session, body, state)
        self._answered(session, kind, body)
        return []

    def _beside(
        self, time: float, port: str, up: bool, message: bytes, state: int
    ) -> list[Fresh | Write]:
        """Judge an upload: the library's own script in servoj mode, and none otherwise."""
        if not up or port != "script":
            return []
        fine = self._servoj
        return [Write(time, "other" if fine else "forbidden", (), "script", state)]

    # -- recipes ----------------------------------------------------------------------------------

    @staticmethod
    def _asked(session: Session, kind: str, body: bytes) -> None:
        if kind == "O":
            session.outputs = body[8:].decode("ascii", "replace").strip(",").split(",")
        elif kind == "I":
            session.asked.append(body.decode("ascii", "replace").strip(",").split(","))

    @staticmethod
    def _answered(session: Session, kind: str, body: bytes) -> None:
        types = body[1:].decode("ascii", "replace").strip(",").split(",") if body else []
        if kind == "O":
            at, layout = 1, {}
            for name, wire_type in zip(session.outputs, types, strict=False):
                form = struct.Struct(">" + SIZES.get(wire_type, "0s"))
                layout[name] = (at, form)
                at += form.size
            session.layout, session.size = layout, 3 + at
        elif kind == "I" and session.asked:
            names = session.asked.pop(0)
            forms = [SIZES.get(wire_type, "0s") for wire_type in types]
            counts = [int(form[:-1] or 1) if len(form) > 1 else 1 for form in forms]
            session.inputs[body[0]] = (names, struct.Struct(">" + "".join(forms)), counts)

    def patch(self, message: bytes, what: str, change: Change) -> bytes:
        """See Decoder.patch."""
        name = FIELDS[what]
        for session in tuple(self._sessions.values()):
            if message[2:3] != b"U" or len(message) != session.size or name not in session.layout:
                continue
            at, form = session.layout[name]
            data = bytearray(message)
            form.pack_into(data, 3 + at, *change(list(form.unpack_from(data, 3 + at))))
            return bytes(data)
        return message

    # -- data -------------------------------------------------------------------------------------

    def _read(self, time: float, session: Session, body: bytes, state: int) -> list[Fresh | Write]:
        if "actual_q" not in session.layout or "timestamp" not in session.layout:
            return []
        found: dict[str, Numbers] = {}
        for name in ("timestamp", "actual_q", "target_q", "robot_mode", "safety_mode"):
            if name in session.layout:
                at, form = session.layout[name]
                if at + form.size > len(body):
                    return []
                found[name] = form.unpack_from(body, at)
        stamp = found["timestamp"][0]
        if self._stamp - OTHER < stamp <= self._stamp:
            return []  # seen on another connection
        self._stamp = stamp
        known = "robot_mode" in found and "safety_mode" in found
        safe = known and found["robot_mode"][0] == RUNNING and found["safety_mode"][0] in SAFE
        q, target_q = found["actual_q"], found.get("target_q")
        return [Fresh(time, stamp, q, target_q, safe, known, state)]

    def _written(
        self, time: float, session: Session, body: bytes, state: int
    ) -> list[Fresh | Write]:
        recipe = session.inputs.get(body[0])
        if recipe is None:
            return [Write(time, "forbidden", (), f"recipe {body[0]}", state)]
        names, form, counts = recipe
        values = self._values(names, form, counts, body[1:])
        self._registers.update({k: v for k, v in values.items() if isinstance(v, float | int)})
        if self._servoj:
            return self._command(time, values, state)
        strange = [n for n in values if not _ours(n)]
        if strange:
            return [Write(time, "forbidden", (), strange[0], state)]
        if SEQUENCE in values:
            return [self._offset(time, state)]
        return [Write(time, "other", (), names[0], state)]

    @staticmethod
    def _values(
        names: list[str], form: struct.Struct, counts: list[int], body: bytes
    ) -> dict[str, Any]:
        if len(body) < form.size:  # ur_rtde is known to send packages shorter than their recipe
            body = body + bytes(form.size - len(body))
        flat = form.unpack_from(body)
        found, at = {}, 0
        for name, count in zip(names, counts, strict=False):
            found[name] = flat[at] if count == 1 else flat[at : at + count]
            at += count
        return found

    def _command(self, time: float, values: dict[str, Any], state: int) -> list[Fresh | Write]:
        code = int(values.get("input_int_register_0", 0))
        if code == SERVOJ:
            q = tuple(float(values[f"input_double_register_{i}"]) for i in range(6))
            return [Write(time, "joints", q, "servoJ", state)]
        if code in (SERVO_STOP, STOP_SCRIPT):
            return [Write(time, "release", (), f"command {code}", state)]
        fine = code in HARMLESS
        return [Write(time, "other" if fine else "forbidden", (), f"command {code}", state)]

    def _offset(self, time: float, state: int) -> Write:
        """Return the offset that the sequence number has made valid, if its checksum fits."""
        get = self._registers.get
        values = [get(f"input_double_register_{i}", 0.0) for i in range(18, 23)]
        rz = get("input_int_register_18", 0)
        units = [round(v / UNIT) for v in values] + [int(rz)]
        total = (sum(units) + int(get(RATES, 0)) + 31 * int(get(SEQUENCE, 0))) % MODULUS
        kind = "offset" if total == get("input_int_register_20", -1) else "broken"
        return Write(time, kind, (*values, rz * UNIT), "registers", state)  # type: ignore[arg-type]


def _ours(name: str) -> bool:
    """Return whether a register of the offset mode is one that the daemon may write."""
    kind, _, number = name.rpartition("_")
    if kind == "input_double_register":
        return number in ("18", "19", "20", "21", "22")
    return kind == "input_int_register" and number in ("18", "19", "20", "21", "22", LIBRARY)
