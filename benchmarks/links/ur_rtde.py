"""A UR over RTDE, both modes: a sample read, registers or servoJ written, beside ur_rtde alone.

Both sides use the same library objects, whose threads receive 500 packets a second whoever asks.
The library calls the same getters and setters; its write repeats the values that ours sent last.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from benchmarks.links.case import Cycles, LinkCase, OurCycle, Pause
from benchmarks.links.serving import served_cell
from benchmarks.server_thread import OFFSET_SCRIPT
from gapbridge.bridge.cell.cell import Cell
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.ur.settings import SCRIPT_PORT
from gapbridge.drivers.ur_rtde import registers
from gapbridge.drivers.ur_rtde.driver import UrRtdeDriver
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

HOST = "127.77.0.5"
COMMON = f"driver: ur_rtde, host: {HOST}, state_timeout: 0.5"
STARTED = 0.5  # s in which the robot's program runs
TAKEN = 0.0002  # s after which the library has taken the whole packet


class UrOffsetCase(LinkCase):
    """Offsets in input registers, applied by the robot's own program."""

    name, library = "ur_rtde (offset)", "ur_rtde"

    @contextmanager
    def served(self, pause: Pause) -> Iterator[Cycles]:
        """Yield the two sides."""
        with served_cell(f"link: {{{COMMON}, mode: offset}}\n") as cell:
            with socket.create_connection((HOST, SCRIPT_PORT), timeout=5) as pendant:
                pendant.sendall(OFFSET_SCRIPT.read_bytes())
                time.sleep(STARTED)
            with _armed(cell) as (driver, ours):
                yield Cycles(ours.steps, _offset_sides(driver), _wait(driver, pause))


class UrServoCase(LinkCase):
    """Joint setpoints by servoJ, through the library's control script."""

    name, library = "ur_rtde (servoj)", "ur_rtde"

    @contextmanager
    def served(self, pause: Pause) -> Iterator[Cycles]:
        """Yield the two sides."""
        link = f"link: {{{COMMON}, mode: servoj}}\n"
        with served_cell(link) as cell, _armed(cell) as (driver, ours):

            def turn(is_ours: bool) -> None:
                # the robot's watchdog may have ended the script, where the machine was busy
                state = driver.read_state()
                if not driver._writer._control.isProgramRunning():  # type: ignore[attr-defined]
                    driver.arm(state)

            yield Cycles(ours.steps, _servo_sides(driver, ours), _wait(driver, pause), turn)


@contextmanager
def _armed(cell: Cell) -> Iterator[tuple[UrRtdeDriver, OurCycle]]:
    assert isinstance(cell.link, UrRtdeSettings)
    with UrRtdeDriver(cell.link, cell.model, SYSTEM) as driver:
        ours = OurCycle(driver, cell.model)
        state = driver.read_state()
        driver.arm(state)
        ours.hold = state.target_q if driver.moves_arm else None
        yield driver, ours


def _wait(driver: UrRtdeDriver, pause: Pause) -> Any:
    receive = driver.reader._receive

    def wait() -> None:
        last, until = receive.getTimestamp(), time.monotonic() + 0.1
        while receive.getTimestamp() == last and time.monotonic() < until:
            pause(0.0001)
        pause(TAKEN)

    return wait


def _read(driver: UrRtdeDriver) -> Any:
    reader = driver.reader
    receive, vectors = reader._receive, tuple(reader._getters)

    def read() -> None:
        receive.getTimestamp()
        for getter in vectors:
            getter()
        receive.getRobotMode()
        receive.getSafetyMode()
        receive.getRuntimeState()
        receive.getSafetyStatusBits()
        receive.getSpeedScaling()
        receive.getPayload()

    return read


def _offset_sides(driver: UrRtdeDriver) -> Any:
    writer: Any = driver._writer
    receive, io, vectors = driver.reader._receive, writer._io, _read(driver)

    def read() -> None:
        vectors()
        receive.getOutputIntRegister(registers.ECHO)
        receive.getOutputIntRegister(registers.PROGRAM)
        for register in registers.APPLIED:
            receive.getOutputDoubleRegister(register)

    def write() -> None:
        for register in registers.OFFSET_DOUBLES:
            io.setInputDoubleRegister(register, 0.0)
        io.setInputIntRegister(registers.OFFSET_RZ, 0)
        io.setInputIntRegister(
            registers.CHECKSUM, registers.checksum([0] * 6, writer._sequence, writer._rates)
        )
        io.setInputIntRegister(registers.HEARTBEAT, writer._sequence)
        io.setInputIntRegister(registers.SEQUENCE, writer._sequence)

    return read, write


def _servo_sides(driver: UrRtdeDriver, ours: OurCycle) -> Any:
    writer: Any = driver._writer
    control, settings, hold = (
        writer._control,
        driver.settings,
        [] if ours.hold is None else ours.hold.tolist(),
    )

    def write() -> None:
        now = time.monotonic()
        if now - writer._kicked > 0.02:  # the watchdog is wire work too
            control.kickWatchdog()
            writer._kicked = now
        control.servoJ(hold, 0.0, 0.0, 1.0 / settings.rate, settings.lookahead, settings.gain)

    return _read(driver), write
