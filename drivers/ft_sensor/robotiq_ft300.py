"""Robotiq FT300 on a serial line: Modbus RTU, or its stream of 100 samples a second.

Holding registers 180..185 are Fx, Fy, Fz in 0.01 N and Mx, My, Mz in 0.001 Nm, int16. Writing
0x0200 to register 410 starts the stream: 16 bytes a sample, 0x20 0x4E, six int16 (little-endian),
CRC-16 as Modbus has it. Some fifty bytes of 0xFF end it. Source: FT300 manual, p. 65;
ros-industrial/robotiq rq_sensor_com.cpp.
"""

from __future__ import annotations

import contextlib
import struct
from typing import Any

import numpy as np

from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.ft_sensor.sensor import ForceTorqueSensor, Reading
from gapbridge.drivers.ft_sensor.settings import RobotiqSettings

REGISTER, STREAM_REGISTER, STREAM = 180, 410, 0x0200
STREAM_RATE = 100.0  # Hz
HEAD = b"\x20\x4e"
FRAME = struct.Struct("<2x6h2x")
QUIET = b"\xff" * 50  # ends the stream
UNIT = np.array((1e-2, 1e-2, 1e-2, 1e-3, 1e-3, 1e-3))  # N, Nm per count
RESPONSE = 0.2  # s until the registers must be answered
START = 1.0  # s until the command that starts the stream must be answered
TRIES = 3  # attempts to start it when connecting
TURN = 0.1  # s that the sensor needs to switch from its stream to Modbus
BITS = 10.0  # per byte on the line, 8N1
SILENCE = 0.5  # s without a sample after which the stream is started again
LONGEST = 4096  # bytes read at once


