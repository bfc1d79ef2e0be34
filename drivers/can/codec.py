"""Where a map's signals lie, worked out when it is loaded, and compiled code that goes by it.

cantools says where a signal lies and how it is scaled; a frame's bytes are taken apart and put
together here, all joints at once, instead of by a dictionary per frame. What the plan cannot do
(multiplexed signals, floats of 16 bits, integers beyond 32) stays with cantools, and so does every
value that is out of range, for the words that it finds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gapbridge.core.kernels.reference import JIT
from gapbridge.drivers.can.profile import CanProfile, Incoming, Key, Outgoing

Vector = NDArray[np.float64]
Places = NDArray[np.int64]  # (m, 7): slot, start bit, length, big endian, signed, float, target
SLOT = 8  # bytes of a classic frame
ORDER = ("position", "velocity", "torque", "temperature")


def place_of(message: Any, name: str) -> tuple[int, int, int, int, int] | None:
    """Return start bit, length, big endian, signed, float of a signal; None: not for the plan."""
    signal = next(s for s in message.signals if s.name == name)
    floats = bool(signal.conversion.is_float)
    simple = not message.is_multiplexed() and not message.is_container
    sized = signal.length in (32, 64) if floats else signal.length <= 32
    if not simple or not sized or message.length > SLOT:
        return None
    big = signal.byte_order == "big_endian"
    start = 8 * (signal.start // 8) + 7 - signal.start % 8 if big else signal.start
    return start, signal.length, int(big), int(bool(signal.is_signed)), int(floats)


def conversion_of(message: Any, name: str) -> Any:
    """Return the conversion (cantools) of a signal."""
    return next(s for s in message.signals if s.name == name).conversion


@njit(**JIT)
def _float_of(bits, length):  # type: ignore[no-untyped-def]
    if length == 32:
        return np.float64(np.array([np.uint32(bits)]).view(np.float32)[0])
    return np.array([bits]).view(np.float64)[0]


@njit(**JIT)
def fill(raw, received, places, factors, lines, found):  # type: ignore[no-untyped-def]
    """Write all quantities (q n,) in SI units that the frames in ``raw`` (8 bytes a slot) contain.

    ``factors`` (m, 2): scale and offset of each signal; ``lines`` (3, q n): wire values, where
    those of slots not ``received`` stay as they are, then scale and zero of each.
    """
    for k in range(places.shape[0]):
        slot, start, length = places[k, 0], places[k, 1], places[k, 2]
        if not received[slot]:
            continue
        word = np.uint64(0)
        for i in range(8):
            at = i if places[k, 3] else 7 - i
            word = (word << np.uint64(8)) | np.uint64(raw[8 * slot + at])
        shift = 64 - start - length if places[k, 3] else start
        bits = (word >> np.uint64(shift)) & (~np.uint64(0) >> np.uint64(64 - length))
        if places[k, 5]:
            value = _float_of(bits, length)
        else:
            count = np.int64(bits)
            if places[k, 4] and count >> (length - 1):
                count -= np.int64(1) << length
            value = np.float64(count)
        lines[0, places[k, 6]] = value * factors[k, 0] + factors[k, 1]
    for i in range(found.shape[0]):
        found[i] = lines[0, i] * lines[1, i] + lines[2, i]


class Reading:
    """The frames of one profile that the plan takes apart: the last of each, and what they say."""

    def __init__(self, profile: CanProfile) -> None:
        self.names = [name for name in ORDER if name in profile.quantities]
        self._n = n = profile.n
        self.slots: dict[Key, int] = {}
        rows: list[tuple[int, ...]] = []
        factors: list[tuple[float, float]] = []
        for key, incoming in profile.incoming.items():
            places = self._places(incoming)
            if places is None:
                continue
            slot = self.slots[key] = len(self.slots)
            for reading, place in zip(incoming.readings, places, strict=True):
                rows.append((slot, *place, self.names.index(reading.quantity) * n + reading.joint))
                conversion = conversion_of(incoming.message, reading.signal)
                factors.append((float(conversion.scale), float(conversion.offset)))
        self._raw, self._received = bytearray(SLOT * len(self.slots)), bytearray(len(self.slots))
        joints = profile.joints
        scale = np.concatenate([joints.scale[name] for name in self.names])
        zero = np.zeros(len(scale))
        zero[:n] = joints.zero
        self._lines = np.array([np.full(len(scale), np.nan), scale, zero])
        self.wire = {name: self._lines[0, i * n : i * n + n] for i, name in enumerate(self.names)}
        self._arguments = (
            np.frombuffer(self._raw, np.uint8), np.frombuffer(self._received, np.uint8),
            np.array(rows, np.int64).reshape(-1, 7), np.array(factors).reshape(-1, 2), self._lines,
        )  # fmt: skip
        self.table()  # compiled here: the first sample must not wait for a compiler

    @staticmethod
    def _places(incoming: Incoming) -> list[tuple[int, ...]] | None:
        """Return where a message's joints lie; None where cantools must decode all of it."""
        if incoming.checks or incoming.enabled or incoming.counter is not None:
            return None
        places = [place_of(incoming.message, r.signal) for r in incoming.readings]
        return None if None in places else [p for p in places if p is not None]

    def put(self, slot: int, data: bytes) -> None:
        """Take the bytes of a frame, of the length that its message has."""
        start = SLOT * slot
        self._raw[start : start + len(data)] = data
        self._received[slot] = 1

    def table(self) -> Vector:
        """Return all quantities (q, n) in SI units, in order of ``names``; NaN: not received."""
        found = np.empty(len(self.names) * self._n)
        fill(*self._arguments, found)
        return found.reshape(-1, self._n)


