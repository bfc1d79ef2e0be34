"""ATI NETCANOEM on CAN: polled sample by sample; calibration and units are read from it.

The lower four bits of an id are the operation, the upper seven the sensor. Everything is
big-endian. Operation 0 answers with status, gauges 0, 2, 4 (id 0) and gauges 1, 3, 5 (id 1), all
int16; 2 with a row of the calibration matrix, float32, two a frame (ids 2, 3, 4); 7 with the counts
per force and torque unit, uint32; 8 with the codes of these units. Wrench = matrix gauges / counts.
Sources: KITrobotics/ati_force_torque ForceTorqueCtrl, ati_netcanoem_ft_driver, ATI 9610-05-1030.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError
from gapbridge.drivers.can_bus.bus import open_bus
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.ft_sensor.can_sensor import CanSensor
from gapbridge.drivers.ft_sensor.sensor import Reading
from gapbridge.drivers.ft_sensor.settings import AtiSettings

GAUGES, MATRIX, COUNTS, UNITS = 0x0, 0x2, 0x7, 0x8
ANSWER = 0.1  # s until a request for calibration data is repeated
ATTEMPTS = 3
SAMPLE = 0.03  # s until a sample is lost (a USB adapter may take 0.016)
FRAME_WINDOW = 0.005  # s between the frames of a sample at most
SATURATED = 0x10000  # added to the sensor's status bits: a gauge at the end of its range
# code -> N or Nm
FORCE_UNITS = {1: 4.4482216152605, 2: 1.0, 3: 4448.2216152605, 4: 1e3, 5: 9.80665, 6: 9.80665e-3}
TORQUE_UNITS = {1: 0.1129848290276, 2: 1.3558179483314, 3: 1.0, 4: 1e-3, 5: 9.80665e-2, 6: 1e3}
STATUS = (
    "watchdog reset", "excitation voltage high", "excitation voltage low", "analog ground",
    "power high", "power low", "bit 6", "EEPROM", "invalid configuration", "gauge supply high",
    "gauge supply low", "thermistor high", "thermistor low", "DAC reading out of range", "bit 14",
    "bit 15", "gauge saturated",
)  # fmt: skip


def decode_gauges(first: bytes, second: bytes) -> tuple[int, tuple[int, ...]] | None:
    """Return status and gauges 0..5 of the two frames of an answer; None if invalid."""
    if len(first) != 8 or len(second) != 6:
        return None
    status, a, c, e = struct.unpack(">H3h", first)
    b, d, f = struct.unpack(">3h", second)
    gauges = (a, b, c, d, e, f)
    if max(gauges) == 32767 or min(gauges) == -32768:
        status |= SATURATED
    return status, gauges


class AnswerDecoder:
    """Assembles the frames of one answer: consecutive ids, in order, within a window."""

    def __init__(self, first_id: int, frames: int, window: float) -> None:
        self._first_id, self._frames = first_id, frames
        self._window = window  # s from the first frame to the last at most
        self._received: list[bytes] = []
        self._begun = 0.0
        self.dropped = 0

    def take(self, identifier: int, data: bytes, stamp: float) -> list[bytes] | None:
        """Take one frame with its time stamp (s); returns the answer where it is complete."""
        frames = self._received
        if identifier == self._first_id:
            self.dropped += len(frames)
            self._received, self._begun = [data], stamp
        elif frames and identifier == self._first_id + len(frames):
            if 0.0 <= stamp - self._begun <= self._window:
                frames.append(data)
            else:
                self._drop()
        else:
            self._drop()
        if len(self._received) < self._frames:
            return None
        answer, self._received = self._received, []
        return answer

    def _drop(self) -> None:
        self.dropped += 1 + len(self._received)
        self._received = []


class AtiNetCanOem(CanSensor):
    """Driver of the sensor."""

    def __init__(self, settings: AtiSettings, clock: Clock = SYSTEM) -> None:
        super().__init__(clock)
        self.settings = settings
        self.name = f"ati_netcanoem at {settings.where()}"
        self._base = settings.base_id << 4
        self._matrix: Array = np.zeros((6, 6))  # N, Nm per gauge count
        self._due = 0.0  # s, monotonic: when the next sample is asked for

    def connect(self) -> None:
        """Open the bus and read calibration and units. Raises LinkError."""
        filters: Any = [{"can_id": self._base, "can_mask": 0x7F0, "extended": False}]
        self._bus = open_bus(self.settings, filters)
        try:
            self._matrix = self._calibration()
        except LinkError:
            self.close()
            raise
        self._due = self.clock.monotonic()

    def _calibration(self) -> Array:
        (units,) = self._ask(UNITS, b"", (2,))
        force, torque = FORCE_UNITS.get(units[0]), TORQUE_UNITS.get(units[1])
        if force is None or torque is None:
            raise LinkError(
                f"{self.name}: found unit codes {units[0]} and {units[1]}, expected 1 to 6"
            )
        (answer,) = self._ask(COUNTS, b"", (8,))
        counts = struct.unpack(">2I", answer)
        rows = [b"".join(self._ask(MATRIX, bytes([i]), (8, 8, 8))) for i in range(6)]
        matrix = np.array([struct.unpack(">6f", row) for row in rows], dtype=float)
        if min(counts) == 0 or not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix) < 6:
            raise LinkError(
                f"{self.name}: found a calibration that is none (counts {counts[0]}, {counts[1]}, "
                f"matrix of rank {_rank(matrix)}), expected one of rank 6"
            )
        unit = np.array(3 * (force / counts[0],) + 3 * (torque / counts[1],))
        return np.asarray(self.settings.sign * unit[:, None] * matrix)

    def _ask(self, operation: int, data: bytes, lengths: tuple[int, ...]) -> list[bytes]:
        """Return the frames of an answer, of these lengths; repeats the request if none comes."""
        for _ in range(ATTEMPTS):
            self._drain()
            self._send(self._base | operation, data)
            answer = self._answer(operation, len(lengths), self.clock.monotonic() + ANSWER)
            if answer is not None and tuple(map(len, answer)) == lengths:
                return answer
        raise LinkError(
            f"{self.name}: no answer to operation {operation}, expected a NETCANOEM with base id "
            f"0x{self.settings.base_id:02X}"
        )

    def _answer(
        self, operation: int, frames: int, until: float, window: float = ANSWER
    ) -> list[bytes] | None:
        """Return the data of an answer's frames; None if it has not come in time."""
        decoder = AnswerDecoder(self._base | operation, frames, window)
        while (remaining := until - self.clock.monotonic()) > 0.0:
            frame = self._receive(remaining)
            if frame is None:
                break
            answer = decoder.take(frame.arbitration_id, bytes(frame.data), frame.timestamp)
            if answer is not None:
                self.dropped += decoder.dropped
                return answer
            if frame.arbitration_id == (self._base | operation) + frames - 1:
                break  # the last frame, but some before it are missing: a new request is faster
        self.dropped += decoder.dropped
        return None

    def read(self, timeout: float) -> Reading | None:
        """Request a sample when it is due and return it; see ForceTorqueSensor.read."""
        self._connected()
        until = self.clock.monotonic() + timeout
        self.clock.sleep(max(min(self._due, until) - self.clock.monotonic(), 0.0))
        if self._due > until:
            return None
        self._drain()
        requested_at = self.clock.monotonic()
        self._due = max(self._due + 1.0 / self.settings.rate, requested_at)
        self._send(self._base | GAUGES, b"")
        answer = self._answer(GAUGES, 2, requested_at + SAMPLE, FRAME_WINDOW)
        received = self.clock.monotonic()
        if answer is None:
            return None
        decoded = decode_gauges(*answer)
        if decoded is None:
            self.dropped += 1
            return None
        status, gauges = decoded
        # sampled halfway between request and answer, whose delays are assumed equal
        return Reading(
            0.5 * (requested_at + received), received, self._matrix @ np.array(gauges), status
        )

    def _drain(self) -> None:
        """Drop late answers to former requests."""
        while self._receive(0.0) is not None:
            self.dropped += 1

    def describe(self, status: int) -> str:
        """Return the bits of the status as text."""
        faults = [word for i, word in enumerate(STATUS) if status >> i & 1]
        return f"status 0x{status & 0xFFFF:04X}: {', '.join(faults)}"


def _rank(matrix: Array) -> int:
    return int(np.linalg.matrix_rank(matrix)) if np.isfinite(matrix).all() else 0