class StreamDecoder:
    """Finds samples in the bytes of the stream; bytes without a correct CRC are dropped."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.dropped = 0  # bytes that belonged to no sample

    def take(self, data: bytes) -> list[tuple[int, ...]]:
        """Add bytes; returns the counts (6 each) of the samples completed."""
        from pymodbus.framer import FramerRTU

        buffer, samples = self._bytes, []
        buffer += data
        while True:
            start = buffer.find(HEAD)
            if start < 0:
                start = len(buffer) - (buffer[-1:] == HEAD[:1])
            self.dropped += start
            del buffer[:start]
            if len(buffer) < FRAME.size:
                break
            whole = bytes(buffer[: FRAME.size])
            if FramerRTU.compute_CRC(whole[:-2]).to_bytes(2, "big") == whole[-2:]:
                samples.append(FRAME.unpack(whole))
                del buffer[: FRAME.size]
            else:
                self.dropped += 1
                del buffer[:1]
        return samples


class RobotiqFt300(ForceTorqueSensor):
    """Driver of the sensor."""

    def __init__(self, settings: RobotiqSettings, clock: Clock) -> None:
        super().__init__(clock)
        self.settings = settings
        self.name = f"robotiq_ft300 at {settings.port}"
        self._client: Any = None
        self._decoder = StreamDecoder()
        self._waiting: list[Reading] = []
        self._last_received = 0.0  # s, monotonic

    def connect(self) -> None:
        """Open the line, end a running stream, start a new one. Raises LinkError."""
        from pymodbus.client import ModbusSerialClient

        settings = self.settings
        patience = START if settings.mode == "stream" else RESPONSE
        self._client = ModbusSerialClient(
            settings.port, baudrate=settings.baudrate, bytesize=8, parity="N", stopbits=1,
            timeout=patience, retries=0,
        )  # fmt: skip
        if not self._client.connect():
            self._client = None
            raise LinkError(f"{self.name}: the serial line cannot be opened")
        try:
            self._begin(TRIES)
        except LinkError:
            self.close()
            raise

    def _begin(self, tries: int) -> None:
        """End a running stream and start a new one, in up to ``tries`` attempts."""
        try:
            self._stop_stream()
            if self.settings.mode == "stream":
                self._start_stream()
        except LinkError:
            if tries == 1:
                raise
            self._begin(tries - 1)

    def _stop_stream(self) -> None:
        """End a stream and drop its remaining bytes."""
        line = self._line()
        try:
            line.write(QUIET)
            line.flush()
            self._sleep(len(QUIET) * BITS / self.settings.baudrate + TURN)
            line.reset_input_buffer()
        except Exception as error:  # pyserial passes on termios.error, which is no OSError
            raise self._broken(error) from None

    def _start_stream(self) -> None:
        from pymodbus.exceptions import ModbusException

        try:
            answer = self._client.write_registers(
                STREAM_REGISTER, [STREAM], device_id=self.settings.device_id
            )
        except (ModbusException, OSError) as error:
            raise self._broken(error) from None
        if answer.isError() or answer.function_code != 16:
            raise LinkError(f"{self.name}: the sensor refused to start its stream ({answer})")
        self._decoder, self._last_received = StreamDecoder(), self._now()

    def _line(self) -> Any:
        line = self._client and self._client.socket
        if not line:
            raise LinkError(f"{self.name}: found no connection, expected connect() first")
        return line

    def _broken(self, error: Exception) -> LinkError:
        message = str(error).strip().splitlines() or [type(error).__name__]
        return LinkError(f"{self.name}: {message[0]}")

    def read(self, timeout: float) -> Reading | None:
        """Return the next sample; see ForceTorqueSensor.read."""
        if self.settings.mode == "registers":
            return self._ask()
        until = self._now() + timeout
        while not self._waiting:
            remaining = until - self._now()
            if remaining <= 0.0:
                if self._now() - self._last_received > SILENCE:
                    self._start_stream()  # the sensor may have been switched off
                return None
            self._take_bytes(remaining)
        return self._waiting.pop(0)

    def _take_bytes(self, timeout: float) -> None:
        """Wait for bytes of the stream and store the samples that they complete."""
        line = self._line()
        try:
            line.timeout = timeout
            data = line.read(1)
            data += line.read(min(line.in_waiting, LONGEST)) if data else b""
        except (OSError, TypeError) as error:  # TypeError: closed while reading
            raise self._broken(error) from None
        received = self._now()
        samples = self._decoder.take(data)
        self.dropped = self._decoder.dropped
        transfer_time = FRAME.size * BITS / self.settings.baudrate
        for age, counts in enumerate(reversed(samples)):
            stamp = received - transfer_time - age / STREAM_RATE
            self._waiting.insert(0, self._reading(stamp, received, counts))
        if samples:
            self._last_received = received

    def _ask(self) -> Reading | None:
        """Return the registers' sample; None if the answer is invalid."""
        from pymodbus.exceptions import ModbusException

        line = self._line()
        requested_at = self._now()
        try:
            answer = self._client.read_holding_registers(
                REGISTER, count=6, device_id=self.settings.device_id
            )
        except (ModbusException, OSError) as error:
            # a request that took too long to write leaves the port open
            is_open = self._client is not None and self._client.socket is not None
            if isinstance(error, OSError) or not is_open:
                raise self._broken(error) from None
            self.dropped += 1
            with contextlib.suppress(OSError):
                line.reset_input_buffer()
            return None
        received = self._now()
        if answer.isError() or answer.function_code != 3 or len(answer.registers) != 6:
            self.dropped += 1
            return None
        counts = struct.unpack(">6h", struct.pack(">6H", *answer.registers))
        return self._reading(0.5 * (requested_at + received), received, counts)

    def _reading(self, stamp: float, received: float, counts: tuple[int, ...]) -> Reading:
        return Reading(stamp, received, self.settings.sign * UNIT * np.array(counts))

    def close(self) -> None:
        """End the stream and close the line."""
        client, self._client = self._client, None
        if client is None:
            return
        with contextlib.suppress(Exception):
            if self.settings.mode == "stream" and client.socket:
                client.socket.write(QUIET)
                client.socket.flush()
        with contextlib.suppress(Exception):
            client.close()
