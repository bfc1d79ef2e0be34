"""Modbus TCP, profile ``ur``: one block read, one mailbox written, beside pymodbus.

The library reads the same block and writes the same nine registers; it turns no register into a
number, so that our decoding counts against us.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pymodbus.client import ModbusTcpClient

from benchmarks.links.case import Cycles, LinkCase, OurCycle, Pause
from benchmarks.links.serving import served_cell
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.modbus.driver import ModbusDriver
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.modbus.write import MailboxWriter

HOST, PORT = "127.77.0.2", 15920
PACE = 0.005  # s between two cycles: longer than the controller's, so that each finds a new sample
LINK = f"""\
link: {{driver: modbus, profile: ur, host: {HOST}, port: {PORT}, rate: 500,
  timeout: 0.5, state_timeout: 0.5}}
"""


class ModbusTcpCase(LinkCase):
    """One simulated UR10e's Modbus server."""

    name, library = "modbus ur (TCP)", "pymodbus"

    @contextmanager
    def served(self, pause: Pause) -> Iterator[Cycles]:
        """Yield the two sides, each with a connection of its own."""
        with served_cell(LINK) as cell:
            assert isinstance(cell.link, ModbusSettings)
            bare: Any = ModbusTcpClient(HOST, port=PORT, timeout=0.5, retries=0)
            with ModbusDriver(cell.link, cell.model, SYSTEM) as driver:
                bare.connect()
                ours = OurCycle(driver, cell.model)
                driver.arm(driver.read_state())
                yield _cycles(driver, ours, bare, pause)
                bare.close()


def _cycles(driver: ModbusDriver, ours: OurCycle, bare: Any, pause: Pause) -> Cycles:
    (block,) = driver.map.fast
    writer = driver._writer
    assert isinstance(writer, MailboxWriter)
    address, words = writer._box.address, writer._words()

    def wait() -> None:
        pause(PACE)
        driver._due = 0.0  # no pacing inside the cycle: the next reading is due at once

    def turn(is_ours: bool) -> None:
        nonlocal words
        words = writer._words()  # so that the robot's program sees a heartbeat in either turn

    def read() -> None:
        bare.read_holding_registers(block.first, count=block.count, device_id=1)

    def write() -> None:
        bare.write_registers(address, words, device_id=1)

    return Cycles(ours.steps, (read, write), wait, turn)
