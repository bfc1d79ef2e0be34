"""The server that a PLC talks to: ``python -m gapbridge.bridge.setpoint_source.modbus_server``.

It is a separate process, so that a client's traffic never delays the loop. Numbers are signed 32
bit, high word first, in 1e-6 rad or 1e-6 m.

=================  ==============================================================================
holding 0          sequence: any change makes the joints valid; write all in one request
holding 2 to 2n+1  nominal joints
input 0, 1         version of this map (1); number of joints
input 2            state of the loop: 0 disconnected, 1 observing, 2 armed, 3 compensating,
                   4 holding, 5 fault
input 3            last sequence accepted
input 4            cycle counter: it changes as long as the loop runs
input 5            bit 0: the corrected setpoint was sent to the robot; bit 1: it was limited
input 10 on        corrected joints
input 30 on        nominal joints that they belong to
input 50 to 61     offset of the TCP in base: x, y, z, rotation vector
=================  ==============================================================================
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import sys
import threading
from typing import Any

import numpy as np
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from gapbridge.bridge.setpoint_source.plc_memory import PlcMemory
from gapbridge.drivers.modbus.registers import Coding

VERSION = 1
UNIT = 1e-6  # rad or m a count
CORRECTED, NOMINAL, OFFSET, INPUTS = 10, 30, 50, 62
JOINTS = 2  # holding register of the first joint
CODING = Coding("i32")
LIMIT = 2147.0  # rad or m: largest number


class PlcServer:
    """The registers; input registers show the newest status of the loop."""

    def __init__(self, memory: PlcMemory) -> None:
        self._memory = memory
        self._holding = [0] * (JOINTS + 2 * memory.n)

    def device(self) -> SimDevice:
        """Return the library's device: any unit id, two tables."""
        inputs = SimData(0, count=INPUTS, datatype=DataType.REGISTERS)
        holding = SimData(0, count=len(self._holding), datatype=DataType.REGISTERS)
        nothing = SimData(0, values=[False] * 16, datatype=DataType.BITS)
        return SimDevice(id=0, simdata=([nothing], [nothing], [holding], [inputs]),
                         action=self._answer)  # fmt: skip

    async def _answer(
        self, function: int, start: int, address: int, count: int, registers: list[int],
        values: list[int] | list[bool] | None,
    ) -> None:  # fmt: skip
        if function == 4:
            registers[:INPUTS] = self._inputs()
        elif values is not None and function in (6, 16, 22, 23):
            self._take(address, [int(v) for v in values])

    def _take(self, address: int, values: list[int]) -> None:
        before = self._holding[0]
        self._holding[address : address + len(values)] = values
        if self._holding[0] != before:
            counts = CODING.decode(self._holding[JOINTS:])
            self._memory.put_setpoint(self._holding[0], np.array(counts) * UNIT)

    def _inputs(self) -> list[int]:
        registers = [0] * INPUTS
        n = self._memory.n
        registers[0], registers[1] = VERSION, n
        reported = self._memory.status()
        if reported is None:
            return registers
        (state, sequence, cycle, flags), values = reported
        registers[2:6] = [state, sequence, cycle & 0xFFFF, flags]
        numbers = np.nan_to_num(values, nan=0.0, posinf=LIMIT, neginf=-LIMIT)
        words = CODING.encode((np.clip(numbers, -LIMIT, LIMIT) / UNIT).tolist())
        registers[CORRECTED : CORRECTED + 2 * n] = words[: 2 * n]
        registers[NOMINAL : NOMINAL + 2 * n] = words[2 * n : 4 * n]
        registers[OFFSET:INPUTS] = words[4 * n :]
        return registers


async def serve(memory: PlcMemory, host: str, port: int) -> None:
    """Serve until the process ends; prints the port or a failure as JSON on stdout."""
    server = ModbusTcpServer(PlcServer(memory).device(), address=(host, port))
    try:
        await server.serve_forever(background=True)
    except (RuntimeError, OSError):
        _print({"failure": f"cannot listen on {host}:{port}"})
        return
    transport: Any = server.transport
    _print({"port": transport.sockets[0].getsockname()[1]})
    await server.serving


def _print(what: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def _end_with_parent() -> None:
    """End with the loop's process, which holds the other end of stdin."""
    sys.stdin.read()
    os._exit(0)


def main() -> None:
    """Serve with the settings on stdin, one line of JSON: host, port, n, memory (descriptors)."""
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    order = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    asyncio.run(serve(PlcMemory(order["n"], tuple(order["memory"])), order["host"], order["port"]))


if __name__ == "__main__":
    main()
