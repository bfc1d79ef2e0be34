"""A Modbus server for any profile and an ArmController: pymodbus's server in a thread.

The server loop lays out an image of all registers each time the controller would renew them; a
request is answered from one whole image. What clients write is kept in order and acted on in the
arm's next cycle, as a controller's scan does.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any

from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusTlsServer
from pymodbus.simulator import DataType, SimData, SimDevice

from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.modbus.map import compile_map
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.registers import BIT_TABLES, Table
from gapbridge.drivers.modbus.schema import ProfileFile
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.robot_modes import StopReason
from gapbridge.drivers.simulated.modbus import image
from gapbridge.drivers.simulated.modbus.image import Image
from gapbridge.drivers.simulated.modbus.programs import MailboxProgram, make_program
from gapbridge.drivers.simulated.server.arm_controller import ArmController
from gapbridge.drivers.simulated.server.bench import Command
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer

FUNCTIONS: dict[int, Table] = {
    1: "coil", 5: "coil", 15: "coil", 2: "discrete", 4: "input",
    3: "holding", 6: "holding", 16: "holding", 22: "holding", 23: "holding",
}  # fmt: skip
WRITES = (5, 6, 15, 16, 22, 23)
START_LIMIT = 20.0  # s
TORN_APART = 2.0  # rad between the two moments that a torn image mixes
MOST_WRITES = 10000  # kept between two cycles


class ModbusServer(ProtocolServer):
    """One device with a profile's map, over TCP, TLS or a serial port."""

    def __init__(
        self,
        profile: ProfileFile,
        host: str,
        port: int,
        tls: ssl.SSLContext | None = None,
        serial: str | None = None,
        baudrate: int = 19200,
    ) -> None:
        self.profile, self._host, self._port = profile, host, port
        self._tls, self._serial, self._baudrate = tls, serial, baudrate
        self.name = f"Modbus {serial or port}"
        self.program = make_program(profile)
        self._writable = compile_map(profile).writable
        self._image: Image = image.blank(profile)
        self._written: Image = image.blank(profile)  # what clients wrote, as of the last cycle
        self._queue: deque[tuple[Table, int, list[int]]] = deque(maxlen=MOST_WRITES)
        self._due = 0.0
        self._torn = 0  # images still to be torn
        self._controller: ArmController | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server: Any = None
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None

    # -- the thread -------------------------------------------------------------------------------

    def open(self, controller: ArmController, clock: Clock) -> None:
        """Start serving. Raises LinkError if the port is taken."""
        self._controller, self._failure = controller, None
        self._publish(controller)
        listening = threading.Event()
        self._thread = threading.Thread(
            target=self._run, args=(listening,), daemon=True, name="simulated Modbus"
        )
        self._thread.start()
        if not clock.wait(listening, START_LIMIT) or self._failure is not None:
            raise LinkError(
                f"simulated controller: {self._serial or f'{self._host}:{self._port}'}: "
                f"cannot listen: {self._failure or 'no answer'}"
            )

    def _run(self, listening: threading.Event) -> None:
        try:
            asyncio.run(self._serve(listening))
        except Exception as error:
            self._failure = error
        finally:
            listening.set()

    async def _serve(self, listening: threading.Event) -> None:
        self._loop = asyncio.get_running_loop()
        self._server = server = self._make()
        await server.serve_forever(background=True)
        listening.set()
        with contextlib.suppress(asyncio.CancelledError):
            await server.serving
        await asyncio.sleep(0.0)  # connections end in callbacks

    def _make(self) -> Any:
        device = SimDevice(id=0, simdata=self._layout(), action=self._answer)
        if self._serial is not None:
            return ModbusSerialServer(device, port=self._serial, baudrate=self._baudrate)
        address = (self._host, self._port)
        if self._tls is not None:
            return ModbusTlsServer(device, address=address, sslctx=self._tls)
        return ModbusTcpServer(device, address=address)

    def _layout(self) -> tuple[list[SimData], list[SimData], list[SimData], list[SimData]]:
        """Return the library's blocks: every register of the map, the coils in whole words."""
        blocks: list[list[SimData]] = []
        for table in image.TABLES:
            addresses = sorted(self._image[table])
            if table in BIT_TABLES:
                first = min(addresses, default=0) // 16 * 16
                bits = [False] * (max(addresses, default=15) // 16 * 16 + 16 - first)
                blocks.append([SimData(first, values=bits, datatype=DataType.BITS)])
            else:
                blocks.append(
                    [SimData(a, datatype=DataType.REGISTERS) for a in addresses or [65535]]
                )
        coils, discretes, holdings, inputs = blocks
        return coils, discretes, holdings, inputs

    async def _answer(
        self, function: int, start: int, address: int, count: int, registers: list[int],
        values: list[int] | list[bool] | None,
    ) -> None:  # fmt: skip
        """Fill the library's registers from the image for a reading; queue what is written."""
        controller = self._controller
        while controller is not None and controller.stalled:
            await asyncio.sleep(0.005)
        table = FUNCTIONS[function]
        if values is not None and function in WRITES:
            self._queue.append((table, address, [int(v) for v in values]))
            return
        found = self._image[table]
        if table not in BIT_TABLES:
            for a in range(address, address + count):
                registers[a - start] = found.get(a, 0)
            return
        first = address // 16
        for word in range(first, first + count):
            registers[word - start] = sum(
                1 << bit for bit in range(16) if found.get(16 * word + bit, 0)
            )

    def drop(self) -> None:
        """Close every client's connection."""
        self._call(self._drop_all)

    def _drop_all(self) -> None:
        for client in list(self._server.active_connections.values()):
            client.close()

    def _call(self, action: Any) -> None:
        if self._loop is not None and self._loop.is_running():
            self._loop.call_soon_threadsafe(action)

    def close(self) -> None:
        """Stop serving; may be repeated."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        server = self._server

        def end() -> None:
            self._drop_all()
            if not server.serving.done():
                server.serving.set_result(True)
            server.close()

        self._call(end)
        thread.join(START_LIMIT)

    # -- the controller's scan --------------------------------------------------------------------

    def cycle(self, controller: ArmController) -> None:
        """Process writes, step the robot's program, update the image when due."""
        while self._queue:
            table, address, values = self._queue.popleft()
            allowed = {a: v for a, v in enumerate(values, address) if (table, a) in self._writable}
            self._written[table].update(allowed)
            self.program.wrote(controller, table, address, values)
        self.program.cycle(controller, self._read_written)
        if controller.running >= self._due:
            self._due = max(self._due + self.profile.period, controller.running)
            self._publish(controller)

    def _read_written(self, table: Table, address: int, count: int) -> list[int]:
        return [self._written[table].get(a, 0) for a in range(address, address + count)]

    def _publish(self, controller: ArmController) -> None:
        """Lay out a new image in one step."""
        profile = self.profile
        new: Image = {table: dict(registers) for table, registers in self._written.items()}
        values = image.readings(controller)
        for table, registers in image.state_registers(profile, values).items():
            new[table].update(registers)
        entries = image.condition_registers(
            [*profile.identity, *profile.status], _stop_reasons(controller)
        )
        entries += image.clock_registers(profile, controller.clock)
        entries += self.program.registers(controller)
        for table, address, register in entries:
            new[table][address] = register
        if self._torn > 0:
            self._torn -= 1
            apart = tuple(q + TORN_APART for q in controller.q)
            image.tear(profile, new, image.state_registers(profile, {"position": apart}))
        self._image = new

    def tear(self, count: int) -> None:
        """Mix two moments in the next ``count`` images."""
        self._torn = count

    # -- the bench --------------------------------------------------------------------------------

    def commands(self, controller: ArmController) -> Mapping[str, Command]:
        """Return bench commands for faults of this protocol."""

        def program(arguments: list[float]) -> None:
            if isinstance(self.program, MailboxProgram):
                self.program.run(bool(arguments[0]))

        return {
            "tear": (1, lambda arguments: self.tear(int(arguments[0])),
                     "N: mix two moments in the next N samples"),
            "program": (1, program, "0 or 1: stop or start the robot's mailbox program"),
        }  # fmt: skip


def _stop_reasons(controller: ArmController) -> frozenset[StopReason]:
    reasons: set[StopReason] = set()
    if controller.protective:
        reasons |= {StopReason.PROTECTIVE_STOP, StopReason.FAULT}
    if controller.emergency:
        reasons |= {StopReason.EMERGENCY_STOP, StopReason.NOT_READY}
    return frozenset(reasons)


def make_servers(
    settings: ModbusSettings, host: str, controller: ArmController
) -> list[ProtocolServer]:
    """Return the server of a cell's link. Raises InputError if its profile cannot be used.

    A link over TLS is served by plain TCP nowhere: it needs the server's key, which a cell has not.
    """
    profile = read_profile(settings.profile_path, controller.n)
    if settings.transport == "tls":
        raise LinkError(
            "link.transport: found tls, expected tcp or rtu: a cell holds no server key"
        )
    return [
        ModbusServer(
            profile, host, settings.port or profile.port,
            serial=settings.serial if settings.transport == "rtu" else None,
            baudrate=settings.baudrate,
        )
    ]  # fmt: skip
