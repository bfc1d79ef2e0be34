"""An AgileX PiPER on CAN: the frames of one sample read, four setpoint frames sent.

The libraries are python-can, which receives and sends, and cantools, which decodes and encodes the
same messages by the same DBC. Both sides use one bus object; in the library's turn a socketcand bus
is the library's own class.
"""

from __future__ import annotations

import select
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can
from can.interfaces.socketcand.socketcand import SocketCanDaemonBus

from benchmarks.links.case import Cycles, OurCycle, Pause
from gapbridge.bridge.cell.cell import Cell
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import SYSTEM

HOST, PORT = "127.77.0.4", 29921
BURST = 0.0015  # s in which all frames of one sample have come
COMMON = "profile: piper, rate: 200, state_timeout: 0.3, foreign_quiet: 0.2, frozen_after: 10.0"
HUB = f"link: {{driver: can, {COMMON}, interface: socketcand, host: {HOST}, port: {PORT}}}\n"
VIRTUAL = f"link: {{driver: can, {COMMON}, interface: virtual, channel: link-costs}}\n"


@contextmanager
def armed(cell: Cell, pause: Pause) -> Iterator[Cycles]:
    """Yield the two sides of a served cell."""
    assert isinstance(cell.link, CanSettings)
    with CanDriver(cell.link, cell.model, SYSTEM) as driver:
        ours = OurCycle(driver, cell.model)
        driver.arm(driver.read_state())
        ours.hold = driver.writer.target
        yield _cycles(driver, ours, pause)


def _cycles(driver: CanDriver, ours: OurCycle, pause: Pause) -> Cycles:
    profile = driver.profile
    bus: Any = driver.reader.bus
    incoming = {key: message.message for key, message in profile.incoming.items()}
    held = ours.hold
    assert held is not None
    wire: list[float] = profile.joints.to_wire(held).tolist()
    values = [
        (f.key, f.message, {**f.constants, **{s: wire[j] for s, j in f.joints}})
        for f in profile.setpoint
    ]
    our_class = type(bus)

    def turn(is_ours: bool) -> None:
        if isinstance(bus, SocketCanDaemonBus):
            bus.__class__ = our_class if is_ours else SocketCanDaemonBus
        if is_ours:
            driver.reader.newest()
            driver.reader.assembler.reset()
            driver._reset_reading()

    socket = getattr(bus, "_link", None)  # of a socketcand bus

    def wait() -> None:
        until = time.monotonic() + 0.1
        while not _has_frames(bus, socket) and time.monotonic() < until:
            pause(0.0002)
        pause(BURST)

    def read() -> None:
        while (frame := bus.recv(0.0)) is not None:
            message = incoming.get((frame.arbitration_id, frame.is_extended_id))
            if message is not None:
                message.decode(frame.data, decode_choices=False)

    def write() -> None:
        for (identifier, extended), message, signals in values:
            data = message.encode(signals, strict=True)
            bus.send(can.Message(arbitration_id=identifier, is_extended_id=extended, data=data))

    return Cycles(ours.steps, (read, write), wait, turn)


def _has_frames(bus: Any, socket: Any) -> bool:
    if socket is None:
        return not bus.queue.empty()
    return bool(select.select([socket], [], [], 0.0)[0])
