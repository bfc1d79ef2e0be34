"""Base class of force-torque sensors on a CAN bus: sending, receiving, closing."""

from __future__ import annotations

from typing import Any

from gapbridge.core.errors import LinkError, first_line
from gapbridge.drivers.can_bus.bus import close_bus
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.ft_sensor.sensor import ForceTorqueSensor


class CanSensor(ForceTorqueSensor):
    """A sensor with standard CAN frames; ``connect`` opens ``_bus``."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self._bus: Any = None

    def _connected(self) -> Any:
        """Return the bus. Raises LinkError where there is none."""
        if self._bus is None:
            raise LinkError(f"{self.name}: found no connection, expected connect() first")
        return self._bus

    def _send(self, identifier: int, data: bytes) -> None:
        """Send one frame. Raises LinkError."""
        import can

        frame = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
        bus = self._connected()
        try:
            bus.send(frame, timeout=0.1)
        except Exception as error:  # as in _receive
            raise LinkError(f"{self.name}: cannot be written to: {first_line(error)}") from None

    def _receive(self, timeout: float) -> Any:
        """Return the next data frame with a standard id within ``timeout`` s, or None.

        Raises LinkError.
        """
        bus, until = self._connected(), self._now() + timeout
        while True:
            try:
                frame = bus.recv(max(until - self._now(), 0.0))
            except Exception as error:  # an adapter may pass on any: IndexError for a cut line
                raise LinkError(f"{self.name}: {first_line(error)}") from None
            if frame is None:
                return None
            if not (frame.is_error_frame or frame.is_remote_frame or frame.is_extended_id):
                return frame

    def close(self) -> None:
        """Close the bus."""
        if self._bus is not None:
            close_bus(self._bus)
            self._bus = None
