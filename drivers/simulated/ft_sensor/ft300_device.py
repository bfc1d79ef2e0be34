"""A Robotiq FT300 on a pseudo-terminal: pymodbus answers, its stream runs on the same line."""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import struct
import tty
from pathlib import Path

from pymodbus.constants import ExcCodes
from pymodbus.framer import FramerRTU
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice

from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.ft_sensor.node import Reaction, SimulatedSensor

REGISTERS, STREAM_REGISTER, STREAM = 180, 410, 0x0200
PERIOD = 0.01  # s
QUIET = 50  # bytes of 0xFF that end the stream
LINGER = 0.02  # s from the command to the first sample


class Ft300Device(SimulatedSensor):
    """The device. ``path`` is the serial line to open; ``link``, where given, points to it.

    Its Modbus server hangs on a second pseudo-terminal; the thread passes the bytes between both
    and puts the stream on the line, so that the wire carries what the device's would.
    """

    def __init__(
        self, reaction: Reaction, clock: Clock, link: Path | None = None, device_id: int = 9
    ) -> None:
        super().__init__(reaction)
        self._now = clock.monotonic
        self.path = ""
        self.streaming = False
        self.sent = 0  # samples streamed
        self._link, self._device_id = link, device_id
        self._ends: list[int] = []
        self._outside = self._inside = -1  # our ends of the two lines
        self._server_path = ""
        self._quiet = 0  # bytes of 0xFF in a row

    def open(self) -> None:
        """Open the two lines."""
        self._outside, client = os.openpty()
        self._inside, server = os.openpty()
        self._ends = [self._outside, client, self._inside, server]
        for end in self._ends:
            tty.setraw(end)
        for end in (self._outside, self._inside):
            os.set_blocking(end, False)
        self.path, self._server_path = os.ttyname(client), os.ttyname(server)
        if self._link is not None:
            self._link_to(self._link)

    def _link_to(self, link: Path) -> None:
        """Make ``link`` a symbolic link to the line. Raises LinkError if it is another file."""
        try:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(self.path)
        except OSError as error:
            self.close_wire()
            raise LinkError(
                f"{link}: cannot be made to lead to the simulated line: {error.strerror}"
            ) from None

    def serve(self) -> None:
        """Serve both."""
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        device = SimDevice(
            id=self._device_id,
            simdata=[
                SimData(REGISTERS, values=[0] * 6, datatype=DataType.REGISTERS),
                SimData(STREAM_REGISTER, values=[0], datatype=DataType.REGISTERS),
            ],
            action=self._on_request,
        )
        server = ModbusSerialServer(device, port=self._server_path, baudrate=19200)
        await server.serve_forever(background=True)
        self._due = self._now()
        while not self._ended.is_set():
            self._pass_bytes()
            if self.streaming and not self.silent and self._now() >= self._due:
                self._due = max(self._due + PERIOD, self._now() - 0.1)
                self.put(self.frame())
                self.sent += 1
            await asyncio.sleep(0.001)
        await server.shutdown()  # type: ignore[no-untyped-call]

    async def _on_request(
        self,
        function_code: int,
        start_address: int,
        address: int,
        count: int,
        current_registers: list[int],
        set_values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Refresh the registers that are read; take note of the stream's command."""
        if set_values is None and address + count > REGISTERS and address < REGISTERS + 6:
            values = [v & 0xFFFF for v in self.counts(100.0, 1000.0)]
            first = REGISTERS - start_address
            current_registers[first : first + 6] = values
        elif set_values is not None and address == STREAM_REGISTER:
            self.streaming = list(set_values)[:1] == [STREAM]
            self._due = self._now() + LINGER
        return None

    def frame(self) -> bytes:
        """Return the sixteen bytes of a sample in the stream."""
        body = b"\x20\x4e" + struct.pack("<6h", *self.counts(100.0, 1000.0))
        return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")

    def put(self, data: bytes) -> None:
        """Send bytes on the line; bytes that do not fit are lost."""
        with contextlib.suppress(BlockingIOError, OSError):
            os.write(self._outside, data)

    def _pass_bytes(self) -> None:
        ready, _, _ = select.select([self._outside, self._inside], [], [], 0.0)
        if self._outside in ready:
            data, begin = _read(self._outside), 0
            for end, byte in enumerate(data, 1):
                self._quiet = self._quiet + 1 if byte == 0xFF else 0
                if self._quiet >= QUIET:
                    self.streaming, begin = False, end
            payload = data[begin:] if data[begin:].strip(b"\xff") else b""
            if payload and not self.streaming and not self.silent:
                os.write(self._inside, payload)
        if self._inside in ready:
            data = _read(self._inside)
            if not self.silent:
                self.put(data)

    def close_wire(self) -> None:
        """Close the lines: the client sees a hang-up."""
        ends, self._ends = self._ends, []
        for end in ends:
            with contextlib.suppress(OSError):
                os.close(end)
        if self._link is not None and ends:
            with contextlib.suppress(OSError):
                self._link.unlink()


def _read(end: int) -> bytes:
    try:
        return os.read(end, 4096)
    except (BlockingIOError, OSError):
        return b""
