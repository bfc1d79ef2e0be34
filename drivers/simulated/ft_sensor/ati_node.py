"""An ATI NETCANOEM on a CAN bus: gauges, its own calibration matrix, units."""

from __future__ import annotations

import contextlib
import struct
from abc import abstractmethod
from typing import Any

import can
import numpy as np

from gapbridge.drivers.can_bus.bus import BusSettings, close_bus, open_bus
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.ft_sensor.node import Reaction, SimulatedSensor

RANGE = np.array((600.0, 600.0, 600.0, 60.0, 60.0, 60.0))  # N, Nm at about full gauges
FULL = 30000.0  # gauge counts


class _CanNode(SimulatedSensor):
    """A sensor on a CAN bus; it receives ``first`` and what is like it in the bits of ``mask``."""

    def __init__(self, reaction: Reaction, bus: BusSettings, first: int, mask: int) -> None:
        super().__init__(reaction)
        self._settings = bus
        self._filter = can.typechecking.CanFilter(can_id=first, can_mask=mask, extended=False)
        self._bus: Any = None

    def open(self) -> None:
        """Open the bus."""
        self._bus = open_bus(self._settings, [self._filter])

    def serve(self) -> None:
        """Serve until the end, or until the bus is lost."""
        with contextlib.suppress(can.CanError, OSError):
            self._serve_bus()

    @abstractmethod
    def _serve_bus(self) -> None:
        """Serve until ``_ended`` is set."""

    def _send(self, identifier: int, data: bytes) -> None:
        frame = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
        self._bus.send(frame, timeout=0.1)

    def close_wire(self) -> None:
        """Leave the bus."""
        if self._bus is not None:
            close_bus(self._bus)
            self._bus = None


class AtiNode(_CanNode):
    """Answers questions; its gauges are mixed by a matrix that is drawn from the seed.

    ``units``: codes of force and torque unit, with what one unit is in N and in Nm.
    """

    def __init__(
        self,
        reaction: Reaction,
        bus: BusSettings,
        base_id: int = 0x20,
        seed: int = 0,
        units: tuple[tuple[int, float], tuple[int, float]] = ((2, 1.0), (3, 1.0)),
    ) -> None:
        self._base = base_id << 4
        super().__init__(reaction, bus, self._base, 0x7F0)
        (self._force_code, newton), (self._torque_code, newton_metre) = units
        self._counts = (1_000_000, 500_000)  # per unit of force, of torque
        scale = np.array(3 * (self._counts[0] / newton,) + 3 * (self._counts[1] / newton_metre,))
        mixing = np.eye(6) + np.random.default_rng(seed).uniform(-0.12, 0.12, (6, 6))
        # wrench = diag(1/scale) matrix gauges
        exact = (scale * RANGE / FULL)[:, None] * mixing
        self._matrix = exact.astype(np.float32)
        self._inverse = np.linalg.inv(self._matrix.astype(float)) * scale

    def gauges(self) -> list[int]:
        """Return the gauges (6,), held at the ends of their range."""
        counts = np.rint(self._inverse @ np.array(self.reaction()))
        return [int(v) for v in np.clip(counts, -32768, 32767)]

    def answer(self, operation: int, data: bytes) -> list[bytes]:
        """Return the frames that answer a question; their ids count up from the operation."""
        if operation == 0x0:
            g = self.gauges()
            return [struct.pack(">H3h", self.status, g[0], g[2], g[4]),
                    struct.pack(">3h", g[1], g[3], g[5])]  # fmt: skip
        if operation == 0x2 and len(data) == 1 and data[0] < 6:
            row = struct.pack(">6f", *self._matrix[data[0]])
            return [row[:8], row[8:16], row[16:]]
        if operation == 0x7:
            return [struct.pack(">2I", *self._counts)]
        if operation == 0x8:
            return [bytes((self._force_code, self._torque_code))]
        return []

    def _serve_bus(self) -> None:
        """Answer questions."""
        while not self._ended.is_set():
            question = self._bus.recv(0.05)
            if question is None or self.silent:
                continue
            operation = question.arbitration_id & 0xF
            for i, data in enumerate(self.answer(operation, bytes(question.data))):
                self._send(self._base | (operation + i), data)


class RobotousNode(_CanNode):
    """Streams two frames a sample once it has been asked to (0x0B), until asked to stop (0x0C)."""

    def __init__(
        self,
        reaction: Reaction,
        bus: BusSettings,
        clock: Clock,
        command_id: int = 0x64,
        reply_ids: tuple[int, int] = (0x01, 0x02),
        rate: float = 200.0,
    ) -> None:
        super().__init__(reaction, bus, command_id, 0x7FF)
        self._now = clock.monotonic
        self._reply_ids, self._period = reply_ids, 1.0 / rate
        self.streaming = False
        self.sent = 0  # samples

    def _serve_bus(self) -> None:
        """Obey commands and stream."""
        due = self._now()
        while not self._ended.is_set():
            command = self._bus.recv(max(due - self._now(), 0.0))
            if command is not None and len(command.data) == 8 and not self.silent:
                order = command.data[0]
                self.streaming = (self.streaming or order == 0x0B) and order != 0x0C
            if self._now() >= due:
                due = max(due + self._period, self._now() - 0.1)
                if self.streaming and not self.silent:
                    self._send_sample()

    def sample(self) -> bytes:
        """Return the sixteen bytes of a sample."""
        counts = self.counts(50.0, 2000.0)
        body = b"".join(v.to_bytes(2, "big", signed=True) for v in counts)
        return b"\x0b" + body + bytes([self.status & 0xFF, 0, 0])

    def _send_sample(self) -> None:
        data = self.sample()
        for identifier, part in zip(self._reply_ids, (data[:8], data[8:]), strict=True):
            self._send(identifier, part)
        self.sent += 1
