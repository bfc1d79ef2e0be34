"""Robotous RFT on CAN: a stream of samples, each in two frames.

A command of 8 bytes starts (0x0B) and stops (0x0C) the stream. A sample is 16 bytes in two frames:
0x0B, Fx, Fy, Fz, Tx, Ty, Tz as big-endian int16, the overload status, two spare bytes; Tx lies
across the border of the frames. Source: CORC, src/hardware/IO/RobotousRFT.cpp.
"""

from __future__ import annotations

import contextlib
import struct
from typing import Any

import numpy as np

from gapbridge.drivers.can_bus.bus import open_bus
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.ft_sensor.can_sensor import CanSensor
from gapbridge.drivers.ft_sensor.sensor import ClockOffset, Reading
from gapbridge.drivers.ft_sensor.settings import RobotousSettings

START, STOP = 0x0B, 0x0C
LAYOUT = struct.Struct(">B6hB2x")
SILENCE = 0.5  # s without a sample after which the stream is started again


class PairDecoder:
    """Assembles the two frames of a sample; other frames are dropped."""

    def __init__(self, reply_ids: tuple[int, int], window: float) -> None:
        self._first_id, self._second_id = reply_ids
        self._window = window  # s between the two frames at most
        self._first: tuple[bytes, float] | None = None
        self.dropped = 0

    def take(self, identifier: int, data: bytes, stamp: float) -> tuple[int, ...] | None:
        """Take one frame with its time stamp (s).

        Returns the counts of Fx..Tz and the overload status where it completes a sample.
        """
        if identifier == self._first_id:
            self.dropped += self._first is not None
            good = len(data) == 8 and data[0] == START
            self._first = (data, stamp) if good else None
            self.dropped += not good
            return None
        if identifier != self._second_id:
            return None
        first, self._first = self._first, None
        if first is None or len(data) != 8 or not 0.0 <= stamp - first[1] <= self._window:
            self.dropped += 1
            return None
        return LAYOUT.unpack(first[0] + data)[1:]


class RobotousRft(CanSensor):
    """Driver of the sensor."""

    def __init__(self, settings: RobotousSettings, clock: Clock = SYSTEM) -> None:
        super().__init__(clock)
        self.settings = settings
        self.name = f"robotous_rft at {settings.where()}"
        counts = 3 * (settings.force_counts,) + 3 * (settings.torque_counts,)
        self._unit = settings.sign / np.array(counts)
        self._decoder = PairDecoder(settings.reply_ids, 0.5 / settings.rate)
        self._clock = ClockOffset()
        self._last_received = 0.0  # s, monotonic

    def connect(self) -> None:
        """Open the bus and start the stream. Raises LinkError."""
        filters: Any = [
            {"can_id": i, "can_mask": 0x7FF, "extended": False} for i in self.settings.reply_ids
        ]
        self._bus = open_bus(self.settings, filters)
        self._clock = ClockOffset()
        self._decoder = PairDecoder(self.settings.reply_ids, 0.5 / self.settings.rate)
        self._command(START)

    def _command(self, code: int) -> None:
        self._last_received = self.clock.monotonic()
        self._send(self.settings.command_id, bytes([code]) + bytes(7))

    def read(self, timeout: float) -> Reading | None:
        """Return the next sample; see ForceTorqueSensor.read."""
        until = self.clock.monotonic() + timeout
        while (remaining := until - self.clock.monotonic()) > 0.0:
            frame = self._receive(remaining)
            if frame is None:
                break
            received = self.clock.monotonic()
            stamp = frame.timestamp or received
            counts = self._decoder.take(frame.arbitration_id, bytes(frame.data), stamp)
            self.dropped = self._decoder.dropped
            if counts is not None:
                self._last_received = received
                wrench = np.array(counts[:6]) * self._unit
                return Reading(self._clock.take(stamp, received), received, wrench, counts[6])
        if self.clock.monotonic() - self._last_received > SILENCE:
            self._command(START)  # the sensor may have been switched off
        return None

    def describe(self, status: int) -> str:
        """Return the overload status as text."""
        return f"overload (status 0x{status:02X})"

    def close(self) -> None:
        """Stop the stream and close the bus."""
        if self._bus is not None:
            with contextlib.suppress(Exception):
                self._command(STOP)
        super().close()
