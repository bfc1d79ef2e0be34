"""Writes that do not arrive, do not count, or are not the only ones."""

from __future__ import annotations

import socket
import struct
import threading
import time

from benchmarks.faults.links import dashboard
from benchmarks.faults.mischief import Outcome, losing
from benchmarks.faults.proxy import UP
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Row, seconds

FOREIGN = b"def foreign():\n  while True:\n    sync()\n  end\nend\n"


def _lose_packets(rig: Rig) -> None:
    """Lose every data package of the client: what it sends goes nowhere."""

    def lose(message: bytes) -> Outcome:
        return [] if message[2:3] == b"U" else [(0.0, message)]

    rig.proxy.do(UP, lose, "rtde")


def _lose_requests(rig: Rig) -> None:
    rig.proxy.do(UP, lambda m: losing(m) if m[7] in (16, 23) else [(0.0, m)], "modbus")


def _stop_program(rig: Rig) -> None:
    if rig.link.main == "modbus":
        rig.controller.bench("program 0")
    else:
        dashboard(rig.back, "stop")


def _another_program(rig: Rig) -> None:
    with socket.create_connection((rig.back, 30003), timeout=5.0) as upload:
        upload.sendall(FOREIGN)
        time.sleep(0.3)


def _another_on_the_bus(rig: Rig) -> None:
    """Send a target as another commander does, some time long."""

    def command() -> None:
        with socket.create_connection((rig.back, 29536), timeout=5.0) as bus:
            bus.sendall(b"< open can0 >< rawmode >")
            time.sleep(0.05)
            for _ in range(10):
                bus.sendall(b"< send 155 8 0 0 0 0 0 1 2 3 >")
                time.sleep(0.01)

    threading.Thread(target=command, daemon=True).start()


def _another_in_the_mailbox(rig: Rig) -> None:
    """Write the mailbox as another commander does, with a checksum that fits."""

    def command() -> None:
        with socket.create_connection((rig.back, 15020), timeout=5.0) as link:
            for number in range(10):
                words = [20000 + number, 0, 0, 0, 0, 0, 0, 7 + number, 400, 800]
                words.append((18242 + sum(k * w for k, w in enumerate(words, 1))) % 65521)
                body = struct.pack(">BBHHB11H", 1, 16, 234, 11, 22, *words)
                link.sendall(struct.pack(">HHH", number, 0, len(body)) + body)
                time.sleep(0.03)

    threading.Thread(target=command, daemon=True).start()


def _half_a_setpoint(rig: Rig) -> None:
    """Cut the connection behind the first of a setpoint's frames."""

    def cut(message: bytes) -> Outcome:
        if message.startswith(b"< send 156"):
            rig.proxy.cut()
            return []
        return [(0.0, message)]

    rig.proxy.do(UP, cut, "can")


STAYS = ("observing", "fault")

ROWS = (
    Row("writes are lost", "write not effective", "proxy loses all data packages of the client",
        _lose_packets, ("ur_servoj", "ur_offset"), within=seconds(0.6), lasting=0.2, end=STAYS,
        slow=True),
    Row("requests are lost", "write not effective", "proxy loses all writing requests",
        _lose_requests, ("modbus",), within=seconds(0.9), lasting=0.2, end=STAYS, slow=True),
    Row("no echo", "register that does not echo", "the robot's program is stopped", _stop_program,
        ("modbus", "ur_offset"), within=seconds(0.8), end=STAYS, slow=True),
    Row("another program", "second commander", "another script is uploaded", _another_program,
        ("ur_servoj", "ur_offset"), within=seconds(0.6), end=STAYS, slow=True),
    Row("another commander", "second commander", "10 foreign frames 0x155", _another_on_the_bus,
        ("can",), within=seconds(0.4), lasting=0.3, end=STAYS),
    Row("another master", "second commander", "another client writes the mailbox 10 times",
        _another_in_the_mailbox, ("modbus",), within=seconds(0.6), lasting=0.3, end=STAYS),
    Row("half a setpoint", "partial multi-frame write", "connection cut behind frame 0x155",
        _half_a_setpoint, ("can",), within=seconds(0.3), end=STAYS, slow=True),
)  # fmt: skip
