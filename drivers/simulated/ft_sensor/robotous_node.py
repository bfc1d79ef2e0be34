"""A Robotous RFT on a CAN bus."""

from __future__ import annotations

import time
from typing import Any

import can

from gapbridge.drivers.can_bus.bus import BusSettings, close_bus, open_bus
from gapbridge.drivers.simulated.ft_sensor.mounting import Reaction
from gapbridge.drivers.simulated.ft_sensor.node import SimulatedSensor


class RobotousNode(SimulatedSensor):
    """Streams two frames a sample once it has been asked to (0x0B), until asked to stop (0x0C)."""

    def __init__(
        self,
        reaction: Reaction,
        bus: BusSettings,
        command_id: int = 0x64,
        reply_ids: tuple[int, int] = (0x01, 0x02),
        rate: float = 200.0,
    ) -> None:
        super().__init__(reaction)
        self._settings = bus
        self._command_id, self._reply_ids, self._period = command_id, reply_ids, 1.0 / rate
        self._bus: Any = None
        self.streaming = False
        self.sent = 0  # samples

    def open(self) -> None:
        """Open the bus."""
        self._bus = open_bus(
            self._settings,
            [{"can_id": self._command_id, "can_mask": 0x7FF, "extended": False}],
        )

    def serve(self) -> None:
        """Obey commands and stream."""
        due = time.monotonic()
        try:
            while not self._ended.is_set():
                command = self._bus.recv(max(due - time.monotonic(), 0.0))
                if command is not None and len(command.data) == 8 and not self.silent:
                    self.streaming = (self.streaming or command.data[0] == 0x0B) and (
                        command.data[0] != 0x0C
                    )
                if time.monotonic() >= due:
                    due = max(due + self._period, time.monotonic() - 0.1)
                    if self.streaming and not self.silent:
                        self._send_sample()
        except (can.CanError, OSError):
            return  # the bus has gone

    def sample(self) -> bytes:
        """Return the sixteen bytes of a sample."""
        counts = self.counts(50.0, 2000.0)
        body = b"".join(v.to_bytes(2, "big", signed=True) for v in counts)
        return b"\x0b" + body + bytes([self.status & 0xFF, 0, 0])

    def _send_sample(self) -> None:
        data = self.sample()
        for identifier, part in zip(self._reply_ids, (data[:8], data[8:]), strict=True):
            self._bus.send(
                can.Message(arbitration_id=identifier, data=part, is_extended_id=False), timeout=0.1
            )
        self.sent += 1

    def close_wire(self) -> None:
        """Leave the bus."""
        if self._bus is not None:
            close_bus(self._bus)
            self._bus = None
