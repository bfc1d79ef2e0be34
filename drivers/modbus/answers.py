"""Answers and requests of pymodbus whose registers are unpacked and packed at once.

The library's own take a block register by register and write all of it into a text for the log at
each answer, whatever the log's level: most of what a reading costs. It has a way for answers of
one's own, ``client.register``; what is on the wire is the same.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from pymodbus.exceptions import ModbusIOException
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersResponse,
    ReadInputRegistersResponse,
    ReadWriteMultipleRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)


class Registers(ReadHoldingRegistersResponse):
    """Registers read by function 3; 16 bits each, since they come out of two bytes."""

    def decode(self, data: bytes) -> None:
        """Take the registers out of an answer. Raises as the library's own does."""
        if (size := data[0]) >= len(data):
            raise ModbusIOException(f"byte_count {size} > length of packet {len(data)}")
        self.registers = struct.unpack_from(f">{size // 2}H", data, 1)

    def __str__(self) -> str:
        """Return a short text: one is made for each answer, logged or not."""
        return type(self).__name__


class InputRegisters(Registers, ReadInputRegistersResponse):
    """Registers read by function 4."""

    function_code = 4


class ExchangedRegisters(Registers, ReadWriteMultipleRegistersResponse):
    """Registers read by function 23."""

    function_code = 23


class Written(WriteMultipleRegistersResponse):
    """The answer to function 16."""

    def __str__(self) -> str:
        """Return a short text: one is made for each answer, logged or not."""
        return type(self).__name__


class WriteRegisters(WriteMultipleRegistersRequest):
    """Function 16."""

    def encode(self) -> bytes:
        """Return the request's bytes. Raises struct.error for what is no register."""
        count = self.count
        return struct.pack(f">HHB{count}H", self.address, count, 2 * count, *self.registers)


def take_answers(client: Any) -> None:
    """Have a client (pymodbus) use the answers above."""
    answers: Sequence[type[ModbusPDU]] = (Registers, InputRegisters, ExchangedRegisters, Written)
    for answer in answers:
        client.register(answer)