@njit(**JIT)
def pack(q, joints, places, limits, out):  # type: ignore[no-untyped-def]
    """Write joints q (n,) into the frames of ``out`` (8 bytes a slot); False: nothing is to leave.

    ``joints`` (2, n): zero and scale; ``limits`` (m, 4): least and most of a signal's value, its
    scale and offset.
    """
    for k in range(places.shape[0]):
        slot, start, length, big = places[k, 0], places[k, 1], places[k, 2], places[k, 3]
        joint = places[k, 6]
        wire = (q[joint] - joints[0, joint]) / joints[1, joint]
        if not (limits[k, 0] <= wire <= limits[k, 1] and np.isfinite(wire)):
            return False
        raw = (wire - limits[k, 3]) / limits[k, 2]
        if places[k, 5] and length == 32:
            single = np.float32(raw)
            if not np.isfinite(single):
                return False
            bits = np.uint64(np.array([single]).view(np.uint32)[0])
        elif places[k, 5]:
            bits = np.array([raw]).view(np.uint64)[0]
        else:
            raw = np.rint(raw)
            low = -(2.0 ** (length - 1)) if places[k, 4] else 0.0
            if not (low <= raw < low + 2.0**length):
                return False
            bits = np.uint64(np.int64(raw)) & (~np.uint64(0) >> np.uint64(64 - length))
        shift = 64 - start - length if big else start
        mask = (~np.uint64(0) >> np.uint64(64 - length)) << np.uint64(shift)
        bits = bits << np.uint64(shift)
        for i in range(8):
            at = 8 * slot + (7 - i if big else i)
            keep = np.uint64(out[at]) & ~((mask >> np.uint64(8 * i)) & np.uint64(255))
            out[at] = np.uint8(keep | ((bits >> np.uint64(8 * i)) & np.uint64(255)))
    return True


class Writing:
    """The frames of a setpoint, packed at once where the plan can do it."""

    def __init__(self, profile: CanProfile) -> None:
        self._frames = profile.setpoint
        rows: list[tuple[int, ...]] = []
        limits: list[tuple[float, ...]] = []
        self._out = np.zeros(SLOT * len(self._frames), np.uint8)
        self.able = bool(self._frames) and all(
            self._plan(slot, frame, rows, limits) for slot, frame in enumerate(self._frames)
        )
        self._cuts = [
            (f.key, f.data, SLOT * i, SLOT * i + f.message.length)
            for i, f in enumerate(self._frames)
        ]
        if self.able:
            scale = profile.joints.setpoint_scale
            assert scale is not None
            self._q = np.zeros(profile.n)
            joints = np.array([profile.joints.zero, scale])
            self._arguments = (joints, np.array(rows, np.int64), np.array(limits))
            pack(self._q, *self._arguments, self._out)  # compiled here

    def _plan(
        self, slot: int, frame: Outgoing, rows: list[tuple[int, ...]], limits: list[Any]
    ) -> bool:
        """Add a frame; False where cantools must encode it."""
        message = frame.message
        if frame.data is not None:
            return True
        at_zero = dict(frame.constants)
        for name, joint in frame.joints:
            place, signal = place_of(message, name), message.get_signal_by_name(name)
            if place is None or signal.conversion.choices:
                return False
            low = -np.inf if signal.minimum is None else float(signal.minimum)
            high = np.inf if signal.maximum is None else float(signal.maximum)
            rows.append((slot, *place, joint))
            conversion = signal.conversion
            limits.append((low, high, float(conversion.scale), float(conversion.offset)))
            at_zero[name] = conversion.offset
        data = message.encode(at_zero, strict=False)
        self._out[SLOT * slot : SLOT * slot + len(data)] = np.frombuffer(data, np.uint8)
        return True

    def frames(self, q: Vector) -> list[tuple[Key, bytes]] | None:
        """Return the frames of joints q (n,), rad; None where cantools has to say what is wrong."""
        self._q[:] = q
        if not pack(self._q, *self._arguments, self._out):
            return None
        packed = self._out.tobytes()
        return [
            (key, packed[start:end] if data is None else data)
            for key, data, start, end in self._cuts
        ]
